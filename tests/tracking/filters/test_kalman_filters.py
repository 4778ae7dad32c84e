"""The bank of filters equals textbook filters, for one setting and for their mixture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import softmax

from lmshealth._private.arrays import BoolArray
from lmshealth.stage.description import Stage
from lmshealth.tracking import constants
from lmshealth.tracking.filters.kalman_filters import (
    FilterBank,
    initial,
    predict,
    update,
)
from lmshealth.tracking.filters.state_space import Hyperparameters, StateSpace, hyperparameter_grid
from lmshealth.tracking.history import History
from tests.lives import PRELOAD, TWO, awkward_history, make_stage, rough_history
from tests.oracles import Followed, Known, Wander, batch, filterpy_loop, kalman

KNOWN = Known((("temperature_c", 21.0, 0.001, 0.0001), ("payload_kg", 50.0, 0.0005, 0.0)))
ALONE = Known((("temperature_c", 21.0, 0.001, 0.0001),))
SETTINGS = [
    Wander(1e-3, 0.3, 0.1, {"acc": 1.0, "delta_e": 1.5}),
    Wander(1e-5, 0.0, 0.0, {"acc": 2.25, "delta_e": 0.5}),
    Wander(1e-2, 1.0, 3.0, {"acc": 0.5, "delta_e": 4.0}, 0.0, 2.0, 0.8),
    Wander(1e-4, 1.1, 0.0, {"acc": 1.0, "delta_e": 0.7}, 37.5, 0.7, 0.5),
    Wander(1e-3, 0.03, 0.1, {"acc": 1.0, "delta_e": 1.5}, 0.0, 0.7, 0.5, 4e-3),
]
ORACLES = {"filterpy": filterpy_loop, "textbook": kalman, "joint Gaussian": batch}


@pytest.fixture
def trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take no estimate for an outlier, as textbook filters do."""
    monkeypatch.setattr(constants, "OUTLIER_GATE", np.inf)


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduce the grid to three noise scales, with a wander and without."""
    monkeypatch.setattr(constants, "SOURCE_NOISE_SCALES", ((0.7, 0.2), (1.0, 0.6), (1.5, 0.2)))
    monkeypatch.setattr(constants, "WANDERS", ((0.0, 0.0, 0.7), (2.0, 6.0, 0.3)))


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Two modes, temperature with a curvature and payload as covariates."""
    return make_stage(tmp_path_factory.mktemp("stage"), (PRELOAD,), tail=TWO)


def one(wander: Wander, sources: tuple[str, ...]) -> Hyperparameters:
    """Convert a setting of the oracles to a grid of one."""
    scales = np.array([[wander.scales[source] for source in sources]])
    return Hyperparameters(
        np.array([wander.level]),
        np.array([wander.rate]),
        np.array([wander.bend]),
        scales,
        np.zeros(1),
        np.array([wander.decay]),
        np.array([wander.size]),
        np.array([wander.keep]),
        np.array([wander.settling]),
        np.zeros(1, dtype=int),
    )


def run(
    history: History, stage: Stage, grid: Hyperparameters | None = None
) -> list[tuple[FilterBank, float]]:
    """Filter all logs and keep the bank and the NIS after each."""
    space = StateSpace(history, stage, history.steps)
    space.grid = grid or space.grid
    at, kept = initial(space), []
    for k in range(len(history.logs)):
        at, innovation = update(space, predict(space, at, k), k)
        kept.append((at, innovation.nis))
    return kept


def followed_by(history: History, stage: Stage, wander: Wander) -> Followed:
    """Filter with the bank under one setting; return what the oracles return."""
    space = StateSpace(history, stage, history.steps)
    m = space.n_modes
    c = np.zeros((3, m, space.size))
    c[0, :, space.level] = c[1, :, space.damping] = c[2, :, space.level] = np.eye(m)
    c[2, :, space.base] = -np.eye(m)
    kept = run(history, stage, one(wander, space.sources))
    return Followed(
        np.array([c @ at.mean[0] for at, _ in kept]),
        np.array([np.einsum("pia,ab,qjb->piqj", c, at.cov[0], c) for at, _ in kept]),
        np.array([at.log_evidence for at, _ in kept]),
        np.array([nis for _, nis in kept]),
    )


def furthest(found: Followed, book: Followed, judged: BoolArray) -> float:
    """Return the largest deviation of means and covariances in the oracle's std."""
    variance = np.einsum("kpipi->kpi", book.cov)
    # A drift has no variance at its baseline: what differs there differs in units of ln f.
    std = np.sqrt(np.maximum(variance, 1e-2 * variance[:, :1]))
    mean = np.abs(found.mean - book.mean) / std
    cov = np.abs(found.cov - book.cov) / (std[:, :, :, None, None] * std[:, None, None])
    return float(max(mean[judged].max(), cov[judged].max()))


