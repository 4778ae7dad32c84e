"""Data sets of universal files: found whole, and their numbers as pyuff reads them."""

import numpy as np
import pytest
import pyuff

from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats import uffsets
from lmshealth.io.formats.registry import load
from lmshealth.io.refusal import Unusable
from tests.io.handmade import uff_set

VALUES = np.random.default_rng(0).normal(size=101) * 10.0 ** np.arange(-50, 51)
FORMATS = {4: "20.11e", 2: "13.5e"}


def lines(values, ordinate, uneven=False, end="\n"):
    """Write numbers in the columns that the format has for them."""
    words = [format(value, FORMATS[ordinate]) for value in values]
    if uneven and ordinate == 4:
        words[::2] = [f"{value:13.5e}" for value in values[::2]]
    per_line = 6 if ordinate == 2 else 4
    rows = ["".join(words[k : k + per_line]) for k in range(0, len(words), per_line)]
    return "".join(row + end for row in rows).encode()


def loaded(path, *sets):
    """Read records by their names."""
    path.write_bytes(b"".join(sets))
    return load(path, ColumnMap()).columns


def corrupt(path, word, *sets):
    """Expect a refusal of a damaged file."""
    with pytest.raises(Unusable, match=word) as caught:
        loaded(path, *sets)
    assert caught.value.reason == "corrupt"


@pytest.mark.parametrize("block", [100, 1 << 20])
@pytest.mark.parametrize("end", ["\n", "\r\n", " \n"])
@pytest.mark.parametrize("ordinate", [2, 4])
@pytest.mark.parametrize("uneven", [False, True])
def test_text_is_read_as_pyuff_reads_it(tmp_path, monkeypatch, ordinate, uneven, end, block):
    """Numbers agree to the last bit, whatever the blocks and the ends of the lines."""
    monkeypatch.setattr(uffsets, "_BLOCK", block)
    path = tmp_path / "log.uff"
    values = VALUES[:100] if uneven else VALUES
    n = 50 if uneven else 101
    body = lines(values, ordinate, uneven, end)
    columns = loaded(path, uff_set(body, n, ordinate=ordinate, spacing=int(not uneven)))
    record = pyuff.UFF(str(path)).read_sets()
    np.testing.assert_array_equal(columns["delta_e_um"], record["data"])
    assert columns["delta_e_um"].size == n
    if uneven:
        np.testing.assert_array_equal(columns["time_s"], record["x"])


@pytest.mark.parametrize("block", [16, 1 << 20])
@pytest.mark.parametrize("spacing", [0, 1])
@pytest.mark.parametrize(("ordinate", "dtype"), [(2, "<f4"), (4, "<f8")])
def test_binary_is_read_as_pyuff_reads_it(tmp_path, monkeypatch, ordinate, dtype, spacing, block):
    """Binary numbers agree, with the right number of bytes, a wrong one, and none."""
    monkeypatch.setattr(uffsets, "_BLOCK", block)
    path = tmp_path / "log.uff"
    with np.errstate(over="ignore"):
        body = VALUES[:100].astype(dtype).tobytes()
    n = 100 if spacing else 50
    for claim in (str(len(body)), str(len(body) // 2), "-4", "999999999999"):
        for tail in (b"", b"\n", b"\r\n"):
            made = uff_set(body + tail, n, ordinate=ordinate, spacing=spacing, binary=claim)
            columns = loaded(path, made, made.replace(b"delta_e_um", b"acc_x_g   "))
            records = pyuff.UFF(str(path)).read_sets()
            for name, record in zip(("delta_e_um", "acc_x_g"), records, strict=True):
                np.testing.assert_array_equal(columns[name], record["data"])


def test_binary_numbers_that_look_like_a_tag(tmp_path):
    """Samples whose bytes are the end of a data set are samples, as the header says."""
    body = b"\n    -1\n" * 20 + VALUES[:10].tobytes()
    columns = loaded(tmp_path / "log.uff", uff_set(body, 30, binary=str(len(body))))
    np.testing.assert_array_equal(columns["delta_e_um"], np.frombuffer(body))


def test_big_endian(tmp_path):
    """The header says the order of bytes."""
    made = uff_set(VALUES.astype(">f8").tobytes(), 101, binary="808")
    columns = loaded(tmp_path / "log.uff", made.replace(b"b     1", b"b     2"))
    np.testing.assert_array_equal(columns["delta_e_um"], VALUES)


def test_numbers_without_blanks_between(tmp_path):
    """Numbers that fill their columns are told apart by the columns."""
    body = b"-1.00000e-100-2.00000e-100\n 3.00000e+00\n"
    columns = loaded(tmp_path / "log.uff", uff_set(body, 3, ordinate=2))
    assert columns["delta_e_um"].tolist() == [-1e-100, -2e-100, 3.0]


def test_other_data_sets_are_passed_over(tmp_path):
    """Other data sets may hold anything, even lines that end as a tag."""
    other = b"    -1\n   151\nmodel\n         1    -1\n\n    -1   \n\n"
    columns = loaded(tmp_path / "log.uff", other, uff_set(lines(VALUES, 4), 101), other)
    assert columns["delta_e_um"].size == 101


def test_what_is_no_data_set(tmp_path):
    """Between data sets and behind them nothing stands but blank lines."""
    good = uff_set(lines(VALUES, 4), 101)
    path = tmp_path / "log.uff"
    assert loaded(path, good, b"\r\n \n\x1a")
    corrupt(path, f"begins at byte {len(good)}", good, b"comment\n", good)
    corrupt(path, "no number", good, b"    -1\nabc\n    -1\n")
    corrupt(path, "no number", good, b"    -1\n    -1\n")
    corrupt(path, "cut off", good, b"    -1\n")
    corrupt(path, "cut off", good, good[:-7])
    corrupt(path, "set 2 does not keep", good, b"    -1\n    58\nname\n    -1\n")
    corrupt(path, "set 1 does not keep", good.replace(b"       101", b"      10.1"))
    corrupt(path, "set 1 does not keep", good.replace(b"e-", b"q-"))
    trap = good.replace(b"NONE\n01", b"x    -1\n01")
    corrupt(path, "looks like the end", trap, trap)


def test_spacing_that_does_not_exist(tmp_path):
    """Numbers of unknown meaning are not read."""
    corrupt(tmp_path / "log.uff", "does not keep", uff_set(lines(VALUES, 4), 101, spacing=2))


@pytest.mark.parametrize("n", [-5, 0, 100, 102, 999_999_999])
def test_other_numbers_of_samples(tmp_path, n):
    """A record that has more or fewer samples than it says is refused, however many it says."""
    corrupt(tmp_path / "log.uff", f"101 of {n} samples", uff_set(lines(VALUES, 4), n))
    body = VALUES.tobytes()
    corrupt(tmp_path / "log.uff", f"101 of {n} samples", uff_set(body, n, binary="808"))


def test_stamps_that_differ(tmp_path):
    """Records with time stamps of their own make no log, in memory or on disk."""
    path = tmp_path / "log.uff"
    one = uff_set(VALUES[:100].tobytes(), 50, spacing=0, binary="800")
    shifted = np.concatenate([VALUES[:98], [1.0, 2.0]]).tobytes()
    other = uff_set(shifted, 50, spacing=0, binary="800", name="acc_x_g")
    with pytest.raises(Unusable, match="different time stamps"):
        loaded(path, one, other)
    assert loaded(path, one, one.replace(b"delta_e_um", b"acc_x_g   "))["time_s"].size == 50
