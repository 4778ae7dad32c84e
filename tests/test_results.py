"""Results: frozen, checked at birth, and honest about their derived numbers."""

from __future__ import annotations

import pickle
from dataclasses import FrozenInstanceError, replace
from datetime import UTC, datetime

import numpy as np
import pytest
from matplotlib.figure import Figure

from lmshealth import examples
from lmshealth._private.tables import TABLES
from lmshealth.errors import BadLog, BadQuestion
from lmshealth.io.log import Channel, Log, Metadata
from lmshealth.machine.assessment import assess
from lmshealth.modal.modes import Modes
from lmshealth.stage.description import load_stage
from lmshealth.tracking.history import History, Series
from lmshealth.tracking.track import track
from tests.lives import make_health, make_prognosis
from tests.signals import make_log


def two_modes() -> Modes:
    """Return two modes with a full covariance."""
    rng = np.random.default_rng(1)
    root = rng.normal(0, 0.01, (4, 4))
    return Modes(
        names=("roll", "pitch"),
        sources=("acc", "acc"),
        channels=("acc_0", "acc_0"),
        ln_frequency=np.log([120.0, 135.0]),
        ln_damping=np.log([0.02, 0.03]),
        cov=root @ root.T,
        snr=np.array([100.0, 50.0]),
        dispersion=np.ones(2),
        flags=("",) * 2,
        shape_channels=(),
        shapes=np.empty((2, 0)),
        lines=(),
        refused=(),
    )


def history(**changes: object) -> History:
    """Return a history of three logs of one mode."""
    parts: dict[str, object] = {
        "stage": "test-A",
        "logs": ("a", "b", "c"),
        "recorded_at": tuple(datetime(2026, 1, day, tzinfo=UTC) for day in (1, 2, 3)),
        "travel": np.array([1000.0, 3000.0, 4000.0]),
        "covariates": {},
        "modes": ("roll",),
        "ln_frequency": np.full((3, 1), np.log(100.0)),
        "ln_damping": np.full((3, 1), np.log(0.02)),
        "cov": np.tile(1e-6 * np.eye(2), (3, 1, 1)),
        "series": (Series("roll", "acc"),),
        "loop_error": np.full(3, np.nan),
        "baselines": (1,),
    }
    return History(**(parts | changes))  # type: ignore[arg-type]


def test_results_cannot_be_changed() -> None:
    """Neither a field nor an element of an array of a result can be set."""
    modes = two_modes()
    with pytest.raises(FrozenInstanceError):
        modes.names = ()  # type: ignore[misc]
    for array in (modes.ln_frequency, modes.cov, history().travel):
        with pytest.raises(ValueError, match="read-only"):
            array.flat[0] = 0.0


def test_modes_standard_deviations_are_first_order_of_the_logarithms() -> None:
    """The std of f and ζ is the value times the std of its logarithm; the correlation is kept."""
    modes = two_modes()
    std = np.sqrt(np.diag(modes.cov))
    np.testing.assert_allclose(modes.frequency, [120.0, 135.0])
    np.testing.assert_allclose(modes.frequency_std, [120.0, 135.0] * std[:2])
    np.testing.assert_allclose(modes.damping_ratio_std, [0.02, 0.03] * std[2:])
    expected = [modes.cov[0, 2] / std[0] / std[2], modes.cov[1, 3] / std[1] / std[3]]
    np.testing.assert_allclose(modes.correlation, expected)


def test_modes_refuse_wrong_shapes_and_a_name_twice_in_one_source() -> None:
    """A covariance of another size and a doubled name are refused; another source is another."""
    modes = two_modes()
    with pytest.raises(ValueError, match=r"shapes has shape \(2, 0\), needed \(2, 1\)"):
        replace(modes, shape_channels=("acc_0",))
    with pytest.raises(ValueError, match=r"cov has shape \(2, 2\), needed \(4, 4\)"):
        replace(modes, cov=np.eye(2))
    with pytest.raises(ValueError, match="not unique"):
        replace(modes, names=("roll", "roll"))
    assert replace(modes, names=("roll", "roll"), sources=("acc", "delta_e")).names[1] == "roll"


def test_log_refuses_a_bad_sample_rate_and_channels_of_different_length() -> None:
    """What would make every later number wrong is refused at birth."""
    for rate in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="sample_rate"):
            make_log({"acc_a": np.zeros(8)}, rate)
    with pytest.raises(ValueError, match=r"lengths \[8, 9\]"):
        make_log({"acc_a": np.zeros(8), "acc_b": np.zeros(9)}, 100.0, pieces=((0, 8),))
    with pytest.raises(ValueError, match="shape"):
        Channel("acc_a", "acceleration", np.zeros((2, 3)))
    assert isinstance(make_log({"acc_a": np.zeros(8)}, 100.0), Log)


def test_history_clock_starts_at_the_baseline() -> None:
    """The clock is the odometer since the baseline log, negative before it."""
    np.testing.assert_array_equal(history().clock(), [-2000.0, 0.0, 1000.0])


def test_history_refuses_a_baseline_that_is_not_there_and_wrong_shapes() -> None:
    """A baseline outside the logs and estimates of another shape are refused."""
    with pytest.raises(ValueError, match=r"baselines are logs \(3,\) of 3"):
        history(baselines=(3,))
    with pytest.raises(ValueError, match="ln_damping"):
        history(ln_damping=np.zeros((3, 2)))