@pytest.mark.usefixtures("trusted")
@pytest.mark.parametrize("oracle", ORACLES)
@pytest.mark.parametrize("wander", SETTINGS)
def test_one_setting_is_the_textbook_filter(stage: Stage, wander: Wander, oracle: str) -> None:
    """Means, covariances, evidence and NIS are those of every oracle, to 1e-10 of the std."""
    history = awkward_history(np.random.default_rng(1))
    found, book = followed_by(history, stage, wander), ORACLES[oracle](history, wander, KNOWN)
    # Before the first baseline nobody says what a drift is.
    judged = np.arange(len(history.logs)) >= history.baselines[0]
    assert furthest(found, book, judged) < 1e-10
    np.testing.assert_allclose(found.log_evidence, book.log_evidence, rtol=1e-10, atol=1e-9)
    if oracle != "joint Gaussian":
        np.testing.assert_allclose(found.nis, book.nis, rtol=1e-9, atol=1e-10)


@pytest.mark.usefixtures("trusted")
def test_another_setting_is_told_from_it(stage: Stage) -> None:
    """Negative control: the filter with another setting or other steps differs."""
    history = awkward_history(np.random.default_rng(1))
    found, judged = followed_by(history, stage, SETTINGS[0]), np.arange(len(history.logs)) >= 1
    assert furthest(found, kalman(history, SETTINGS[2], KNOWN), judged) > 0.1
    for j in range(len(history.steps)):
        fewer = replace(history, steps=history.steps[:j] + history.steps[j + 1 :])
        assert furthest(found, kalman(fewer, SETTINGS[0], KNOWN), judged) > 0.01


def every() -> list[Wander]:
    """Return all settings of the grid as the oracles take them."""
    grid = hyperparameter_grid(1)
    return [
        Wander(
            float(own.level_walk[0]),
            float(own.rate_std[0]),
            float(own.rate_walk[0]),
            {"acc": float(own.scales[0, 0])},
            float(own.rate_decay[0]),
            float(own.wander[0]),
            float(own.wander_keep[0]),
            float(own.settling[0]),
        )
        for own in (grid[[g]] for g in range(grid.rate_std.size))
    ]


@pytest.mark.usefixtures("trusted", "few")
@pytest.mark.slow
def test_averaging_keeps_the_law_of_total_variance(stage: Stage) -> None:
    """Mean and covariance over the grid are those of the mixture weighted by evidence so far."""
    history = rough_history(np.random.default_rng(4))
    space = StateSpace(history, stage)
    books = [kalman(history, wander, ALONE) for wander in every()]
    log_weight = hyperparameter_grid(1).log_prior[:, None] + [book.log_evidence for book in books]
    kept = run(history, stage)
    between = 0.0
    for k, (at, _) in enumerate(kept):
        mean, cov = at.collapse()
        weight = softmax(log_weight[:, k])
        own = np.array([book.mean[k, 0] for book in books])
        off = own - weight @ own
        spread = np.einsum("g,gi,gj->ij", weight, off, off)
        within = np.einsum("g,gij->ij", weight, [book.cov[k, 0, :, 0, :] for book in books])
        total = within + spread
        std = np.sqrt(np.diag(total))
        assert np.abs((mean[space.level] - weight @ own) / std).max() < 1e-10
        level = cov[space.level, space.level]
        assert np.abs((level - total) / np.outer(std, std)).max() < 1e-10
        np.testing.assert_allclose(at.weight, weight, rtol=1e-8, atol=1e-12)
        between = max(between, float((np.diag(spread) / np.diag(total)).max()))
    assert between > 0.01  # the settings do differ


@pytest.mark.usefixtures("trusted", "few")
@pytest.mark.slow
def test_evidence_of_a_drift_is_that_of_one_group_over_the_other(stage: Stage) -> None:
    """The Bayes factor is the mean evidence with a rate over the mean evidence without one."""
    history = rough_history(np.random.default_rng(5))
    evidence = np.array([kalman(history, w, ALONE).log_evidence[-1] for w in every()])
    grid = hyperparameter_grid(1)
    groups = [
        np.logaddexp.reduce(evidence[own] + grid.log_prior[own])
        - np.logaddexp.reduce(grid.log_prior[own])
        for own in (~grid.healthy, grid.healthy)
    ]
    at, _ = run(history, stage)[-1]
    assert at.log_bayes_factor() == pytest.approx(groups[0] - groups[1], abs=1e-8)
    assert at[grid.healthy].log_bayes_factor() == 0.0


