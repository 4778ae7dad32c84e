"""Long files of every format: streamed where the format allows it, and without loss."""

import gzip
import os
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lmshealth.io import buffers
from lmshealth.io.buffers import MINUTE, Stored, blocks
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.registry import load
from lmshealth.io.refusal import Unusable
from tests.io.handmade import array, element, mat_file, pack, tdms_segment, uff_set

# Values repeat after so many rows, and no block ends where they do.
PERIOD = 10_007
# What h5py needs for a sample is a part of what the others need.
MINUTES = {".h5": 5, ".parquet": 3, ".csv": 2, ".gz": 3, ".tdms": 5}
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
    elif path.suffix == ".tdms":
        path.write_bytes(tdms_segment({name: pattern(name) for name in NAMES}) * n_periods)
    else:
        rows = zip(*(pattern(name).tolist() for name in NAMES), strict=True)
        text = "".join(f"{one!r},{other!r},remark\n" for one, other in rows).encode()
        header = ",".join((*NAMES, "note")).encode() + b"\n"
        packed = path.suffix == ".gz"
        parts = [gzip.compress(part) if packed else part for part in (header, text)]
        path.write_bytes(parts[0] + parts[1] * n_periods)


CASES: dict[str, dict[str, Any]] = {
    "contiguous.h5": {},
    "chunks.h5": {"chunks": (4096,), "compression": "lzf"},
    "one_group.parquet": {"row_group_size": 10 * MINUTE},
    "groups.parquet": {"row_group_size": MINUTE, "use_dictionary": False},
    "segments.tdms": {},
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


def whole(path, values):
    """Write one column in a format that is decoded as a whole."""
    body = values.tobytes()
    if path.suffix == ".uff":
        path.write_bytes(uff_set(body, values.size, binary=str(len(body))))
    elif path.suffix == ".tdms":
        path.write_bytes(tdms_segment({"delta_e_um": values}, interleaved=True))
    else:
        mat_file(path, pack(array(6, (values.size, 1), content=element(9, body))))
    return path


@pytest.mark.parametrize("name", ["log.uff", "log.mat", "log.tdms"])
def test_long_columns_go_to_disk(tmp_path, monkeypatch, name):
    """Long columns that are decoded as a whole do not stay in memory."""
    values = np.random.default_rng(0).normal(size=2500)
    path = whole(tmp_path / name, values)
    np.testing.assert_array_equal(load(path, ColumnMap()).columns["delta_e_um"], values)
    monkeypatch.setattr(buffers, "MINUTE", 1000)
    stored = load(path, ColumnMap()).columns["delta_e_um"]
    assert isinstance(stored, Stored)
    np.testing.assert_array_equal(stored[:], values)


@pytest.mark.parametrize("name", ["log.uff", "log.mat", "log.tdms"])
def test_no_file_is_left_open(tmp_path, monkeypatch, name):
    """A long file that turns out to be damaged leaves no file open."""
    monkeypatch.setattr(buffers, "MINUTE", 1000)
    path = whole(tmp_path / name, np.random.default_rng(0).normal(size=2500))
    content = bytearray(path.read_bytes())
    if name == "log.mat":
        content[-100] ^= 1
    else:
        content = content[: len(content) // 2]
    path.write_bytes(content)
    before = os.listdir("/proc/self/fd")
    with pytest.raises(Unusable, match=r"cut off|incorrect data check"):
        load(path, ColumnMap())
    assert os.listdir("/proc/self/fd") == before
