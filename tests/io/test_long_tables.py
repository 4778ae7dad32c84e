"""Tables of many minutes take no more memory than a few minutes, and lose nothing."""

import gzip

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lmshealth.io.buffers import MINUTE, Stored, blocks
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.registry import load

# Values repeat after so many rows, and no block ends where they do.
PERIOD = 10_007
# What h5py needs for a sample is a part of what the others need.
MINUTES = {".h5": 5, ".parquet": 3, ".csv": 2, ".gz": 3}
NAMES = ("delta_e_um", "acc_feed_m_s2")


def pattern(name):
    """Make values that every format keeps to the last digit, different in each column."""
    return np.arange(PERIOD) / 64 - 80.0 * (1 + NAMES.index(name))


def write(path, n_periods, **options):
    """Write the pattern again and again."""
    columns = {name: np.tile(pattern(name), n_periods) for name in NAMES}
    if path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            for name, values in columns.items():
                file.create_dataset(name, data=values, **options)
    elif path.suffix == ".parquet":
        pq.write_table(pa.table(columns), path, **options)
    else:
        rows = zip(*(pattern(name).tolist() for name in NAMES), strict=True)
        text = "".join(f"{one!r},{other!r},remark\n" for one, other in rows).encode()
        header = ",".join((*NAMES, "note")).encode() + b"\n"
        packed = path.suffix == ".gz"
        parts = [gzip.compress(part) if packed else part for part in (header, text)]
        path.write_bytes(parts[0] + parts[1] * n_periods)


CASES = {
    "contiguous.h5": {},
    "chunks.h5": {"chunks": (4096,), "compression": "lzf"},
    "one_group.parquet": {"row_group_size": 10 * MINUTE},
    "groups.parquet": {"row_group_size": MINUTE, "use_dictionary": False},
    "log.csv": {},
    "log.csv.gz": {},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_long_table(tmp_path, peaks, name):
    """All samples are read, in less memory than four minutes of them; the library needs more."""
    path, short = tmp_path / name, tmp_path / f"short_{name}"
    n_periods = MINUTES[path.suffix] * MINUTE // PERIOD + 1
    write(path, n_periods, **CASES[name])
    write(short, 1, **CASES[name])
    columns = load(path, ColumnMap()).columns
    assert set(columns) == set(NAMES)
    for column, samples in columns.items():
        assert isinstance(samples, Stored) and samples.size == n_periods * PERIOD
        whole = np.tile(pattern(column), n_periods)
        for start, block in blocks(samples):
            np.testing.assert_array_equal(block, whole[start : start + block.size])
    own, bare = peaks(short, path)
    allowed = 4 * 8 * MINUTE * len(columns)
    assert own < allowed < bare, (own, bare)
