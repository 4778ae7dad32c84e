"""UFF58: names, units and rates from the headers; damage that pyuff passes over."""

import sys

import numpy as np
import pytest
import pyuff

from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap, load_columns
from lmshealth.io.formats.registry import load
from lmshealth.io.reading import read_log
from lmshealth.io.refusal import Unusable
from tests.io.conftest import write_uff
from tests.io.handmade import uff_set

NOISE = np.random.default_rng(0).normal(size=(3, 300))


def write(path, *, n=2, **entries):
    """Write noise in up to three records."""
    names = ("feed", "pitch", "yaw")[:n]
    return write_uff(path, dict(zip(names, NOISE, strict=False)), **entries)


def refused(path, reason, *words, **options):
    """Expect a refusal with words in its detail."""
    with pytest.raises(BadLog) as caught:
        read_log(path, **options)
    assert caught.value.reason == reason, caught.value
    for word in words:
        assert word in caught.value.detail


@pytest.mark.parametrize("binary", [0, 1])
@pytest.mark.parametrize("suffix", [".uff", ".unv"])
def test_reads_accelerations(tmp_path, binary, suffix):
    """Accelerations are read by their first line, in SI units, at the rate of the header."""
    log = read_log(write(tmp_path / f"log{suffix}", binary=binary))
    assert [c.name for c in log.channels] == ["acc_feed", "acc_pitch"]
    assert log.sample_rate == 2000.0 and log.pieces == ((0, 300),)
    for channel, values in zip(log.channels, NOISE, strict=False):
        np.testing.assert_allclose(channel.values[:], values * 9.80665, rtol=1e-11)


def test_ascii_and_binary_agree(tmp_path):
    """The two forms of the same records agree to 1e-6."""
    ascii_log = read_log(write(tmp_path / "a.uff", binary=0))
    binary_log = read_log(write(tmp_path / "b.uff", binary=1))
    for one, other in zip(ascii_log.channels, binary_log.channels, strict=True):
        np.testing.assert_allclose(one.values[:], other.values[:], rtol=1e-6)
    assert ascii_log.digest != binary_log.digest


def test_names(tmp_path):
    """Records are called by the first entry that distinguishes them, else by their number."""
    path = write(tmp_path / "a.uff", id1="all the same")
    assert [c.name for c in read_log(path).channels] == ["acc_set_1", "acc_set_2"]
    path = write(tmp_path / "b.uff", n=1, id1="NONE", rsp_ent_name="head")
    assert [c.name for c in read_log(path).channels] == ["acc_head"]


def test_map(tmp_path):
    """A map names records; with it only they are read, in the unit it gives."""
    (tmp_path / "map.toml").write_text('[columns]\ndelta_e_um = "pitch"\n')
    path = write(tmp_path / "log.uff", ordinate_spec_data_type=8, ordinate_axis_units_lab="um")
    log = read_log(path, columns=load_columns(tmp_path / "map.toml"))
    assert [c.name for c in log.channels] == ["delta_e"]
    np.testing.assert_allclose(log.channels[0].values[:], NOISE[1] * 1e-6, rtol=1e-11)


def test_other_quantities_are_listed(tmp_path):
    """Without an acceleration the records are listed with their units."""
    path = write(tmp_path / "log.uff", ordinate_spec_data_type=15, ordinate_axis_units_lab="Pa")
    refused(path, "columns", "feed [Pa], pitch [Pa]")


def test_unit_must_be_known(tmp_path):
    """An acceleration in no unit or an unknown one is not guessed; a map may give the unit."""
    for unit in ("NONE", "furlong"):
        path = write(tmp_path / "log.uff", ordinate_axis_units_lab=unit)
        refused(path, "unit", "acc_feed")
    given = ColumnMap(units={"acc_feed": "g", "acc_pitch": 2.0})
    log = read_log(path, columns=given)
    np.testing.assert_allclose(log.channels[1].values[:], 2 * NOISE[1], rtol=1e-11)


def test_functions_of_frequency(tmp_path):
    """A spectrum is no time record, whatever its unit and whoever asks for it."""
    path = write(tmp_path / "log.uff", func_type=9)
    refused(path, "columns", "function type 9")
    asked = ColumnMap(columns={"acc_x_g": "feed"})
    refused(path, "columns", "no time record", columns=asked)


def test_complex_record(tmp_path):
    """Complex values are no samples."""
    path = write_uff(tmp_path / "log.uff", {"feed": NOISE[0] + 1j})
    refused(path, "columns", "no time record")


def test_abscissa(tmp_path):
    """An abscissa in another unit than s and one without interval are refused."""
    refused(write(tmp_path / "a.uff", abscissa_axis_units_lab="ms"), "unit", "'ms'")
    path = write(tmp_path / "b.uff")
    path.write_bytes(path.read_bytes().replace(b"  5.00000e-04", b"  0.00000e+00"))
    refused(path, "time", "needed one")


