"""Whether a test on simulated drifts has the power that was planned.

Logs of now and of the baseline are drawn as Gaussians, the other parameter from its prior, and the
loss is called by the information matrix with that prior, or by the posterior itself.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import stats

from lmshealth.stage.description import Stage
from lmshealth.stage.identifiability import ambient_bound, identifiability_of, plan
from studies.health.detectability import FALSE_ALARM, POWER, called, stage_with
from tests.claims import Claims
from tests.lives import DAMPING, FREQUENCY, MOUNT, PRELOAD, SENSITIVITY, make_stage
from tests.oracles import planned_std
from tests.statistical.evidence import as_often, at_most

_BASELINE, _SECONDS, _ALARM = 5, 20.0, 0.01
_PARAMETER = "guide_preload"


def _called(
    rng: np.random.Generator, stage: Stage, loss: float, n_modes: int, n: int, alarm: float = _ALARM
) -> int:
    """Count tests that call a loss of the mount, from single logs."""
    slopes = np.column_stack([SENSITIVITY[p.name][:n_modes] for p in stage.parameters])
    noise = np.array([_variance(k) for k in range(n_modes)])
    prior = stage.prior.draw(rng, 200_000)[:, 0]
    x = np.column_stack([rng.normal(0.0, prior.std(), n), np.full(n, np.log1p(-loss))])
    before = rng.normal(size=(n, _BASELINE, n_modes)).mean(axis=1)
    drifts = x @ slopes.T + np.sqrt(noise) * (rng.normal(size=(n, n_modes)) - before)
    cov = noise * (1 + 1 / _BASELINE)
    information = slopes.T @ (slopes / cov[:, None]) + np.diag([prior.var() ** -1, 0.0])
    estimates = np.linalg.solve(information, slopes.T @ (drifts / cov).T)[1]
    std = planned_std(slopes, cov, 1, prior_std=float(prior.std()))
    return int(np.count_nonzero(estimates < -stats.norm.isf(alarm) * std))


def _variance(mode: int) -> float:
    f, zeta = FREQUENCY[mode], DAMPING[mode]
    band = (f * (1 - 8 * zeta), f * (1 + 8 * zeta))
    return float(ambient_bound(f, zeta, 100.0, _SECONDS, band=band)[0, 0])


def test_a_test_has_the_power_that_was_planned(
    rng: np.random.Generator, claims: Claims, tmp_path: Path
) -> None:
    """Of two modes that tell the parameters apart, and of one where only the prior does.

    Controls: an exact baseline, and a preload known to 20 instead of 30 %, promise another power;
    a threshold at 95 % calls more.
    """
    exact, known = "[baseline]\nlogs = 1000000", PRELOAD.replace("sigma = 0.3", "sigma = 0.2")
    for n_modes, loss, words in ((2, 0.05, "two modes"), (1, 0.22, "one mode")):
        stage = make_stage(tmp_path / f"true {n_modes}", n_modes=n_modes)
        other = tmp_path / f"other {n_modes}"
        if n_modes == 2:
            wrong = make_stage(other, n_modes=2, tail=exact)
        else:
            wrong = make_stage(other, (known, MOUNT), n_modes=1)
        true, promised = (
            plan(one, "mount_stiffness", loss, false_alarm=_ALARM, durations=(_SECONDS,))
            .efforts[0]
            .power
            for one in (stage, wrong)
        )
        assert 0.2 < true < 0.98
        hits = _called(rng, stage, loss, n_modes, claims.trials)
        claims.claim(f"power, {words}", as_often(hits, claims.trials, true))
        claims.control(f"power, {words}", as_often(hits, claims.trials, promised))
        false = _called(rng, stage, 0.0, n_modes, claims.trials)
        claims.claim(f"false alarms, {words}", as_often(false, claims.trials, _ALARM))
        rash = _called(rng, stage, 0.0, n_modes, claims.trials, 0.05)
        claims.control(f"false alarms, {words}", as_often(rash, claims.trials, _ALARM))


def test_the_posterior_has_the_power_that_was_planned(
    rng: np.random.Generator, claims: Claims
) -> None:
    """Of single logs of 20 s before and now, on the Y stage, with its map exact.

    Controls: the loss that would do with a baseline of 100,000 logs, and a machine that has lost
    half as much as is planned, taken for a sound one.
    """
    stage = stage_with("lms-y", model_std=0.0)
    variance = identifiability_of(stage).drift_variance(_SECONDS, 1, 1)
    planned, promised = (
        plan(stage_with("lms-y", baseline=n), _PARAMETER, 0.05, power=POWER,
             false_alarm=FALSE_ALARM, durations=(_SECONDS,)).efforts[0].smallest_loss
        for n in (1, 100_000)
    )  # fmt: skip

    def calls(loss: float) -> int:
        return sum(
            called(stage, _PARAMETER, loss, variance, True, rng) for _ in range(claims.trials)
        )

    claims.claim("power, posterior", as_often(calls(planned), claims.trials, POWER))
    claims.control("power, posterior", as_often(calls(promised), claims.trials, POWER))
    claims.claim("false alarms, posterior", at_most(calls(0.0), claims.trials, FALSE_ALARM))
    claims.control(
        "false alarms, posterior", at_most(calls(planned / 2), claims.trials, FALSE_ALARM)
    )
