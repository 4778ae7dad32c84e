"""Tables: the columns of the contract, units at the door, and honest gaps."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, date, datetime

import numpy as np
import pandas as pd
import pytest

from lmshealth._private.tables import RUN_TABLES, TABLES, Row
from lmshealth.io.log import Metadata, Refusal
from lmshealth.life.prognosis import Prognosis
from lmshealth.life.verdict import Verdict
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.service import decide, probability_before
from lmshealth.machine.summary import prognosis_rows, summarise_life
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.modes import Modes
from lmshealth.report.tables import (
    csv_text,
    join_csv,
    lines_rows,
    log_tables,
    modes_rows,
    refused_rows,
    track_rows,
)
from lmshealth.signal.spectral_lines import Line
from lmshealth.stage.description import Decision, Stage, load_stage
from lmshealth.tracking.filters.track_state import Event
from lmshealth.tracking.history import History, Series
from lmshealth.tracking.track import Effect, Track
from tests.assessments import tables_of
from tests.lives import health_of
from tests.signals import write_archive_stage

WHEN = datetime(2026, 3, 1, 8, tzinfo=UTC)
EVENT = Event("step", 1, "roll", "", -0.02, 0.001, 31.5, declared=False, found_at=1)
LEVELS = ("q05", "q10", "q25", "q50", "q75", "q90", "q95")


def two_modes(coupled: float = 2e-7) -> Modes:
    """Give two modes whose ln frequencies have a covariance."""
    cov = np.diag([1e-6, 4e-6, 1e-2, 1e-2])
    cov[0, 1] = cov[1, 0] = coupled
    return Modes(
        names=("roll", "pitch"),
        sources=("acc", "acc"),
        channels=("acc_x", "acc_y"),
        ln_frequency=np.log([62.0, 105.0]),
        ln_damping=np.log([0.02, 0.03]),
        cov=cov,
        snr=np.array([100.0, 50.0]),
        dispersion=np.ones(2),
        flags=("",) * 2,
        shape_channels=("acc_x", "acc_y"),
        shapes=np.array([[1.0, np.nan], [-0.6, 0.8]]),
        lines=(Line(50.0, 0.1, "m/s²", "mains", "acc_x"),),
        refused=(),
    )


def prognosis(remaining: np.ndarray, usage: float = 10_000.0) -> Prognosis:
    """Give a prognosis of one parameter with these draws of remaining travel in m."""
    n = remaining.size
    return Prognosis(
        stage="test-A",
        recorded_at=WHEN,
        travel=5e5,
        parameters=("guide_preload", "any"),
        unidentifiable=(),
        limits=np.array([0.6, np.nan]),
        remaining=np.column_stack([remaining, remaining]),
        usage=np.full(n, usage),
        usage_now=np.full(n, usage),
        half=remaining[:, None] / 2,
        horizon=2e7,
        health=np.full((n, 1), 0.9),
        curve_travel=np.array([0.0, 1.0]),
        curve_quantiles=np.ones((5, 2, 1)),
        laws=(),
        chi_square=1.0,
        degrees_of_freedom=1,
        walk=0.0,
        noise_scale=1.0,
        deviation=0.0,
        ess=1000.0,
        r_hat=1.0,
    )


def assessment(stage: Stage, prognosis_: Prognosis | None) -> Assessment:
    """Give an assessment of two logs."""
    two = (WHEN, WHEN.replace(month=4))
    travel = np.array([1e5, 5e5])
    shape = np.full((2, 2), 0.01)
    drift_cov = np.tile(np.array([[1e-6, 5e-7], [5e-7, 4e-6]]), (2, 1, 1))
    history = History(
        "test-A", ("a.h5", "b.h5"), two, travel, {}, ("roll", "pitch"),
        (Series("roll", "acc"), Series("pitch", "acc")), np.log(100 * shape),
        np.log(shape), np.tile(np.eye(4), (2, 1, 1)), np.full(2, np.nan), (0,),
    )  # fmt: skip
    track = Track(
        "test-A", ("a.h5", "b.h5"), two, travel, ("roll", "pitch"), ("acc",),
        np.log(6200 * shape), 0.1 * shape, np.log(2 * shape), shape, -shape, drift_cov,
        (Effect("roll", "temperature_c", -1e-4, 2e-5),), (EVENT,), (), (), np.ones(2),
        np.full(2, 4.0), np.zeros((2, 4)), np.ones((2, 1)), np.ones(2),
    )  # fmt: skip
    draws = np.random.default_rng(1).normal(0.9, 0.01, (2, 500, 1))
    health = health_of(
        draws, recorded_at=two, travel=travel, parameters=("guide_preload",),
        informed=np.full((2, 1), 0.9), stage="test-A",
    )  # fmt: skip
    verdict = Verdict("test-A", two[-1], "healthy", 0.8, "")
    return Assessment(stage, history, ("d", "e"), track, health, prognosis_, verdict, (), (), 0)


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Load the small stage of the tests."""
    return load_stage(str(write_archive_stage(tmp_path_factory.mktemp("stage"))))


