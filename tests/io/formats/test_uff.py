"""UFF58: names, units and rates from the headers; damage that pyuff passes over."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap, load_columns
from lmshealth.io.reading import read_log

_SPEC = importlib.util.spec_from_file_location(
    "_writers", Path(__file__).parents[1] / "conftest.py"
)
_WRITERS = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(_WRITERS)

NOISE = np.random.default_rng(0).normal(size=(3, 300))


def write(path, *, n=2, **entries):
    """Write noise in up to three records."""
    names = ("feed", "pitch", "yaw")[:n]
    return _WRITERS.write_uff(path, dict(zip(names, NOISE, strict=False)), **entries)


def refused(path, reason, *words, **options):
    """Expect a refusal and look for words in its detail."""
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
        np.testing.assert_allclose(channel.values, values * 9.80665, rtol=1e-11)


def test_ascii_and_binary_agree(tmp_path):
    """The two forms of the same records agree to 1e-6."""
    ascii_log = read_log(write(tmp_path / "a.uff", binary=0))
    binary_log = read_log(write(tmp_path / "b.uff", binary=1))
    for one, other in zip(ascii_log.channels, binary_log.channels, strict=True):
        np.testing.assert_allclose(one.values, other.values, rtol=1e-6)
    assert ascii_log.digest != binary_log.digest


def test_names(tmp_path):
    """Records are called by the first entry that tells them apart, else by their number."""
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
    np.testing.assert_allclose(log.channels[0].values, NOISE[1] * 1e-6, rtol=1e-11)


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
    np.testing.assert_allclose(log.channels[1].values, 2 * NOISE[1], rtol=1e-11)


def test_functions_of_frequency(tmp_path):
    """A spectrum is no time record, whatever its unit and whoever asks for it."""
    path = write(tmp_path / "log.uff", func_type=9)
    refused(path, "columns", "function type 9")
    asked = ColumnMap(columns={"acc_x_g": "feed"})
    refused(path, "columns", "no time record", columns=asked)


def test_complex_record(tmp_path):
    """Complex values are no samples."""
    path = _WRITERS.write_uff(tmp_path / "log.uff", {"feed": NOISE[0] + 1j})
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