def test_metadata_of_two_logs_do_not_share_their_covariates() -> None:
    """The default dictionary belongs to one log only."""
    assert Metadata().covariates is not Metadata().covariates


def test_bad_log_survives_the_way_back_from_a_worker() -> None:
    """Pickled and unpickled, the error still carries log, reason and detail."""
    error = pickle.loads(pickle.dumps(BadLog("a.h5", "corrupt", "cut off")))
    assert (error.log, error.reason, error.detail) == ("a.h5", "corrupt", "cut off")
    assert str(error) == "a.h5: corrupt: cut off"


def test_results_are_short_in_print_and_long_as_tables() -> None:
    """At most eight lines of text, HTML with names escaped, one row per log, mode or limit."""
    rng = np.random.default_rng(1)
    log = make_log({"acc_x": rng.standard_normal(1000), "acc_y": rng.standard_normal(1000)}, 500.0)
    lives = history()
    followed = track(lives)
    for result, rows, columns in (
        (log, 1000, "time_s acc_x_m_s2 acc_y_m_s2"),
        (two_modes(), 2, "mode source channel frequency_hz"),
        (lives, 3, "stage log recorded_at travel_km mode source frequency_hz"),
        (followed, 3, " ".join(TABLES["track"].names)),
        (make_health(rng.lognormal(-0.2, 0.02, (40, 2))), 2, " ".join(TABLES["health"].names)),
        (make_prognosis(np.linspace(1e5, 1e6, 11), np.full(11, 1e4)), 2, "parameter limit"),
    ):
        assert 1 <= len(repr(result).splitlines()) <= 8
        assert "array(" not in repr(result) and len(repr(result)) < 1500
        table = result.to_frame()
        assert len(table) == rows
        assert list(table)[: len(columns.split())] == columns.split()
        assert "recorded_at" not in table or str(table["recorded_at"].dt.tz) == "UTC"
    named = replace(lives, stage="<script>")
    assert "&lt;script&gt;" in named._repr_html_() and "<script>" not in named._repr_html_()
    np.testing.assert_allclose(lives.to_frame()["frequency_hz"], 100.0)
    np.testing.assert_allclose(lives.to_frame()["frequency_std_hz"], 0.1)
    many = replace(
        lives,
        modes=tuple("abcdefgh"),
        series=tuple(Series(mode, "acc") for mode in "abcdefgh"),
        ln_frequency=np.full((3, 8), 4.6),
        ln_damping=np.full((3, 8), -4.0),
        cov=np.tile(1e-6 * np.eye(16), (3, 1, 1)),
    )
    assert repr(many).splitlines()[-1] == "… and 3 more"


def test_columns_of_results_are_those_of_their_tables() -> None:
    """Frames have columns of the table of their result, in its order, or further ones of it."""
    draws = np.random.default_rng(1).lognormal(-0.2, 0.02, (40, 2))
    for name, result in (
        ("modes", two_modes()),
        ("track", track(history())),
        ("health", make_health(draws)),
        ("prognosis", make_prognosis(np.linspace(1e5, 1e6, 11), np.full(11, 1e4))),
    ):
        table, found = TABLES[name], list(result.to_frame())
        own = [column for column in found if column in table.names]
        further = {one.names.partition("<")[0] for one in table.further} - {""}
        assert all(str(c).startswith(tuple(further)) for c in found if c not in own)
        if name != "prognosis":  # its frame has the probabilities in another order
            assert own == [column for column in table.names if column in own]


def test_results_are_plotted_by_name() -> None:
    """Every result draws itself in given Axes; a name that it lacks is refused with its own."""
    rng = np.random.default_rng(2)
    lives = history()
    results = (
        (make_log({"acc_x": rng.standard_normal(1000)}, 500.0), "acc_x", "frequency in Hz"),
        (two_modes(), "", "natural frequency in Hz"),
        (lives, "roll", "odometer in km"),
        (track(lives), "roll", "odometer in km"),
        (make_health(rng.lognormal(-0.2, 0.02, (40, 2))), "guide_preload", "travel in km"),
        (make_prognosis(np.linspace(1e5, 1e6, 11), np.full(11, 1e4)), "any", "travel from now"),
    )
    for result, what, label in results:
        ax = Figure().add_subplot()
        assert result.plot(what, ax) is ax
        assert ax.get_xlabel().startswith(label) and ax.has_data()
    with pytest.raises(BadQuestion, match=r"nothing is called 'rol'; there are \['roll'\]"):
        lives.plot("rol")


def test_a_stage_and_an_assessment_print_in_a_few_lines() -> None:
    """What they are, and what they have; not their fields."""
    stage = load_stage("lms-y")
    text = (
        "Stage lms-y: modes roll 126.4 Hz, pitch 136.6 Hz, yaw 155 Hz; parameters guide_preload, "
    )
    assert repr(stage) == f"{text}mount_stiffness"
    found = repr(assess(examples.readings()[:2], stage, epochs=1)).splitlines()
    assert len(found) <= 8 and found[0].endswith(": not-enough-data")
    assert found[-1].startswith("2 logs, ") and "with history" in found[-1]