def tables(stage: Stage, remaining: np.ndarray) -> dict[str, pd.DataFrame]:
    """Make the tables of one assessment with these draws of remaining travel."""
    return frames([], assessment(stage, prognosis(remaining)))


def frame(table: str, rows: Sequence[Row]) -> pd.DataFrame:
    """Make a frame of rows of a table; further columns follow as they appear."""
    columns = dict.fromkeys([*TABLES[table].names, *(name for row in rows for name in row)])
    return pd.DataFrame(list(rows), columns=list(columns))


def frames(readings: Sequence[LogEstimates], made: Assessment) -> dict[str, pd.DataFrame]:
    """Make the tables of one machine."""
    found = {name: frame(name, own) for name, own in tables_of(made).items()}
    of_logs = [log_tables(reading) for reading in readings]
    for name in of_logs[0] if of_logs else ():
        text = "".join(join_csv([own[name] for own in of_logs]))
        found[name] = pd.read_csv(io.StringIO(text))
    return found


def test_empty_tables_have_their_columns() -> None:
    """Nothing at all still makes every table with its header."""
    for name in RUN_TABLES:
        assert csv_text(name, []) == ",".join(TABLES[name].names) + "\n"


def test_modes_leave_with_units_in_their_names() -> None:
    """Hz, km and °C stand in the table; the std of f is f times the std of ln f."""
    covariates = {"temperature_c": 21.5, "payload_kg": 4.0, "position_mm": -20.0}
    metadata = Metadata("test-A", WHEN, 123_400.0, covariates, servo_id="stiff")
    reading = LogEstimates("a.h5", "d", metadata, two_modes(), 1.5e-6, sample_rate=2e4)
    table = frame("modes", modes_rows(reading))
    row = table.iloc[0]
    assert (row["mode"], row["source"], row["channel"]) == ("roll", "acc", "acc_x")
    assert row["recorded_at"] == "2026-03-01T08:00:00+00:00"
    assert row["travel_km"] == pytest.approx(123.4)
    assert row["temperature_c"] == 21.5
    assert (row["payload_kg"], row["position_mm"], row["servo_id"]) == (4.0, -20.0, "stiff")
    assert row["delta_e_below_40hz_um"] == pytest.approx(1.5)
    assert row["frequency_std_hz"] == pytest.approx(62.0e-3)
    assert row["sample_rate_hz"] == 20_000
    assert row["damping_ratio_std"] == pytest.approx(0.02 * 0.1)


def test_unknown_metadata_are_empty_cells() -> None:
    """A log without metadata leaves empty cells, never the text nan."""
    reading = LogEstimates("a.h5", "d", Metadata(), two_modes())
    text = csv_text("modes", modes_rows(reading))
    assert text.splitlines()[1].startswith("a.h5,,,,,,,,,roll,acc,")
    assert "nan" not in text.lower()


def test_shapes_have_a_column_per_channel_after_all_others(stage: Stage) -> None:
    """Channels of any log of the table; an empty cell where a log or a mode has no such part."""
    alone = replace(two_modes(), shape_channels=("delta_e",), shapes=np.ones((2, 1)))
    both = {"a": two_modes(), "b": alone}
    readings = [LogEstimates(log, "d", Metadata(), modes) for log, modes in both.items()]
    table = frames(readings, assessment(stage, None))["modes"]
    own = ["shape_acc_x", "shape_acc_y", "shape_delta_e"]
    assert list(table.columns) == [*TABLES["modes"].names, *own]
    nan = np.nan
    expected = [[1.0, nan, nan], [-0.6, 0.8, nan], [nan, nan, 1.0], [nan, nan, 1.0]]
    np.testing.assert_array_equal(table[own], expected)


