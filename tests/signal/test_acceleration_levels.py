"""Magnitudes: what accelerometers read at known sines and noise, and which frequencies grow."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lmshealth.errors import BadLog, BadQuestion
from lmshealth.io.log import Log, Metadata
from lmshealth.io.reading import read_log
from lmshealth.modal.identification import identify
from lmshealth.signal.readings import (
    FrequencyBand,
    Magnitude,
    choose_bands,
    find_growth,
    read_magnitudes,
)
from lmshealth.stage.description import load_stage
from models.dynamics.stages import STAGES
from models.recordings.strokes import record_strokes
from models.recordings.velocities import Experiment, drive_velocities
from studies.paper.tables.tables import PRINTED, acceleration_reading
from tests.signals import Mode, acceleration_log, make_log, make_stage, sine, white

RATE = 8000.0
N = 32_000
TEN = FrequencyBand("100 Hz", "grid", 95.0, 105.0)


def known() -> Log:
    """Make a log of two accelerometers with sines of known amplitudes, whole periods each."""
    a = sine(N, RATE, 100.0, 3e-3) + sine(N, RATE, 103.0, 1e-3) + sine(N, RATE, 110.0, 9e-3)
    return make_log({"acc_a": a, "acc_b": 2 * a, "delta_e": a}, RATE)


def test_a_sine_reads_its_amplitude() -> None:
    """Strongest harmonic, its frequency and RMS of a band are exact, channel by channel."""
    first, second = read_magnitudes(known(), [TEN])
    assert (first.channel, second.channel) == ("acc_a", "acc_b")
    assert first.magnitude == pytest.approx(3e-3, rel=1e-9)
    assert first.frequency == pytest.approx(100.0, rel=1e-12)
    assert first.rms == pytest.approx(np.sqrt((9e-6 + 1e-6) / 2), rel=1e-9)
    assert second.magnitude == pytest.approx(6e-3, rel=1e-9)


@pytest.mark.slow
def test_noise_reads_its_density_and_its_degrees_of_freedom() -> None:
    """The mean square of a band of white noise is S times its width, scattered as χ² of its dof."""
    rng, level = np.random.default_rng(1), 2e-6
    read = [
        read_magnitudes(make_log({"acc_a": white(rng, level, N, RATE)}, RATE), [TEN])[0]
        for _ in range(300)
    ]
    (dof,) = {m.dof for m in read}
    assert dof == 2 * 39  # 95 and 105 Hz themselves are outside
    ratio = np.array([m.rms**2 for m in read]) / (level * 39 * RATE / N)
    assert abs(ratio.mean() - 1) < 4.5 * np.sqrt(2 / dof / 300)
    assert abs(ratio.var() / (2 / dof) - 1) < 4.5 * np.sqrt(2.5 / 300)


def test_gaps_and_parts_keep_the_rms() -> None:
    """Two pieces of one sine have its RMS; a part that is not there is refused."""
    log = replace(known(), pieces=((0, 16_000), (16_800, N)))
    magnitude = read_magnitudes(log, [TEN])[0]
    assert magnitude.rms == pytest.approx(np.sqrt((9e-6 + 1e-6) / 2), rel=0.02)
    with pytest.raises(BadLog, match="set point"):
        read_magnitudes(log, [TEN], part="settling")


def test_what_a_log_cannot_show_is_refused() -> None:
    """No accelerometer, too slow, too short: each names what there is and what is needed."""
    with pytest.raises(BadLog, match=r"delta_e.*acc_<name>_m_s2") as caught:
        read_magnitudes(make_log({"delta_e": np.ones(10)}, RATE), [TEN])
    assert caught.value.reason == "no-accelerometer"
    with pytest.raises(BadLog, match="more than 210 Hz") as caught:
        read_magnitudes(make_log({"acc_a": np.ones(100)}, 200.0), [TEN])
    assert caught.value.reason == "sample-rate"
    with pytest.raises(BadLog, match=r"0\.1 s.*needs 0\.3 s") as caught:
        read_magnitudes(make_log({"acc_a": np.ones(800)}, RATE), [TEN])
    assert caught.value.reason == "too-short"


def test_bands_above_half_the_sample_rate_are_passed_over() -> None:
    """A watched band that the sampling cannot show leaves the others readable."""
    high = FrequencyBand("watch", "watch", 3900.0, 4100.0)
    assert {m.band for m in read_magnitudes(known(), [TEN, high])} == {TEN}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lms-x", "lms-y"])
def test_the_papers_moves_read_as_its_tables_do(name: str, tmp_path: Path) -> None:
    """The larger of both accelerometers agrees with an independent reading, row by row."""
    experiment = Experiment(STAGES[name])
    velocities = (0.005, 0.4)
    drive_velocities(experiment, tmp_path, "hdf5", velocities=velocities)
    grid = choose_bands(None, None, None)
    for velocity in velocities:
        recording = record_strokes(
            experiment.stage, profile=experiment.move(velocity), rng=experiment.rng(velocity)
        )
        oracle = acceleration_reading(recording, [np.array([(b.low, b.high)]) for b in grid])
        log = read_log(tmp_path / f"velocity-{1e3 * velocity:08.3f}.h5")
        found = read_magnitudes(log, grid)
        ours = [max(1e3 * m.magnitude for m in found if m.band == b) for b in grid]
        np.testing.assert_allclose(ours, oracle, rtol=1e-9)
        assert found[0].velocity == pytest.approx(velocity, rel=1e-6)


# Bands


def test_without_a_stage_there_is_the_papers_grid() -> None:
    """Every 10 Hz from 10 to 400, or in the band asked for."""
    grid = choose_bands(None, None, None)
    assert [band.name for band in grid] == [f"{f} Hz" for f in range(10, 401, 10)]
    assert (grid[0].low, grid[0].high) == (5.0, 15.0)
    assert [b.name for b in choose_bands(None, None, (0, 25))] == ["10 Hz", "20 Hz"]


def test_a_range_without_a_band_is_refused() -> None:
    """Neither the grid nor a description has a frequency there: the range is stated."""
    with pytest.raises(BadQuestion, match="82 to 88 Hz: choose a wider band"):
        choose_bands(None, None, (82.0, 88.0))


def test_a_stage_has_modes_health_band_and_watched_bands() -> None:
    """lms-y has the bands of its description, lms-x no watched bands."""
    bands = choose_bands(load_stage("lms-y"), None, None)
    assert [b.name for b in bands if b.kind == "mode"] == ["roll", "pitch", "yaw"]
    (health,) = [b for b in bands if b.kind == "health"]
    assert (health.low, health.high) == (10, 390)
    middles = [(b.low + b.high) / 2 for b in bands if b.kind == "watch"]
    assert middles == [2000, 2900, 3000]
    bands = choose_bands(load_stage("lms-x"), None, (80, 100))
    assert [(b.name, b.kind) for b in bands] == [("roll", "mode"), ("10-150 Hz", "health")]


def test_modes_are_read_where_the_log_shows_them() -> None:
    """An identified mode carries its band with it; one that is not seen stays at the nominal."""
    stage = make_stage([("roll", 100.0, 0.02), ("pitch", 160.0, 0.02)])
    log = acceleration_log(np.random.default_rng(3), [Mode(108.0, 0.02)], 20, 1000.0, 0.1)
    modes = identify(log, stage)
    found = dict(zip(modes.names, modes.frequency.tolist(), strict=True))
    bands = {b.name: b for b in choose_bands(stage, found, None)}
    roll, pitch = bands["roll"], bands["pitch"]
    assert roll.placed_by == "identified"
    assert roll.low < 108 < roll.high
    assert roll.low > 100
    assert (pitch.placed_by, pitch.low, pitch.high) == ("stage", 152.0, 168.0)


def test_close_modes_share_no_harmonic() -> None:
    """Where bands of modes would overlap they part in the middle."""
    low, high = choose_bands(make_stage([("a", 100.0, 0.05), ("b", 110.0, 0.05)]), None, None)
    assert low.high == high.low == pytest.approx(105.0)


# Growth


def at(velocity: float, magnitude: float, stage: str = "A") -> Magnitude:
    """Make a reading of one band."""
    return Magnitude("log", stage, velocity, "acc_a", TEN, magnitude, 100.0, 0.25, magnitude, 40)


def test_growth_is_the_slope_of_the_logarithms() -> None:
    """Slope, its standard deviation and probability are those of a textbook regression."""
    from scipy.stats import linregress

    rng = np.random.default_rng(4)
    v = np.array([1, 5, 10, 20, 100, 200, 400]) * 1e-3
    y = 0.02 * v**0.6 * np.exp(rng.normal(0, 0.3, v.size))
    (found,) = find_growth([at(*pair) for pair in zip(v.tolist(), y.tolist(), strict=True)])
    oracle = linregress(np.log(v), np.log(y), alternative="greater")
    assert found.slope == pytest.approx(oracle.slope, rel=1e-12)
    assert found.slope_std == pytest.approx(oracle.stderr, rel=1e-12)
    assert found.p_value == pytest.approx(oracle.pvalue, rel=1e-9)
    assert found.grows is True


def test_what_grows_is_said_to() -> None:
    """A true slope is found in 19 of 20 series of noisy levels."""
    rng = np.random.default_rng(5)
    v = (np.array([1, 5, 10, 20, 100, 200, 400]) * 1e-3).tolist()
    hits = 0
    for _ in range(400):
        y = [u**0.5 * float(np.exp(rng.normal(0, 0.4))) for u in v]
        hits += find_growth([at(*p) for p in zip(v, y, strict=True)])[0].grows is True
    assert hits > 380


def test_one_velocity_has_no_slope_and_two_logs_no_uncertainty() -> None:
    """An unknown slope is NaN, and its significance None."""
    (one,) = find_growth([at(0.1, 1.0), at(0.1, 1.1), at(0.1, 1.2)])
    assert (one.n_logs, one.n_velocities) == (3, 1)
    assert np.isnan(one.slope)
    assert one.grows is None
    (two,) = find_growth([at(0.1, 1.0), at(0.2, 2.0)])
    assert two.slope == pytest.approx(1.0)
    assert np.isnan(two.slope_std)
    assert two.grows is None
    (none,) = find_growth([at(float("nan"), 1.0), at(0.0, 1.0)])
    assert none.n_logs == 0


def test_speeds_within_a_percent_are_one() -> None:
    """Wherever they lie there is no growth of levels by 0.2 % of the speed."""
    for speed in np.linspace(0.1, 0.3, 50).tolist():
        (found,) = find_growth([at(speed * (1 + 1e-3 * k), 1.0 + k) for k in (-1, 0, 1)])
        assert found.n_velocities == 1


def test_machines_are_not_mixed() -> None:
    """Each machine has its own line."""
    found = find_growth([at(0.1, 1.0, "A"), at(0.2, 5.0, "B")])
    assert [(g.stage, g.n_logs) for g in found] == [("A", 1), ("B", 1)]


def test_the_papers_own_numbers_grow_where_it_says() -> None:
    """Of the printed Table 7 all twelve that the paper names grow; 50 and 350 Hz do not."""
    table = pd.read_csv(PRINTED / "table7.csv")
    speeds = [float(name.split("_")[1]) * 1e-3 for name in table.columns[2:]]
    readings = [
        replace(at(v, float(m)), band=FrequencyBand(f"{row.iloc[1]:g}", "grid", 1.0, 2.0))
        for _, row in table.iterrows()
        for v, m in zip(speeds, row.iloc[2:], strict=True)
    ]
    grows = {int(g.band): g.grows for g in find_growth(readings)}
    named = [10, 90, 110, 120, 140, 150, 160, 260, 290, 310, 380, 390]
    assert all(grows[f] for f in named)
    assert not grows[50]
    assert not grows[350]


def test_metadata_give_the_velocity_where_no_set_point_does() -> None:
    """The reading carries the velocity of the metadata."""
    log = replace(known(), metadata=Metadata(stage="A", velocity=0.02))
    assert read_magnitudes(log, [TEN])[0].velocity == 0.02
    assert np.isnan(read_magnitudes(known(), [TEN])[0].velocity)
