"""What is shown of a machine: changes in percent, doubts in words, no number where none is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lmshealth.cli.machineview import print_health, print_track
from lmshealth.tracking.track import track
from tests.lives import DAMPING, FREQUENCY, make_health, make_history


def test_changes_are_percent_of_what_was_before(capsys: pytest.CaptureFixture[str]) -> None:
    """Half the frequency is 50 % less, not ln 2; a damping that nobody told is a dash."""
    ln_f = np.log(FREQUENCY[:1]) - np.log(2) * (np.arange(8) >= 4)[:, None]
    history = make_history(ln_f, ln_damping=np.full((8, 1), np.nan), std=1e-3)
    print_track(track(history))
    shown = capsys.readouterr().out
    assert "-50.0" in shown
    assert "-69.3" not in shown
    assert "–" in shown
    assert "nan" not in shown


def test_a_filter_that_is_too_cautious_is_not_said_to_be_widened(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Logs that vary less than they say ask for no missing cause."""
    ln_f = np.tile(np.log(FREQUENCY[:2]), (40, 1))
    ln_zeta = np.tile(np.log(DAMPING[:2]), (40, 1))
    print_track(track(make_history(ln_f, ln_damping=ln_zeta, std=1e-3)))
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 80
    shown = " ".join(shown.split())
    assert "does NOT agree" in shown
    assert "rather too wide" in shown
    assert "widened" not in shown


def test_health_that_did_not_converge_shows_no_interval(capsys: pytest.CaptureFixture[str]) -> None:
    """What was not found is no number; what stands at an edge or fits nothing is told."""
    sure = make_health(np.random.default_rng(1).lognormal(-0.2, 0.02, (40, 2)))
    print_health(sure)
    told = capsys.readouterr().out
    assert " to " in told
    assert "Correlation of guide_preload and mount_stiffness" in told
    nothing = np.full((1, 2), np.nan)
    lost = replace(
        sure, converged=np.array([False]), ess_bulk=nothing, ess_tail=nothing, r_hat=nothing,
        prior_shift=nothing, prior_ratio=nothing, laplace_shift=nothing, laplace_ratio=nothing,
        fit=np.array([1e-9]), at_edge=np.array([[True, False]]),
    )  # fmt: skip
    print_health(lost)
    told = capsys.readouterr().out
    assert "nan" not in told
    assert told.count("not converged") == 2
    assert max(map(len, told.splitlines())) <= 80
    assert "p = 1e-09): nothing is claimed" in " ".join(told.split())
    assert "guide_preload stands at the edge of the map" in told
    assert "mount_stiffness stands" not in told
    odd = replace(
        sure, laplace_shift=np.array([[0.9, 0.0]]), identifiable=np.array([[True, False]])
    )
    print_health(odd)
    told = " ".join(capsys.readouterr().out.split())
    assert "guide_preload: far from normal; Laplace's approximation lies +0.9 σ lower" in told
    assert "mount_stiffness: not identifiable" in told
