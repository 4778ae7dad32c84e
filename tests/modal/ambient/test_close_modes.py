"""Modes too close to be told apart: refused by name, or one for both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lmshealth.modal.ambient.close_modes import keep_separate
from lmshealth.modal.ambient.cluster_fit import BandFit
from lmshealth.modal.identification import identify
from tests.bands import RATE, both, found
from tests.signals import Mode, acceleration_log, make_stage


def brought_to(apart: float, fit: BandFit, shapes: list[list[float]]) -> BandFit:
    """Move the second mode so many half-power bandwidths above the first, with these shapes."""
    estimate = fit.estimate.copy()
    estimate[2:] = np.log(0.02)
    estimate[1] = estimate[0] + np.log1p(2 * 0.02 * apart)
    return replace(fit, estimate=estimate, shapes=np.array(shapes).T)


ALIKE, UNLIKE = [[1.0, 0.5], [1.0, 0.45]], [[1.0, 0.5], [0.5, -1.0]]


@pytest.mark.parametrize(
    ("apart", "shapes", "close"),
    [
        (1.2, ALIKE, False),
        (0.9, ALIKE, True),
        (0.3, UNLIKE, False),
        (0.1, UNLIKE, True),
    ],
)
def test_modes_are_close_within_a_bandwidth_unless_their_shapes_differ(
    apart: float, shapes: list[list[float]], close: bool
) -> None:
    """What is too close is refused by name, with both frequencies and where they stand together."""
    fit = brought_to(apart, found(both()), shapes)
    kept, missing = keep_separate(fit, known=True)
    assert (set(missing) == {"roll", "pitch"}) is close
    assert (len(kept.targets) == 0) is close
    if close:
        reason, detail = missing["roll"]
        assert reason == "too-close"
        assert f"{np.exp(fit.estimate[0]):.5g}" in detail


def test_what_was_not_sought_by_name_is_left_as_one() -> None:
    """One mode for both, half of their distance in its standard deviation, and flagged."""
    fit = brought_to(0.5, found(both()), ALIKE)
    kept, missing = keep_separate(fit, known=False)
    assert missing == {}
    assert [t.name for t in kept.targets] == ["roll"]
    assert kept.flags == ("cluster",)
    assert kept.estimate[0] == pytest.approx(fit.estimate[:2].mean())
    half = (fit.estimate[1] - fit.estimate[0]) / 2
    own = (fit.cov[0, 0] + fit.cov[1, 1] + 2 * fit.cov[0, 1]) / 4
    assert kept.cov[0, 0] == pytest.approx(own + half**2)
    assert kept.cov.shape == (2, 2)


@pytest.mark.slow
def test_modes_at_one_place_in_one_channel_are_refused_and_not_guessed() -> None:
    """Of 8 records of two modes half a bandwidth apart none gives both by name."""
    modes = [Mode(120.0, 0.02), Mode(122.4, 0.02)]
    stage = make_stage([("roll", 120.0, 0.02), ("pitch", 122.4, 0.02)])
    for seed in range(8):
        log = acceleration_log(np.random.default_rng(seed), modes, 60.0, RATE, 6.25)
        result = identify(log, stage)
        assert len(result.names) < 2
        assert {r.reason for r in result.refused} <= {"too-close", "ambiguous", "not-identified"}


@pytest.mark.slow
def test_modes_that_channels_see_differently_are_told_apart_at_one_place() -> None:
    """A third of a bandwidth apart both are found, in order, within 4σ."""
    modes = [Mode(120.0, 0.02, 1.0, (1.0, 0.6, -0.4)), Mode(121.5, 0.02, 1.0, (0.5, -1.0, 0.7))]
    stage = make_stage([("roll", 120.0, 0.02), ("pitch", 121.5, 0.02)])
    for seed in range(6):
        log = acceleration_log(np.random.default_rng(seed), modes, 60.0, RATE, 6.25)
        result = identify(log, stage)
        assert result.names == ("roll", "pitch")
        off = (result.ln_frequency - np.log([120.0, 121.5])) / np.sqrt(np.diag(result.cov)[:2])
        assert np.abs(off).max() < 4
