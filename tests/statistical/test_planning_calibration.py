"""Whether a test on simulated drifts has the power that was planned.

Logs of now and of the baseline are drawn as Gaussians, the other parameter from its prior, and the
loss is called by the information matrix with that prior. A share passes when its 99.9 %
Clopper-Pearson interval holds the planned one. Negative control: a plan that takes the baseline
for exact promises a power beyond the interval.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lmshealth.bounds import ambient_bound
from lmshealth.planning import plan
from lmshealth.stage import Stage
from tests.lives import DAMPING, FREQUENCY, SENSITIVITY, make_stage
from tests.oracles import binomial_band, planned_std

_N, _BASELINE, _SECONDS, _ALARM = 20_000, 5, 20.0, 0.01
_QUANTILE = 2.3263478740408408  # of the normal distribution at 99 %


def _called(rng: np.random.Generator, stage: Stage, loss: float, n_modes: int) -> int:
    """Count tests that call a loss of the mount, from single logs."""
    slopes = np.column_stack([SENSITIVITY[p.name][:n_modes] for p in stage.parameters])
    noise = np.array([_variance(k) for k in range(n_modes)])
    prior = stage.prior.draw(rng, 200_000)[:, 0]
    x = np.column_stack([rng.normal(0.0, prior.std(), _N), np.full(_N, np.log1p(-loss))])
    before = rng.normal(size=(_N, _BASELINE, n_modes)).mean(axis=1)
    drifts = x @ slopes.T + np.sqrt(noise) * (rng.normal(size=(_N, n_modes)) - before)
    cov = noise * (1 + 1 / _BASELINE)
    information = slopes.T @ (slopes / cov[:, None]) + np.diag([prior.var() ** -1, 0.0])
    estimates = np.linalg.solve(information, slopes.T @ (drifts / cov).T)[1]
    std = planned_std(slopes, cov, 1, prior_std=float(prior.std()))
    return int(np.count_nonzero(estimates < -_QUANTILE * std))


def _variance(mode: int) -> float:
    f, zeta = FREQUENCY[mode], DAMPING[mode]
    band = (f * (1 - 8 * zeta), f * (1 + 8 * zeta))
    return float(ambient_bound(f, zeta, 100.0, _SECONDS, band=band)[0, 0])


@pytest.mark.parametrize(("n_modes", "loss"), [(2, 0.05), (1, 0.22)])
def test_a_test_has_the_power_that_was_planned(
    rng: np.random.Generator, tmp_path: Path, n_modes: int, loss: float
) -> None:
    """Of two modes that tell the parameters apart, and of one where only the prior does."""
    stage = make_stage(tmp_path, n_modes=n_modes)
    found = plan(stage, "mount_stiffness", loss, false_alarm=_ALARM, durations=(_SECONDS,))
    planned = found.efforts[0].power
    assert 0.2 < planned < 0.98
    low, high = binomial_band(_called(rng, stage, loss, n_modes), _N)
    assert low <= planned <= high, f"planned {planned:.4f}, had {low:.4f} to {high:.4f}"
    low, high = binomial_band(_called(rng, stage, 0.0, n_modes), _N)
    assert low <= _ALARM <= high, f"false alarms {low:.4f} to {high:.4f}"


def test_a_plan_without_the_baseline_promises_too_much(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    """Negative control: an exact baseline gives a power that the test does not have."""
    stage = make_stage(tmp_path / "true")
    exact = make_stage(tmp_path / "exact", tail="[baseline]\nlogs = 1000000")
    found = plan(exact, "mount_stiffness", 0.04, false_alarm=_ALARM, durations=(_SECONDS,))
    assert found.efforts[0].power > binomial_band(_called(rng, stage, 0.04, 2), _N)[1]
