"""Real exports: read, or refused for the right reason."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lmshealth.errors import BadLog
from lmshealth.io.column_map import load_columns
from lmshealth.io.reading import read_log
from studies.harness.data.samples import MAPS

# What each sample is without a map: channels, samples, Hz and channels that are used in part, or
# reason and a word of the detail.
AS_IT_IS = {
    "owi_wind_turbine_tdms/open/good_tdms_2.tdms": (8, 15000, 250.0),
    "owi_wind_turbine_tdms/open/faulty_tdms_01.tdms": ("corrupt", "after 9 whole segments"),
    "tdms_reader_samples/Digital_Input.tdms": ("columns", "Digital Input"),
    "tdms_reader_samples/big_endian.tdms": ("columns", "Amplitude sweep"),
    "tdms_reader_samples/raw1.tdms": ("columns", "[Volts]"),
    "uff58_samples/MPSTD#Set001_2024_10_08_10_27_07.uff": (4, 222400, 3200.0),
    "uff58_samples/Sample_UFF58_ascii.uff": ("columns", "[Pa]"),
    "uff58_samples/Sample_UFF58b_bin.uff": ("columns", "[Pa]"),
    "uff58_samples/binary8byte.uff": (1, 250, 100.0),
    "uff58_samples/dataset_milestone_in_header.uff": ("columns", "M.REDON"),
    "uff58_samples/non_ascii_header.uff": ("columns", "function type 4"),
    "uff58_samples/sample_dataset58_psd.uff": ("columns", "Power Spectral Density"),
    "uff58_samples/time-history-not-all-columns-filled.uff": (1, 13, 20000.0),
    "fditools_two_inertia_bench/open/MultisineTypeA.mat": ("unit", "'time'"),
    "lsb250_linear_guide/open/exp1.mat": ("columns", "there: exp1"),
    "lsb250_linear_guide/open/exp2.mat": ("columns", "there: exp2"),
    "dropbear_ds8/open/10steps_test0.txt.gz": ("columns", "PinLoc"),
    "shake_3storey/open/Stiff_BonusEvent_3rd.csv": ("columns", "no signal"),
    "outside_faults/uff_last_row_padded.uff": (1, 20001, 1000.0),
    "outside_faults/uff_b_trailing_zeros.uff": (1, 20001, 1000.0),
    "outside_faults/uff_b_nbytes_padded.uff": (1, 20001, 1000.0),
    "outside_faults/tdms_time_channel.tdms": (1, 40000, 2000.0),
    "outside_faults/tdms_starts_differ_3.tdms": (3, 38000, 2000.0, 1),
    "outside_faults/tdms_starts_differ_same_length.tdms": (2, 38000, 2000.0, 1),
}
# With their column map.
WITH_MAP = {
    "lsb250_linear_guide/open/exp1.mat": (2, 100610, 1000.1088),
    "lsb250_linear_guide/open/exp2.mat": (2, 103259, 1000.1088),
    "fditools_two_inertia_bench/open/MultisineTypeA.mat": (3, 50000, 2500.0),
    "dropbear_ds8/open/10steps_test0.txt.gz": (2, 70000, 5000.0),
    "shake_3storey/open/Stiff_BonusEvent_3rd.csv": (2, 2709, 120.0048),
    "tdms_reader_samples/big_endian.tdms": (2, 3500, 1000.0),
    "tdms_reader_samples/raw1.tdms": (1, 2000, 50000.0),
    "uff58_samples/Sample_UFF58_ascii.uff": (1, 79292, 65535.953),
    "uff58_samples/dataset_milestone_in_header.uff": ("corrupt", "42 of 2508876"),
}


@pytest.fixture
def sample(needs):
    """Find a real file by its name."""
    needs("data")
    return lambda name: Path(os.environ["LMSHEALTH_DATA"]) / name


def mapped(path, folder):
    """Load the column map of a sample."""
    name = "/".join(path.parts[-3:]) if path.parent.name == "open" else "/".join(path.parts[-2:])
    (folder / "map.toml").write_text(MAPS[name])
    return load_columns(folder / "map.toml")


def check(path, expected, columns=None):
    """Compare the log, or the reason of its refusal, with the expected one."""
    if isinstance(expected[0], str):
        with pytest.raises(BadLog) as caught:
            read_log(path, columns=columns)
        assert caught.value.reason == expected[0] and expected[1] in caught.value.detail
        return
    log = read_log(path, columns=columns)
    n_channels, n_samples, rate, *in_part = expected
    assert (len(log.channels), log.channels[0].values.size) == (n_channels, n_samples)
    assert log.sample_rate == pytest.approx(rate, rel=1e-6)
    assert [one.reason for one in log.refused] == ["gaps"] * sum(in_part)


@pytest.mark.parametrize("name", AS_IT_IS)
def test_without_map(sample, name):
    """A sample is read as it is, or refused with its reason."""
    check(sample(name), AS_IT_IS[name])


@pytest.mark.parametrize("name", WITH_MAP)
def test_with_map(sample, tmp_path, name):
    """A sample is read by its column map."""
    path = sample(name)
    check(path, WITH_MAP[name], mapped(path, tmp_path))


def test_every_sample_is_expected(sample):
    """No UFF58, TDMS or MAT sample is left out above."""
    found = [p for p in sample(".").rglob("*") if p.suffix in (".uff", ".tdms", ".mat")]
    assert {p.relative_to(sample(".")).as_posix() for p in found} <= set(AS_IT_IS)


def test_ascii_and_binary_agree(sample, tmp_path):
    """The same recording in ASCII and in binary agrees to 1e-6 Pa, half its last digit."""
    one, other = (
        read_log(path, columns=mapped(path, tmp_path)).channels[0].values[:]
        for path in (
            sample("uff58_samples/Sample_UFF58_ascii.uff"),
            sample("uff58_samples/Sample_UFF58b_bin.uff"),
        )
    )
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-6)


def test_known_values(sample):
    """A sine of 5 Hz in g is a sine of 5 Hz in m/s²."""
    (channel,) = read_log(sample("uff58_samples/binary8byte.uff")).channels
    sine = 9.80665 * np.sin(2 * np.pi * 5 * np.arange(250) / 100)
    np.testing.assert_allclose(channel.values[:], sine, atol=1e-4)


@pytest.mark.slow
def test_modes_and_mains_of_a_uff_file(sample):
    """The command line finds the mode at 40.5 Hz, and at 50 Hz no mode but a line named mains."""
    name = str(sample("uff58_samples/MPSTD#Set001_2024_10_08_10_27_07.uff"))
    command = [sys.executable, "-m", "lmshealth", "modes", name, "--band", "35", "55"]
    done = subprocess.run(
        [*command, "--format", "json"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert not [m for m in found["modes"] if 49.5 < m["frequency_hz"] < 50.5]
    (mode,) = [m for m in found["modes"] if 39 < m["frequency_hz"] < 42]
    assert abs(mode["frequency_hz"] - 40.5) < 3 * mode["frequency_std_hz"]
    assert abs(mode["damping_ratio"] - 0.015) < 3 * mode["damping_ratio_std"]
    lines = found["lines"]
    assert [x["kind"] for x in lines if 49.9 < x["frequency_hz"] < 50.1] == ["mains"]
