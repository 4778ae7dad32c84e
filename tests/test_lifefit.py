"""The posterior of a life: a grid as oracle, what it says of itself, and where it goes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import xarray

from lmshealth import life
from lmshealth.errors import NotConverged
from lmshealth.life import LifeLikelihood
from lmshealth.lifefit import LifePosterior, fit_life
from lmshealth.prognosis import prognose
from lmshealth.stage import Stage
from lmshealth.tracks import History
from studies.draws import draw as draw_points
from tests.lives import (
    FADING,
    FOOT,
    FREQUENCY,
    MOUNT,
    PRELOAD,
    make_history,
    make_stage,
    true_drift,
)


@pytest.fixture(scope="module", autouse=True)
def small_grid() -> Iterator[None]:
    """Average over two walks and one noise scale: checks hold for any of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(life, "_WALKS", (1e-5, 1.5e-3))
        patch.setattr(life, "_NOISE_SCALES", (1.0,))
        patch.setattr(life, "_NOISE_SCALE_PRIOR", (1.0,))
        yield


@pytest.fixture(scope="module")
def stage(small_grid: None, tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Wear of the preload and loosening of the mount, seen by two modes."""
    return make_stage(tmp_path_factory.mktemp("stage"), (PRELOAD, MOUNT))


@pytest.fixture(scope="module")
def history() -> History:
    """Make a life of 12 logs: preload for 8,000 km, the mount settling to 0.8 within 1,500."""
    travel = np.linspace(0.0, 2.5e6, 12)
    preload = (1 - travel / 8e6) ** 1.5
    mount = 0.8 + 0.2 * np.exp(-travel / 1.5e6)
    drift = true_drift(("guide_preload", "mount_stiffness"), np.log([preload, mount]).T)[:, :2]
    noise = 5e-4 * np.random.default_rng(1).standard_normal((12, 2))
    return make_history(np.log(FREQUENCY[:2]) + drift + noise, travel=travel, std=5e-4)


@pytest.fixture(scope="module")
def found(history: History, stage: Stage) -> LifePosterior:
    """Its posterior."""
    return fit_life(history, stage, (3, 4))


def test_laws_and_health_are_those_of_importance_sampling(
    found: LifePosterior, history: History, stage: Stage
) -> None:
    """Quantiles have the right share of independent draws below them, within their error."""
    likelihood = LifeLikelihood(history, stage)
    rng = np.random.default_rng(5)
    y = draw_points(likelihood.log_probability, likelihood.draw_prior, rng, 4000)
    assert y is not None
    health = likelihood.health(y, np.array([likelihood.now]))[:, 0]
    wear = likelihood.laws[0].natural(y[:, :2], likelihood.now)
    known = np.column_stack([health, wear])
    draws = np.concatenate([found.health, found.chains[..., :2]], axis=2).reshape(-1, 4)
    for level in (0.1, 0.5, 0.9):
        share = np.mean(known < np.quantile(draws, level, axis=0), axis=0)
        # A thousand independent draws are asked of the sampling.
        assert (np.abs(share - level) < 4.5 * np.sqrt(level * (1 - level) / 1000)).all()
    share = np.mean(known < np.quantile(draws, 0.5, axis=0) * 1.01, axis=0)
    assert (np.abs(share - 0.5) > 0.1).any()  # negative control: 1 % off


def test_a_life_says_what_it_rests_on(found: LifePosterior) -> None:
    """Names, convergence, what is informed, and the trade-off of preload and mount."""
    assert found.parameters == ("guide_preload", "mount_stiffness")
    assert found.laws == (
        "guide_preload.life_m",
        "guide_preload.exponent",
        "mount_stiffness.floor",
        "mount_stiffness.life_m",
    )
    assert found.columns == ((0, 1), (2, 3))
    assert found.seed == (3, 4)
    assert found.worst_r_hat < 1.01
    assert found.ess > 1000
    assert found.informed[0] > 0.9
    assert found.informed[1] < found.informed[0]
    assert found.correlation[0, 1] < -0.5
    np.testing.assert_array_equal(found.theta(1), found.chains[..., 2:].reshape(-1, 2))
    ratio = found.chi_square / found.degrees_of_freedom
    assert 0.2 < ratio < 2.5
    assert found.degrees_of_freedom == 24 - 4


def test_a_prognosis_is_of_the_same_draws(
    found: LifePosterior, history: History, stage: Stage
) -> None:
    """Health now of the prognosis is that of the fitted life, draw by draw."""
    told = prognose(history, stage, (3, 4))
    np.testing.assert_allclose(told.health, found.health.reshape(-1, 2), rtol=1e-12)
    assert told.ess == found.ess


def test_the_seed_alone_decides(found: LifePosterior, history: History, stage: Stage) -> None:
    """The same seed gives the same chains, another one others."""
    np.testing.assert_array_equal(fit_life(history, stage, (3, 4)).chains, found.chains)
    assert not np.array_equal(fit_life(history, stage, (3, 5)).chains, found.chains)


def test_laws_without_parameters_have_no_draws_of_them(history: History, tmp_path: Path) -> None:
    """An unchanging foot adds health of one, and nothing to what is fitted."""
    only = fit_life(history, make_stage(tmp_path / "one", (FADING, FOOT)), 1)
    assert only.columns == ((0,), ())
    assert (only.health[..., 1] == 1).all()
    nothing = fit_life(history, make_stage(tmp_path / "none", (FOOT,)), 1)
    assert nothing.laws == ()
    assert nothing.ess == np.inf
    assert nothing.worst_r_hat == 1


def test_a_life_goes_to_arviz_and_back(found: LifePosterior, tmp_path: Path) -> None:
    """NetCDF keeps laws and health by ensemble."""
    found.to_arviz().to_netcdf(tmp_path / "life.nc", engine="h5netcdf")
    tree = xarray.open_datatree(tmp_path / "life.nc", engine="h5netcdf")
    draws = tree["posterior/guide_preload.life_m"]
    assert draws.dims == ("chain", "draw")
    np.testing.assert_array_equal(draws.to_numpy(), found.chains[..., 0])
    np.testing.assert_array_equal(tree["posterior/mount_stiffness"], found.health[..., 1])
    assert float(tree["checks_data/chi_square"]) == found.chi_square


def test_a_life_is_a_table(found: LifePosterior) -> None:
    """Laws with their checks, then health now, one row each."""
    table = found.to_frame().set_index("parameter")
    assert list(table.index) == [*found.laws, *found.parameters]
    assert table.loc["guide_preload", "median"] == np.median(found.health[..., 0])
    assert table.loc["guide_preload.life_m", "informed"] == found.informed[0]
    assert (table["q05"] < table["q95"]).all()


def test_no_life_without_convergence(
    history: History, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sampler that stops too soon is refused with its chains."""
    monkeypatch.setattr("lmshealth.sampling._FIRST_STEPS", 40)
    monkeypatch.setattr("lmshealth.sampling._MOST_STEPS", 40)
    with pytest.raises(NotConverged, match="after 40 steps") as caught:
        fit_life(history, stage, 1)
    assert np.shape(caught.value.chains) == (4, 40, 64, 4)
