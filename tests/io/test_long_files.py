"""Files of many minutes take no more memory than a few minutes, and lose nothing."""

import os

import numpy as np
import pytest

from lmshealth.io import buffers as spool
from lmshealth.io.buffers import MINUTE, Stored, blocks
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.registry import load
from lmshealth.io.refusal import Unusable
from tests.io.handmade import array, element, fields, mat_file, pack, tdms_segment, uff_set

# What pyuff needs for a sample is several times what the others need.
LONG, LONG_RECORD = 5 * MINUTE, 2 * MINUTE


def pattern(n):
    """Make values that tell when a block is lost or comes twice."""
    return np.arange(n) % 10_007 / 64 - 80.0


def tdms(path, n, *, n_segments=1, interleaved=False):
    """Write segments of a wanted channel and another one."""
    with path.open("wb") as stream:
        for part in np.split(pattern(n), n_segments):
            channels = {"delta_e_um": part, "other": part.astype("i2")}
            stream.write(tdms_segment(channels, interleaved=interleaved))


def mat(path, n, *, packed=False, inside=False):
    """Write a vector, by itself or in a struct."""
    vector = array(6, (n, 1), b"" if inside else b"delta_e_um", element(9, pattern(n).tobytes()))
    content = array(2, (1, 1), content=fields(b"x") + vector) if inside else vector
    mat_file(path, pack(content, packed))


def uff(path, n, *, binary=False, uneven=False):
    """Write a record, of pairs with the time where it is uneven."""
    values = pattern(n)
    if uneven:
        values = np.stack([np.arange(n) / 20_000, values], axis=1).ravel()
    body = values.tobytes() if binary else text(values)
    claim = str(len(body)) if binary else ""
    path.write_bytes(uff_set(body, n, spacing=int(not uneven), binary=claim))


def text(values):
    """Write four numbers in a line, here and now faster than number by number."""
    line = "%20.11e" * 4 + "\n"
    return "".join([line % tuple(four) for four in values.reshape(-1, 4).tolist()]).encode()


CASES = {
    "segments.tdms": (tdms, {"n_segments": 60}),
    "one_chunk.tdms": (tdms, {}),
    "interleaved.tdms": (tdms, {"interleaved": True}),
    "plain.mat": (mat, {}),
    "struct.mat": (mat, {"packed": True, "inside": True}),
    "text.uff": (uff, {}),
    "pairs.uff": (uff, {"binary": True, "uneven": True}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_long_file(tmp_path, peaks, name):
    """All samples are read, in less memory than four minutes of them; the library needs more."""
    write, options = CASES[name]
    n = LONG_RECORD if name.endswith(".uff") else LONG
    path, short = tmp_path / name, tmp_path / f"short_{name}"
    write(path, n, **options)
    write(short, 12_000, **options)
    columns = load(path, ColumnMap()).columns
    (samples,) = (values for key, values in columns.items() if key.startswith("delta_e_um"))
    assert isinstance(samples, Stored) and samples.size == n
    whole = pattern(n)
    for start, block in blocks(samples):
        np.testing.assert_array_equal(block, whole[start : start + block.size])
    own, bare = peaks(short, path)
    allowed = 4 * 8 * MINUTE * len(columns)
    assert own < allowed < bare, (own, bare)


@pytest.mark.parametrize("name", ["log.uff", "log.mat"])
def test_no_file_is_left_open(tmp_path, monkeypatch, name):
    """A long file that turns out to be damaged leaves no file open."""
    monkeypatch.setattr(spool, "MINUTE", 1000)
    path = tmp_path / name
    body = np.random.default_rng(0).normal(size=1 << 18).tobytes()
    if name == "log.uff":
        path.write_bytes(uff_set(body, 1, binary=str(len(body))))
    else:
        packed = bytearray(pack(array(6, (1 << 18, 1), content=element(9, body))))
        packed[-1000] ^= 1
        mat_file(path, bytes(packed))
    before = os.listdir("/proc/self/fd")
    with pytest.raises(Unusable, match=r"samples are there|damaged"):
        load(path, ColumnMap())
    assert os.listdir("/proc/self/fd") == before
