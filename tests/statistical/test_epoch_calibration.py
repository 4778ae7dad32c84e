"""Calibration of health at one epoch on truths drawn from the stated priors.

The model is checked on grids, without the sampler; the chains are held to the grids on some truths,
and a guide that two machines share is checked by chains.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import stats

from lmshealth._private.arrays import FloatArray
from lmshealth._private.seeds import stream
from lmshealth.health.epoch_posterior import EpochPosterior
from lmshealth.health.inference import draw, infer_together
from lmshealth.stage.description import Stage, load_stage
from studies.harness.data.histories import map_std
from studies.harness.metrics import place
from studies.health.one_guide import SHARED, drifts_of
from tests.claims import Claims
from tests.lives import AXES, MODES, make_stage, true_drift
from tests.oracles import cdf_at
from tests.statistical.evidence import all_of, at_most, uniform

NAMES = ("guide_preload", "mount_stiffness")
COV = 4e-7 * (0.7 * np.eye(3) + 0.3)


def seen(rng: np.random.Generator, stage: Stage, x: FloatArray) -> FloatArray:
    """Drifts at ln parameters, by a map whose sensitivities are wrong, with noise."""
    wrong_by, drift = map_std(rng, stage), true_drift(NAMES, x)
    for j in range(2):
        alone = true_drift(NAMES, x * (np.arange(2) == j))
        drift = drift + wrong_by * rng.standard_normal(3) * alone
    return rng.multivariate_normal(drift, COV)


def marginals(posterior: EpochPosterior, x: FloatArray) -> list[float]:
    """Posterior probability below each true ln parameter, on a coarse and then a fine grid."""
    low, high = (np.log([AXES[name][k] for name in NAMES]) for k in (0, -1))
    for n in (61, 81, 81):
        axes = [np.linspace(a, b, n) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
        value = posterior.log_probability(grid).reshape(n, n)
        density = np.exp(value - value.max())
        likely = np.argwhere(density > 1e-7)
        first, last = likely.min(axis=0) - 1, likely.max(axis=0) + 1
        low = np.array([axis[max(k, 0)] for axis, k in zip(axes, first, strict=True)])
        high = np.array([axis[min(k, n - 1)] for axis, k in zip(axes, last, strict=True)])
    return [cdf_at(axes[j], density.sum(axis=1 - j), x[j]) for j in range(2)]


def test_health_is_calibrated(rng: np.random.Generator, claims: Claims, tmp_path: Path) -> None:
    """Preload and mount drawn from their priors, map wrong by 5 %.

    Control: on the same drifts a map that is taken as exact.
    """
    stage = make_stage(tmp_path / "honest", n_modes=3)
    proud = make_stage(tmp_path / "proud", n_modes=3, model_std=0.0)
    found, wrong = [], []
    for x in stage.prior.draw(rng, claims.trials):
        drift = seen(rng, stage, x)
        found.append(marginals(EpochPosterior.of(stage, MODES, drift, COV), x))
        wrong.append(marginals(EpochPosterior.of(proud, MODES, drift, COV), x))
    for j, name in enumerate(claims.part.claims):
        claims.claim(name, uniform(np.array(found)[:, j]))
        claims.control(name, uniform(np.array(wrong)[:, j]))


def test_chains_are_as_calibrated_as_grids(
    rng: np.random.Generator, claims: Claims, tmp_path: Path
) -> None:
    """On lives drawn alike the chains put as much below the truth as a grid does.

    Control: draws a quarter closer to their median.
    """
    stage = make_stage(tmp_path, n_modes=3)
    errors = []
    for k, x in enumerate(stage.prior.draw(rng, claims.trials)):
        posterior = EpochPosterior.of(stage, MODES, seen(rng, stage, x), COV)
        found = draw(posterior, stream(int(rng.integers(1 << 32)), k))
        middle = np.median(found.flat, axis=0)
        closer = middle + 0.75 * (found.flat - middle)
        level = np.array(marginals(posterior, x))
        spread = np.sqrt(level * (1 - level) / found.ess_bulk) + 1e-3
        errors.append([(np.mean(y < x, axis=0) - level) / spread for y in (found.flat, closer)])
    right, wrong = (np.abs(own).ravel() for own in np.moveaxis(np.array(errors), 1, 0))
    claims.claim("chains", all_of(2 * stats.norm.sf(right)))
    claims.control("chains", all_of(2 * stats.norm.sf(wrong)))


def test_the_fit_is_seldom_improbable(
    rng: np.random.Generator, claims: Claims, tmp_path: Path
) -> None:
    """Where the model is right at most one fit in a hundred lies below 1 %.

    Control: drifts that no parameters make.
    """
    stage = make_stage(tmp_path, n_modes=3)

    def improbable(n: int, off: float) -> int:
        below = 0
        for x in stage.prior.draw(rng, n):
            drift = seen(rng, stage, x) + off * np.array([1, -1, 1])
            posterior = EpochPosterior.of(stage, MODES, drift, COV)
            begin = stage.prior.draw(rng, 200)
            near = begin[np.argsort(-posterior.log_probability(begin))[:20]]
            near = np.concatenate([near + 0.05 * rng.standard_normal((20, 2)) for _ in range(20)])
            near = near[np.isfinite(posterior.log_probability(near))]
            below += posterior.fit(np.concatenate([near, x[None]])) < 0.01
        return below

    claims.claim("fit", at_most(improbable(claims.trials, 0.0), claims.trials, 0.01))
    few = claims.part.control
    claims.control("fit", at_most(improbable(few, 0.03), few, 0.01))


def test_a_shared_guide_is_calibrated(rng: np.random.Generator, claims: Claims) -> None:
    """Of an X and a Y machine with one guide, by the plants of `models`.

    Control: draws a quarter as far from their median.
    """
    x_stage, y_stage = load_stage("lms-x"), load_stage("lms-y")
    places, wrong = [], []
    for _ in range(claims.trials):
        (preload, mount_x), (_, mount_y) = np.exp(x_stage.prior.draw(rng, 2))
        machines = [
            (drifts_of(x_stage, preload, mount_x, rng), x_stage),
            (drifts_of(y_stage, preload, mount_y, rng), y_stage),
        ]
        found = infer_together(machines, [SHARED], int(rng.integers(1 << 32)))
        truth = np.log([preload, mount_x, mount_y])
        draws = np.log(found.samples[0])
        middle = np.median(draws, axis=0)
        places.append(place(draws, truth, rng))
        wrong.append(place(middle + 0.25 * (draws - middle), truth, rng))
    for j, name in enumerate(claims.part.claims):
        claims.claim(name, uniform(np.array(places)[:, j]))
        claims.control(name, uniform(np.array(wrong)[:, j]))