def test_pruning_changes_next_to_nothing(stage: Stage) -> None:
    """Pruning below 1e-7 of the group's best changes nothing by a thousandth of a std.

    Negative control: pruning all but the most probable does.
    """
    history = rough_history(np.random.default_rng(6), n=60)
    space = StateSpace(history, stage)
    banks = [initial(space) for _ in range(3)]
    moved, narrowed, poorest, least = np.zeros(60), np.zeros(60), np.zeros(60), 10**6
    for k in range(60):
        banks = [update(space, predict(space, at, k), k)[0] for at in banks]
        banks[1] = banks[1].pruned()
        banks[2] = banks[2][banks[2].log_weight == banks[2].log_weight.max()]
        (mean, cov), (pruned, own), (poor, _) = (at.collapse() for at in banks)
        std = np.sqrt(np.maximum(np.diag(cov), 1e-12))
        moved[k] = np.abs((pruned - mean) / std).max()
        narrowed[k] = np.abs(np.sqrt(np.maximum(np.diag(own), 1e-12)) / std - 1).max()
        poorest[k] = np.abs((poor - mean) / std).max()
        least = min(least, banks[1].weight.size)
        healthy = banks[1].hyperparameters.healthy
        assert healthy.any() and not healthy.all()
    assert max(moved.max(), narrowed.max()) < 1e-3
    assert poorest.max() > 0.1
    assert least < hyperparameter_grid(1).rate_std.size / 2


def test_the_prior_of_the_settings_adds_up() -> None:
    """Probabilities sum to one, a tenth of them healthy, for any number of sources."""
    for n_sources in (1, 2, 3, 5):
        grid = hyperparameter_grid(n_sources)
        share = np.exp(grid.log_prior)
        assert share.sum() == pytest.approx(1.0)
        assert share[grid.healthy].sum() == pytest.approx(constants.HEALTHY_PROBABILITY)
        assert (grid.rate_walk[grid.healthy] == 0).all()
        assert grid.scales.shape == (share.size, n_sources)
        # Sources past the third have no factor of their own.
        assert (grid.scales[:, 3:] == grid.scales[:, 2:3]).all() or n_sources <= 3


def test_banks_are_immutable(stage: Stage) -> None:
    """Predicting and updating, or padding, leaves the given bank unchanged."""
    history = rough_history(np.random.default_rng(7))
    space = StateSpace(history, stage)
    at = initial(space)
    before = at.mean.copy(), at.cov.copy(), at.log_weight.copy()
    for other in (at, at.padded(at.mean.shape[1])):
        update(space, predict(space, other, 0), 0)
    for was, now in zip(before, (at.mean, at.cov, at.log_weight), strict=True):
        np.testing.assert_array_equal(was, now)
    longer = at.padded(at.mean.shape[1] + 2)
    assert (longer.mean[:, -2:] == 0).all()
    assert (longer.cov[:, -2:] == 0).all() and (longer.cov[:, :, -2:] == 0).all()


def test_outliers_have_next_to_no_weight(stage: Stage) -> None:
    """An outlier of any size moves ln f by less than a third of its std, and costs evidence."""
    history = rough_history(np.random.default_rng(8))
    space = StateSpace(history, stage)
    space.grid = one(SETTINGS[0], ("acc",))
    at = initial(space)
    for k in range(3):
        at, _ = update(space, predict(space, at, k), k)
    predicted, level = predict(space, at, 5), space.level
    std = float(np.sqrt(predicted.cov[0, 0, 0]))
    moved, weight = [], []
    for size in (0.0, 0.05, 0.2):
        ln_f = history.ln_frequency.copy()
        ln_f[5, 0] = predicted.mean[0] @ space.matrix(5)[0] + size
        off = StateSpace(replace(history, ln_frequency=ln_f), stage)
        after, innovation = update(off, predicted, 5)
        moved.append(abs(after.mean[0] - predicted.mean[0])[level][0] / std)
        weight.append(after.log_weight[0])
        assert innovation.rows.tolist() == [0, 1, 2, 3]
        assert (innovation.outlying > 0.5).tolist() == [size > 0, False, size > 0, False]
    assert max(moved) < 0.3
    # What an outlier costs is bounded: it does not weigh the settings.
    assert weight[0] - 20 < weight[2] < weight[1] + 0.1 < weight[0]


def test_a_log_without_estimates_changes_nothing(stage: Stage) -> None:
    """A log without estimates leaves the bank unchanged and has no innovation."""
    history = rough_history(np.random.default_rng(9))
    space = StateSpace(history, stage)
    before = initial(space)
    at, innovation = update(space, before, 4)
    assert innovation.rows.size == 0 and innovation.nis == 0
    np.testing.assert_array_equal(at.mean, before.mean)
    np.testing.assert_array_equal(at.log_weight, before.log_weight)


@pytest.mark.slow
def test_covariances_stay_positive_and_symmetric(stage: Stage) -> None:
    """Covariances of all settings are symmetric without notably negative eigenvalues."""
    at, _ = run(awkward_history(np.random.default_rng(10), n=40), stage)[-1]
    assert hyperparameter_grid(2).rate_std.size == at.weight.size
    np.testing.assert_allclose(at.cov, np.swapaxes(at.cov, 1, 2), rtol=0, atol=1e-15)
    assert np.linalg.eigvalsh(at.cov).min() > -1e-13
