"""First passage of health that wanders about its law: closed forms, bridges and brute force."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.stats.distributions import rv_frozen

from lmshealth._private.arrays import FloatArray
from lmshealth.life.posterior.scenarios import DegradationPath
from lmshealth.life.prognosis import first_passage
from lmshealth.stage.degradation_laws import AnyLaw, Free, HertzWear, Linear, Loosening, Unchanging
from lmshealth.stage.priors import Lognormal, Normal, Uniform
from tests.oracles import binomial_band

NOW, HORIZON = 1e6, 1.2e7
N = 20_000
# With a floor of 0 ln health falls by s / s_m: a Wiener process with a drift.
FALLING = Loosening(life_km=Lognormal(4000, 1.0), floor=Uniform(0.0, 1.0))
LIFE = 5e6
WEAR = HertzWear(life_km=Lognormal(8000, 1.0))
LINEAR = Linear(rate_per_km=Normal(0.0, 2e-4))


def draw(
    path: DegradationPath,
    natural: tuple[float, ...],
    *,
    off: float,
    rate: float,
    limit: float,
    rng: np.random.Generator | None = None,
) -> FloatArray:
    """Draw many passages of one life."""
    return first_passage(
        path,
        np.tile(natural, (N, 1)),
        np.full(N, off),
        np.full(N, rate),
        rng or np.random.default_rng(1),
        now=NOW,
        limit=limit,
        horizon=HORIZON,
    )


def follows(found: FloatArray, book: rv_frozen) -> bool:
    """Whether passages up to the horizon, and how many there are, are those of a distribution."""
    reached, share = found[np.isfinite(found)], float(book.cdf(HORIZON))
    low, high = binomial_band(reached.size, found.size)
    level = book.cdf(reached) / share
    return bool(low <= share <= high and stats.kstest(level, "uniform").pvalue > 1e-3)


def inverse_gaussian(above: float, rate: float, life: float = LIFE) -> rv_frozen:
    """Return the first passage of a Wiener process with the drift 1 / life."""
    mean, shape = above * life, above**2 / rate
    return stats.invgauss(mean / shape, scale=shape)


class NoBridge:
    """Random numbers by which no bridge ever touches its limit."""

    def __init__(self) -> None:
        self._rng = np.random.default_rng(1)

    def standard_normal(self, size: tuple[int, ...]) -> FloatArray:
        """Draw as a generator does."""
        return self._rng.standard_normal(size)

    def wald(self, mean: FloatArray, scale: FloatArray) -> FloatArray:
        """Draw as a generator does."""
        return self._rng.wald(mean, scale)

    def uniform(self, size: tuple[int, ...]) -> FloatArray:
        """Return the upper end of the probabilities."""
        return np.ones(size)


@pytest.mark.parametrize(
    "law",
    [WEAR, FALLING, LINEAR, Free(), Unchanging()],
    ids=["wear", "loosening", "linear", "free", "none"],
)
def test_without_deviation_it_is_the_law(law: AnyLaw) -> None:
    """The closed form of each law, at the limit that is left where health is off it."""
    path = DegradationPath(law, 0.0, ())
    rng = np.random.default_rng(2)
    theta = path.natural(path.draw(rng, 400, NOW), NOW)
    off = 0.1 * rng.standard_normal(400)
    found = first_passage(path, theta, off, np.zeros(400), rng, now=NOW, limit=0.8, horizon=HORIZON)
    closed = path.passage(theta, 0.8 * np.exp(-off)) - NOW
    # Only what gains can be above a limit now that it was below before.
    back = (closed <= 0) & (path.health(theta, np.array([NOW]))[:, 0] * np.exp(off) > 0.8)
    assert isinstance(law, Linear | Free) or not back.any()
    np.testing.assert_array_equal(found, np.where(back, np.inf, closed))
    finite = np.isfinite(found)
    if isinstance(law, Unchanging):
        assert not finite[off > np.log(0.8)].any()
    else:
        assert (found[finite] < 0).any()
        assert (found[finite] > 0).any()
        ahead = (found[finite] + NOW)[:, None]
        health = path.health(theta[finite], ahead)[:, 0] * np.exp(off[finite])
        inside = ahead[:, 0] > 0
        np.testing.assert_allclose(health[inside], 0.8, rtol=1e-9)


@pytest.mark.parametrize("rate", [2e-9, 2e-8, 2e-7])
@pytest.mark.parametrize(("limit", "off"), [(0.75, 0.0), (0.5, 0.05), (0.2, -0.1)])
def test_a_steady_fall_is_inverse_gaussian(limit: float, off: float, rate: float) -> None:
    """Ln health that falls in proportion to travel has a passage in closed form."""
    found = draw(DegradationPath(FALLING, 0.0, ()), (0.0, LIFE), off=off, rate=rate, limit=limit)
    above = off - NOW / LIFE - np.log(limit)
    assert (found > 0).all()
    assert follows(found, inverse_gaussian(above, rate))
    # Negative controls: another distance, another rate.
    assert not follows(found, inverse_gaussian(1.05 * above, rate))
    assert not follows(found, inverse_gaussian(above, 1.5 * rate))


@pytest.mark.parametrize("begin", [0.0, 0.4e6])
def test_a_step_in_the_past_is_what_it_left(begin: float) -> None:
    """From a jump by a fifth on, and a law that begins there or before, it falls as steadily."""
    found = draw(
        DegradationPath(FALLING, begin, (0.4e6,)), (0.0, LIFE, 0.8), off=0.02, rate=2e-8, limit=0.4
    )
    above = 0.02 - (NOW - begin) / LIFE + np.log(0.8 / 0.4)
    assert follows(found, inverse_gaussian(above, 2e-8))
    assert not follows(found, inverse_gaussian(above - np.log(0.8), 2e-8))  # negative control


@pytest.mark.parametrize(("limit", "rate"), [(0.9, 1e-9), (0.6, 1e-8), (0.3, 4e-7)])
def test_without_a_law_it_is_the_reflection_principle(limit: float, rate: float) -> None:
    """Health that only wanders is past its limit by s with probability 2 Φ(-a / σ√s)."""
    found = draw(DegradationPath(Unchanging(), 0.0, ()), (), off=0.03, rate=rate, limit=limit)
    above = 0.03 - np.log(limit)
    for travel in (0.2 * HORIZON, 0.5 * HORIZON, HORIZON):
        low, high = binomial_band(int(np.sum(found <= travel)), N)
        assert low <= 2 * stats.norm.cdf(-above / np.sqrt(rate * travel)) <= high
    assert follows(found, stats.levy(scale=above**2 / rate))
    assert not follows(found, stats.levy(scale=1.1 * above**2 / rate))  # negative control


def test_without_bridges_crossings_are_missed() -> None:
    """Negative control: at few moments alone fewer lives, and later ones, are seen to end."""
    path = DegradationPath(FALLING, 0.0, ())
    above = -NOW / LIFE - np.log(0.6)
    rng: np.random.Generator = NoBridge()  # type: ignore[assignment]
    wrong = draw(path, (0.0, LIFE), off=0.0, rate=2e-7, limit=0.6, rng=rng)
    right = draw(path, (0.0, LIFE), off=0.0, rate=2e-7, limit=0.6)
    book = inverse_gaussian(above, 2e-7)
    assert follows(right, book)
    assert not follows(wrong, book)
    assert np.quantile(wrong, 0.2) > 1.1 * np.quantile(right, 0.2)


@pytest.mark.slow
def test_a_bent_law_is_that_of_brute_force() -> None:
    """Wear by Hertz, which ends at nothing, against a walk of 3,000 steps."""
    life, exponent, rate, limit = 6e6, 1.3, 3e-8, 0.55
    found = draw(DegradationPath(WEAR, 0.0, ()), (life, exponent), off=0.04, rate=rate, limit=limit)
    rng, n, step = np.random.default_rng(3), 6000, HORIZON / 3000
    ahead = step * np.arange(1, 3001)
    with np.errstate(divide="ignore"):
        fall = 1.5 * np.log(np.maximum(1 - ((NOW + ahead) / life) ** exponent, 0))
    walk = np.cumsum(np.sqrt(rate * step) * rng.standard_normal((n, 3000)), axis=1)
    # Steps see a crossing late, as if the limit lay lower by 0.5826 of a step's deviation.
    below = fall + walk + 0.04 < np.log(limit) + 0.5826 * np.sqrt(rate * step)
    assert below[:, -1].all()
    known = ahead[below.argmax(axis=1)] - step / 2
    for level in (0.05, 0.25, 0.5, 0.75, 0.95):
        share = np.mean(known < np.quantile(found, level))
        assert abs(share - level) < 4.5 * np.sqrt(level * (1 - level) * (1 / n + 1 / N))
    assert abs(np.mean(known < 1.1 * np.median(found)) - 0.5) > 4.5 * 0.5 / np.sqrt(n)


def test_a_limit_that_is_past_needs_no_deviation() -> None:
    """Health below its limit now has been there since the law, so lowered, was."""
    path = DegradationPath(FALLING, 0.0, ())
    found = draw(path, (0.0, LIFE), off=-0.2, rate=1e-7, limit=0.7)
    left = LIFE * (-0.2 - np.log(0.7)) - NOW
    assert left < 0
    np.testing.assert_allclose(found, left)


def test_draws_with_deviation_stay_among_those_without() -> None:
    """Each draw has its own rate: what does not move is at the closed form, what does about it."""
    path = DegradationPath(FALLING, 0.0, ())
    rate = np.where(np.arange(1000) % 2, 1e-9, 0.0)
    theta, off = np.tile((0.0, LIFE), (1000, 1)), np.zeros(1000)
    rng = np.random.default_rng(4)
    found = first_passage(path, theta, off, rate, rng, now=NOW, limit=0.6, horizon=HORIZON)
    left = -LIFE * np.log(0.6) - NOW
    np.testing.assert_allclose(found[::2], left)
    assert np.unique(found[1::2]).size == 500
    assert abs(found[1::2].mean() - left) < 4.5 * found[1::2].std() / np.sqrt(500)


def test_nothing_is_published_past_the_horizon() -> None:
    """Lives with deviation end before the horizon, or are infinite."""
    found = draw(DegradationPath(FALLING, 0.0, ()), (0.0, 4 * LIFE), off=0.0, rate=1e-8, limit=0.5)
    finite = np.isfinite(found)
    assert 0.05 < finite.mean() < 0.95
    assert found[finite].max() <= HORIZON


def test_what_gains_is_not_past_a_limit_that_it_has_left_behind() -> None:
    """After a jump below the limit a parameter that gains is above it again: nothing is ahead."""
    path = DegradationPath(LINEAR, 0.0, (0.1 * NOW,))
    natural = (-1e-6, 0.45)  # gains 100 % by now, of which the jump left 45 %
    assert (path.health(np.array([natural]), np.array([0.1 * NOW, NOW])) > 0.7).tolist() == [
        [False, True]
    ]
    assert np.isinf(draw(path, natural, off=0.0, rate=0.0, limit=0.7)).all()
    # Negative control: one that has not come back is past it.
    assert (draw(path, (-1e-7, 0.45), off=0.0, rate=0.0, limit=0.7) <= 0).all()