def test_covariances_between_modes_are_listed_once_and_zeros_left_out(stage: Stage) -> None:
    """A cross term of ln f is one row; modes of separate fits have none."""
    readings = [LogEstimates("a.h5", "d", Metadata(), two_modes())]
    table = frames(readings, assessment(stage, None))["modes_cov"]
    (row,) = table.to_dict("records")
    assert (row["log"], row["mode_a"], row["mode_b"]) == ("a.h5", "roll", "pitch")
    assert row["cov_ln_f"] == 2e-7
    apart = [LogEstimates("a.h5", "d", Metadata(), two_modes(0.0))]
    assert frames(apart, assessment(stage, None))["modes_cov"].empty


def test_track_and_its_covariance_agree(stage: Stage) -> None:
    """Standard deviations are roots of the diagonal, cross terms one row per pair and epoch."""
    made = tables(stage, np.full(100, 1e6))
    track, cov = made["track"], made["track_cov"]
    assert len(track) == 4
    assert len(cov) == 2
    np.testing.assert_allclose(track["drift_std"], [1e-3, 2e-3] * 2)
    np.testing.assert_allclose(track["frequency_hz"], 62.0)
    np.testing.assert_allclose(track["frequency_std_hz"], 62.0e-3)
    np.testing.assert_allclose(track["damping_ratio_std"], 0.02 * 0.01)
    np.testing.assert_allclose(cov["cov_drift"], 5e-7)
    assert made["effects"].to_dict("records")[0]["covariate"] == "temperature_c"


def test_health_quantiles_are_ordered_and_have_their_sampler(stage: Stage) -> None:
    """Every row has q05 ≤ q25 ≤ median ≤ q75 ≤ q95, and what drew it, which has converged."""
    health = tables(stage, np.full(100, 1e6))["health"]
    values = health[["q05", "q25", "median", "q75", "q95"]].to_numpy()
    assert (np.diff(values, axis=1) > 0).all()
    assert health["converged"].tolist() == [True, True]
    assert health["sampler"].tolist() == ["emcee", "emcee"]


def test_remaining_life_has_three_units(stage: Stage) -> None:
    """Kilometres over kilometres per day are days, and 24 hours are a day."""
    remaining = np.linspace(1e5, 1e6, 1001)
    row = tables(stage, remaining)["prognosis"].iloc[0]
    assert row["rul_km_q50"] == pytest.approx(550.0)
    assert row["rul_days_q50"] == pytest.approx(55.0)
    assert row["rul_hours_q50"] == pytest.approx(55.0 * 24)
    assert pd.isna(row["censored_from"])
    km = [row[f"rul_km_{level}"] for level in LEVELS]
    assert km == sorted(km)


def test_quantiles_past_the_horizon_are_empty(stage: Stage) -> None:
    """With 60 % of the draws beyond the horizon q50 and above are empty; the level is given."""
    remaining = np.concatenate(
        [np.linspace(1e5, 1e6, 400), np.full(300, 3e7), np.full(300, np.inf)]
    )
    row = tables(stage, remaining)["prognosis"].iloc[0]
    assert row["censored_from"] == 0.5
    assert row["probability_beyond_horizon"] == pytest.approx(0.6)
    for unit in ("km", "hours", "days"):
        assert [bool(pd.isna(row[f"rul_{unit}_{level}"])) for level in LEVELS] == 3 * [
            False
        ] + 4 * [True]
    text = tables(stage, remaining)["prognosis"].to_csv(index=False)
    assert "inf" not in text
    assert "nan" not in text


def test_a_life_wholly_past_the_horizon_has_no_quantile_and_no_service(stage: Stage) -> None:
    """All quantiles are empty, censored from the first level; nobody is sent."""
    row = tables(stage, np.full(100, np.inf))["prognosis"].iloc[1]
    assert row["parameter"] == "any"
    assert row["censored_from"] == 0.05
    assert all(pd.isna(row[f"rul_km_{level}"]) for level in LEVELS)
    assert pd.isna(row["service_by"]) and pd.isna(row["service_risk"])
    assert row["service"] == "later"


