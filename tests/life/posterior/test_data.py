"""Condensed histories: no information is lost, and the posterior of a life is the same."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from lmshealth.life import constants
from lmshealth.life.posterior.data import condense
from lmshealth.life.posterior.fit import fit_life
from lmshealth.life.posterior.likelihood import LifeLikelihood
from lmshealth.tracking.covariates import regressors
from lmshealth.tracking.history import Step
from tests.lives import (
    FREQUENCY,
    LAWS_ALONE,
    SENSITIVITY,
    awkward_history,
    make_history,
    make_stage,
    since,
)


def test_few_logs_are_left_as_they_are() -> None:
    """A history that is short enough is the same one."""
    history = awkward_history(np.random.default_rng(1))
    assert condense(history, len(history.logs)) is history


def test_neighbours_are_averaged_by_their_covariance() -> None:
    """Means and covariances are those of generalised least squares written out as one system."""
    history = awkward_history(np.random.default_rng(2), n=24)
    history = replace(history, steps=())
    short = condense(history, 8)
    assert len(short.logs) < 14
    r, start = len(history.series), 0
    for k, log in enumerate(short.logs):
        end = history.logs.index(log) + 1
        rows, values, blocks = [], [], []
        for own in range(start, end):
            y = np.r_[history.ln_frequency[own], history.ln_damping[own]]
            there = np.flatnonzero(np.isfinite(y))
            rows.append(np.eye(2 * r)[there])
            values.append(y[there])
            blocks.append(history.cov[own][np.ix_(there, there)])
        design, y = np.vstack(rows), np.concatenate(values)
        seen = design.any(axis=0)
        weight = np.linalg.inv(_block(blocks)) if blocks and y.size else np.empty((0, 0))
        found = np.r_[short.ln_frequency[k], short.ln_damping[k]]
        assert np.isfinite(found).tolist() == seen.tolist()
        if seen.any():
            normal = design[:, seen].T @ weight @ design[:, seen]
            mean = np.linalg.solve(normal, design[:, seen].T @ weight @ y)
            np.testing.assert_allclose(found[seen], mean, rtol=1e-9)
            own_cov = short.cov[k][np.ix_(seen, seen)]
            np.testing.assert_allclose(own_cov, np.linalg.inv(normal), rtol=1e-6)
        np.testing.assert_allclose(short.travel[k], history.travel[start:end].mean())
        start = end
    assert start == len(history.logs)


def _block(blocks: list[np.ndarray]) -> np.ndarray:
    from scipy.linalg import block_diag

    return np.asarray(block_diag(*blocks))


def test_baseline_last_log_and_steps_are_not_mixed() -> None:
    """The baseline, the last log and both sides of a step stay apart."""
    history = make_history(np.tile(np.log(FREQUENCY[:2]), (50, 1)), baseline=7)
    there = np.zeros(50, dtype=bool)
    there[30:41] = True
    steps = (since("regreasing", 20, 50), Step("servo", 30, there, name="soft"))
    short = condense(replace(history, steps=steps), 6)
    assert len(short.logs) < 18
    assert short.logs[short.baseline] == history.logs[7]
    assert short.travel[-1] == history.travel[-1]
    for old, new in zip(steps, short.steps, strict=True):
        assert (old.kind, old.name) == (new.kind, new.name)
        seen = {log for log, own in zip(history.logs, old.there, strict=True) if own}
        assert {log for log, own in zip(short.logs, new.there, strict=True) if own} <= seen
        # The log before a step closes a group, and the first that sees it opens one.
        assert history.logs[old.first - 1] == short.logs[new.first - 1]


def test_a_step_is_between_its_logs_in_a_condensed_life(tmp_path: Path) -> None:
    """Not between the means of the groups before and after it."""
    n, k = 450, 203
    history = make_history(np.tile(np.log(FREQUENCY[:2]), (n, 1)))
    data = LifeLikelihood.of(
        replace(history, steps=(since("step", k, n),)), make_stage(tmp_path)
    ).data
    assert len(data.history.logs) < n
    assert data.steps == (history.clock()[k - 1 : k + 1].mean(),)


def test_covariates_of_a_group_are_those_of_its_estimates(tmp_path: Path) -> None:
    """Daily cycles and temperatures are averaged over the logs that have an estimate.

    An estimate without a temperature is left out, but not after the last known temperature.
    """
    n, rng = 300, np.random.default_rng(4)
    temperature = 21 + rng.standard_normal(n)
    temperature[[40, 299]] = np.nan
    history = make_history(np.tile(np.log(FREQUENCY[:2]), (n, 1)), temperature=temperature)
    hours = [timedelta(hours=5 * k) for k in range(n)]
    history = replace(history, recorded_at=tuple(history.recorded_at[0] + h for h in hours))
    data = LifeLikelihood.of(history, make_stage(tmp_path)).data
    known, cos, _ = data.regressors
    assert [one.name for one in data.regressors[1:]] == [
        "temperature_c:day-cos",
        "temperature_c:day-sin",
    ]
    group = int(np.searchsorted([int(log[:3]) for log in data.history.logs], 40))
    last, before = (int(data.history.logs[k][:3]) for k in (group, group - 1))
    own = [k for k in range(before + 1, last + 1) if k != 40]
    assert len(own) == 1
    wave = regressors(history.covariates, data.stage, history.recorded_at)[1].values
    assert known.values[group] == pytest.approx(np.mean(temperature[own] - 21))
    assert cos.values[group] == pytest.approx(np.mean(wave[own]))
    assert np.flatnonzero(known.unknown).tolist() == [len(data.history.logs) - 1]
    assert np.isfinite(data.history.ln_frequency[-1]).all()


def test_the_daily_lag_is_in_the_covariance_of_a_life(tmp_path: Path) -> None:
    """Logs of one life at other times of the day have another covariance, by the cycles alone."""
    stage = make_stage(tmp_path)
    history = make_history(np.tile(np.log(FREQUENCY[:2]), (6, 1)), temperature=21 + np.arange(6.0))
    times = tuple(t + timedelta(hours=5 * k) for k, t in enumerate(history.recorded_at))
    one, other = (
        LifeLikelihood.of(own, stage).covariance.fixed
        for own in (history, replace(history, recorded_at=times))
    )
    waves = regressors(history.covariates, stage, times)[1:]
    added = sum(w.prior_std**2 * np.outer(w.values, w.values) for w in waves)
    np.testing.assert_allclose(other - one, np.kron(np.eye(2), added), atol=1e-12)
    assert np.abs(other - one).max() > 1e-7


@pytest.fixture(scope="module")
def lives(tmp_path_factory: pytest.TempPathFactory) -> tuple:
    """Return a stage and a worn life of 240 logs in two modes."""
    stage = make_stage(tmp_path_factory.mktemp("stage"), tail=LAWS_ALONE)
    rng = np.random.default_rng(5)
    travel = np.linspace(0.0, 3.0e6, 240)
    loss = np.column_stack([1 - 0.30 * travel / travel[-1], 1 - 0.12 * travel / travel[-1]])
    names = ("guide_preload", "mount_stiffness")
    drift = np.log(loss) @ np.array([SENSITIVITY[name][:2] for name in names])
    noise = 2e-3 * rng.standard_normal((240, 2))
    return stage, make_history(np.log(FREQUENCY[:2]) + drift + noise, travel=travel, std=2e-3)


@pytest.mark.slow
def test_a_condensed_life_has_the_same_posterior(lives: tuple) -> None:
    """Of 240 logs and of some 40 made of them, medians and widths of health agree."""
    stage, history = lives
    whole, short = (
        fit_life(own, stage, 0, chains=False) for own in (history, condense(history, 40))
    )
    for j in range(2):
        one, other = (
            np.quantile(life.health[..., j], (0.05, 0.5, 0.95)) for life in (whole, short)
        )
        width = one[2] - one[0]
        assert abs(one[1] - other[1]) < 0.15 * width
        assert 0.8 < (other[2] - other[0]) / width < 1.25


@pytest.mark.slow
def test_ten_thousand_logs_are_no_more_work_than_some_hundreds(lives: tuple) -> None:
    """The likelihood of a life holds no more rows than that of its condensed history."""
    stage, history = lives
    many = np.repeat(np.arange(240), 42)
    longer = make_history(
        history.ln_frequency[many], travel=np.linspace(0.0, 3.0e6, many.size), std=2e-3
    )
    times = tuple(sorted(history.recorded_at[0].replace(microsecond=0) for _ in many))
    likelihood = LifeLikelihood.of(replace(longer, recorded_at=times), stage)
    assert likelihood.data.y.size <= 2 * (constants.MAX_LOGS + 3)
    assert likelihood.data.now == longer.travel[-1] - longer.travel[0]