def test_uneven_abscissa(tmp_path):
    """Time stamps are read and judged as those of any log."""
    path = write(tmp_path / "log.uff", abscissa_spacing=0, binary=1)
    log = read_log(path)
    assert log.sample_rate == pytest.approx(2000, rel=1e-9) and len(log.channels) == 2
    gap = np.arange(300) / 2000
    gap[100:] += 0.1
    path = write(tmp_path / "gap.uff", abscissa_spacing=0, binary=1, x=gap)
    assert read_log(path).pieces == ((0, 100), (100, 300))


def test_truncated(tmp_path):
    """A file cut inside a record is refused; pyuff would drop that record in silence."""
    for binary in (0, 1):
        path = write(tmp_path / "log.uff", binary=binary)
        data = path.read_bytes()
        last_record = data.rindex(b"    -1\n    58")
        for stop in (last_record + 7, last_record + 40, len(data) // 3, len(data) - 9):
            path.write_bytes(data[:stop])
            refused(path, "corrupt", "cut off")


def test_missing_samples(tmp_path):
    """Fewer samples than the header promises are named with both counts."""
    path = write(tmp_path / "log.uff", n=1)
    lines = path.read_bytes().split(b"\n")
    path.write_bytes(b"\n".join([*lines[:20], *lines[25:]]))
    refused(path, "corrupt", "280 of 300")


def test_damaged_tag(tmp_path):
    """A lost tag between two records does not lose a record in silence."""
    path = write(tmp_path / "log.uff", n=3)
    data = path.read_bytes()
    at = data.index(b"    -1\n    -1")
    path.write_bytes(data[:at] + b"    +1" + data[at + 6 :])
    refused(path, "corrupt")


def test_without_pyuff(tmp_path, monkeypatch):
    """Without pyuff the error names the extra to install."""
    monkeypatch.setitem(sys.modules, "pyuff", None)
    refused(write(tmp_path / "log.uff"), "format", "lmshealth[formats]")


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


@pytest.mark.parametrize("end", ["\n", "\r\n", " \n"])
@pytest.mark.parametrize("ordinate", [2, 4])
@pytest.mark.parametrize("uneven", [False, True])
def test_text_is_read_as_pyuff_reads_it(tmp_path, ordinate, uneven, end):
    """Numbers agree to the last bit, whatever the blocks and the ends of the lines."""
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


@pytest.mark.parametrize("spacing", [0, 1])
@pytest.mark.parametrize(("ordinate", "dtype"), [(2, "<f4"), (4, "<f8")])
def test_binary_is_read_as_pyuff_reads_it(tmp_path, ordinate, dtype, spacing):
    """Binary numbers agree, with the right number of bytes, a wrong one, and none."""
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
    """Samples whose bytes are the end of a data set are read where the header counts them."""
    body = b"\n    -1\n" + VALUES[:10].tobytes()
    columns = loaded(tmp_path / "log.uff", uff_set(body, 11, binary="88"))
    assert columns["delta_e_um"].tobytes() == body
    corrupt(tmp_path / "log.uff", "begins at byte", uff_set(body, 11, binary="0"))


def test_big_endian(tmp_path):
    """The header defines the order of bytes."""
    made = uff_set(VALUES.astype(">f8").tobytes(), 101, binary="808")
    columns = loaded(tmp_path / "log.uff", made.replace(b"b     1", b"b     2"))
    np.testing.assert_array_equal(columns["delta_e_um"], VALUES)


def test_numbers_without_blanks_between(tmp_path):
    """Numbers that fill their columns are separated by the columns."""
    body = b"-1.00000e-100-2.00000e-100\n 3.00000e+00\n"
    columns = loaded(tmp_path / "log.uff", uff_set(body, 3, ordinate=2))
    assert columns["delta_e_um"].tolist() == [-1e-100, -2e-100, 3.0]


def test_other_data_sets_are_passed_over(tmp_path):
    """Other data sets may hold anything, even lines that end as a tag."""
    other = b"    -1\n   151\nmodel\n         1    -1\n\n    -1   \n\n"
    columns = loaded(tmp_path / "log.uff", other, uff_set(lines(VALUES, 4), 101), other)
    assert columns["delta_e_um"].size == 101


def test_what_is_no_data_set(tmp_path):
    """Between data sets and behind them there are only blank lines."""
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
    assert loaded(path, trap)["delta_e_um"].size == 101


def test_spacing_that_does_not_exist(tmp_path):
    """Numbers of unknown meaning are not read."""
    corrupt(tmp_path / "log.uff", "does not keep", uff_set(lines(VALUES, 4), 101, spacing=2))


@pytest.mark.parametrize("n", [-5, 0, 100, 102, 999_999_999])
def test_other_numbers_of_samples(tmp_path, n):
    """A record with another number of samples than its header has is refused."""
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


def test_limit_of_memory(tmp_path):
    """A data set that takes more memory than allowed is refused with the next step."""
    path = tmp_path / "log.uff"
    path.write_bytes(uff_set(VALUES.tobytes(), 101, binary="808"))
    assert load(path, ColumnMap(), 40_000).columns
    for limit, what in ((10_000, "data set 'delta_e_um'"), (1000, "the file")):
        with pytest.raises(Unusable, match=rf"{what} needs .* raise --max-memory") as caught:
            load(path, ColumnMap(), limit)
        assert caught.value.reason == "too-large"


@pytest.mark.parametrize(
    ("start", "n_refused", "first"),
    [(0.0, 0, 0), (0.0005, 0, 1), (0.01, 0, 20), (0.00025, 1, 0), (0.25, 1, 0), (-0.01, 0, 0)],
)
def test_records_that_start_later(tmp_path, start, n_refused, first):
    """Records are aligned by whole samples, or refused with both starts where that is not exact."""
    path, x = tmp_path / "log.uff", np.arange(200) / 2000
    rows = NOISE[:, :100]
    write_uff(path, {"a": rows[0], "b": rows[1]}, x=x[:100])
    late = write_uff(tmp_path / "late.uff", {"c": rows[2]}, x=start + x[:100])
    path.write_bytes(path.read_bytes() + late.read_bytes())
    log = read_log(path)
    found = {c.name: c.values[:] for c in log.channels}
    assert len(found) == 3 - n_refused and len(log.refused) == (2 if start < 0 else start > 0)
    np.testing.assert_allclose(
        found["acc_a"], 9.80665 * rows[0][first : first + found["acc_a"].size]
    )
    if n_refused:
        assert f"starts at {start:g} s, the others at 0 s" in log.refused[0].detail
    elif start:
        assert found["acc_c"].size == 100 - abs(round(2000 * start))
        np.testing.assert_allclose(
            found["acc_c"], 9.80665 * rows[2][round(max(-2000 * start, 0)) :][: found["acc_c"].size]
        )


@pytest.mark.parametrize(("date", "n_refused"), [("08:30:00", 0), ("08:30:01", 0), ("09:30:00", 1)])
def test_dates_of_records(tmp_path, date, n_refused):
    """Records of other times are no channels of one log; the date may be that of writing."""
    path = tmp_path / "log.uff"
    many = np.resize(VALUES, 40_000)
    sets = [uff_set(many.tobytes(), 40_000, binary="320000", name=f"acc_{k}_g") for k in "abc"]
    path.write_bytes(b"".join(sets).replace(b"08:30:00", date.encode(), 1))
    content = load(path, ColumnMap(), 1e9)
    assert len(content.refused) == n_refused and len(content.columns) == 3 - n_refused


FEW = np.linspace(-2.5, 4, 101)
BODY = FEW.astype("<f4").tobytes()
EXACT = lines(FEW, 2)


@pytest.mark.parametrize(
    ("body", "binary"),
    [
        (EXACT.rstrip() + b"  0.00000e+00\n", ""),
        (EXACT.rstrip() + b" " * 13 + b"\n", ""),
        (EXACT + b"  0.00000e+00" * 6 + b"\n", ""),
        (EXACT + b"\n   \n\n", ""),
        (EXACT.replace(b"\n", b"\r\n") + b"\r\n", ""),
        (BODY + bytes(380), "404"),
        (BODY + bytes(380), "784"),
        (BODY + b"\r\n", "404"),
        (BODY + b"\n\n", "406"),
        (BODY + b" " * 108, "512"),
        (BODY + b"\xab" * 108, "404"),
    ],
)  # fmt: skip
def test_padding_behind_the_stated_samples(tmp_path, body, binary):
    """Zeros and blanks behind the stated number of samples are no samples."""
    made = uff_set(body, 101, ordinate=2, binary=binary)
    columns = loaded(tmp_path / "log.uff", made, uff_set(EXACT, 101, ordinate=2, name="acc_x_g"))
    np.testing.assert_allclose(columns["delta_e_um"], FEW, rtol=1e-5)
    assert columns["acc_x_g"].size == 101


@pytest.mark.parametrize(
    ("body", "binary"),
    [
        (EXACT[: len(EXACT) // 2], ""),
        (EXACT.rstrip() + b"  1.00000e+00\n", ""),
        (EXACT + b"text text text text\n", ""),
        (BODY[:-4], "404"),
        (BODY[:200], "404"),
        (BODY + b"\xab" * 108, "512"),
    ],
)
def test_more_or_less_than_padding(tmp_path, body, binary):
    """What is cut off, and numbers beyond those stated, contradict the header."""
    word = "of 101 samples|does not keep|cut off|end of a row"
    corrupt(tmp_path / "log.uff", word, uff_set(body, 101, ordinate=2, binary=binary))