def test_a_limit_already_passed_has_no_life_left(stage: Stage) -> None:
    """Remaining life is never negative; the probability of having passed is given."""
    made = tables(stage, np.full(100, -5e5))["prognosis"]
    assert (made["rul_km_q05"] == 0).all()
    assert (made["probability_already_past"] == 1).all()
    assert made["service_by"].iloc[1] == WHEN.date()
    assert made["service"].iloc[1] == "now" and made["service"].isna().iloc[0]
    assert made["service_risk"].iloc[1] == 1


def test_a_requested_day_has_columns_of_its_own() -> None:
    """The day and the two bounds of its probability stand after all other columns."""
    life = prognosis(np.r_[np.full(50, 1e5), np.full(50, np.inf)])
    day = date(2046, 1, 1)
    before = day, probability_before(life, day)
    table = frame(
        "prognosis",
        prognosis_rows(summarise_life(life, load_stage("lms-y")), decide(life, Decision()), before),
    )
    assert list(table.columns[-3:]) == ["before", "probability_at_least", "probability_at_most"]
    assert table[table.columns[-3:]].to_numpy().tolist() == 2 * [[day, 0.5, 1.0]]


def test_refusals_are_rows() -> None:
    """Log, channel, mode, source, reason and detail are written unchanged."""
    refusal = Refusal("a.h5", "flat", 'all "0", really', channel="acc_x")
    table = frame("refused", refused_rows([refusal]))
    assert table.iloc[0].tolist() == ["a.h5", "acc_x", "", "", "flat", 'all "0", really']


def test_the_columns_are_those_of_the_contract() -> None:
    """Every column of the public contract is in its table."""
    wanted = {
        "modes": "log stage recorded_at travel_km temperature_c payload_kg position_mm servo_id "
        "delta_e_below_40hz_um mode source frequency_hz "
        "frequency_std_hz damping_ratio damping_ratio_std correlation_f_zeta snr dispersion "
        "std_factor excitation_mm_s2 flags",
        "events": "stage recorded_at travel_km kind mode source size std evidence",
        "verdict": "stage recorded_at verdict probability",
        "refused": "log channel mode source reason detail",
    }
    for name, columns in wanted.items():
        assert set(columns.split()) <= set(TABLES[name].names)


def test_events_and_smoothed_columns_leave_with_their_units(stage: Stage) -> None:
    """An event has one row per mode, in km and ISO moments; smoothing adds columns in Hz."""
    made = assessment(stage, None)
    table = frames([], made)["events"]
    row = table.iloc[0]
    assert (row["kind"], row["mode"], row["size"], row["evidence"]) == ("step", "roll", -0.02, 31.5)
    assert row["travel_km"] == 500.0
    assert row["recorded_at"] == row["known_at"] == "2026-04-01T08:00:00+00:00"
    assert not row["declared"]
    assert made.track is not None
    level = np.full((2, 2), np.log(100.0))
    cov = np.tile(1e-6 * np.eye(2), (2, 1, 1))
    smoothed = replace(made.track, ln_frequency=level, ln_frequency_std=0.01 * level, drift_cov=cov)
    rows = track_rows(made.track, smoothed)
    assert rows[0]["frequency_hz_smoothed"] == pytest.approx(100.0)
    assert rows[0]["frequency_std_hz_smoothed"] == pytest.approx(np.log(100.0))
    assert rows[3]["drift_std_smoothed"] == 1e-3
    assert "frequency_hz_smoothed" not in track_rows(made.track)[0]


def test_lines_have_the_keys_of_the_contract() -> None:
    """A line has its log, frequency, amplitude with unit, kind and channel."""
    (row,) = lines_rows("a.h5", [Line(50.0, 0.1, "m/s²", "mains", "acc_x")])
    assert row == {
        "log": "a.h5",
        "frequency_hz": 50.0,
        "amplitude": 0.1,
        "unit": "m/s²",
        "kind": "mains",
        "channel": "acc_x",
    }
