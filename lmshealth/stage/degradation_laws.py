"""Laws by which a health parameter degrades with travel (README.md, "Degradation laws")."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Union

import msgspec
import numpy as np
from scipy.special import expit, log_expit

from lmshealth._private import load_plug_ins
from lmshealth._private.arrays import FloatArray
from lmshealth._private.tables import fact
from lmshealth._private.toml import within
from lmshealth.stage import constants
from lmshealth.stage.priors import Lognormal, Prior, Uniform

_KM = 1000.0
# ln of ratios of lengths is cut here: a distant walker may ask for a length outside the range of
# floats, where its prior is 0 anyway.
_LARGEST_LN = 300
_LEAST_BEND = 1e-8  # below which a bend is a straight line but for rounding
_BISECTIONS = 50


def _lognormal(median: float) -> msgspec.Meta:
    """Return an example of a prior, for messages."""
    return msgspec.Meta(examples=[{"kind": "lognormal", "median": median, "sigma": 1.0}])


class Law(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A degradation law: health, as a fraction of its value at the begin, over travel from there.

    A law of k natural parameters ``theta``, shape ``(n, k)`` (of equation and prior, such as a life
    in m), is sampled in k coordinates ``y``, shape ``(n, k)``, without bounds. They may depend on
    ``now``, the present travel in m, so that the posterior is close to a Gaussian: the logs
    determine the loss up to now rather than the life. README.md has the steps to add a law.
    """

    # Prior probability in proportion to the other laws of the parameter.
    weight: Annotated[float, within(*constants.WEIGHT)] = 1.0
    names: ClassVar[tuple[str, ...]] = ()  # of the natural parameters: columns of theta
    label: ClassVar[str]  # words of the report

    @property
    def kind(self) -> str:
        """Name of the law in a stage description."""
        return str(self.__struct_config__.tag)

    def natural(self, y: FloatArray, now: float) -> FloatArray:
        """Convert coordinates, shape ``(n, k)``, to natural parameters (lengths in m)."""
        raise NotImplementedError

    def log_prior(self, y: FloatArray, now: float) -> FloatArray:
        """Return the log prior density in the coordinates, with the Jacobian, shape ``(n,)``."""
        raise NotImplementedError

    def draw(self, rng: np.random.Generator, n: int, now: float) -> FloatArray:
        """Draw coordinates from the prior, shape ``(n, k)``."""
        raise NotImplementedError

    def health(self, theta: FloatArray, travel: FloatArray) -> FloatArray:
        """Return the health at travels common to all or of each row, ``(n, n_travel)``."""
        raise NotImplementedError

    def passage(self, theta: FloatArray, limit: FloatArray) -> FloatArray:
        """Return the travel in m at which health falls to the limit, inf if never, ``(n,)``."""
        raise NotImplementedError


def _expect_mass(name: str, prior: Prior, low: float, high: float) -> None:
    """Refuse a prior with almost no probability in the admissible range."""
    below, upto = prior.probability(np.array([low, high]))
    if upto - below < constants.LEAST_LAW_MASS:
        raise ValueError(f"{name} must lie between {low:g} and {high:g}, got {prior}")


def _draw(
    prior: Prior, rng: np.random.Generator, n: int, low: float = -np.inf, high: float = np.inf
) -> FloatArray:
    """Draw from a prior, truncated at low and high as `log_prior` truncates it."""
    below, upto = prior.probability(np.array([low, high]))
    level = below + (upto - below) * rng.uniform(1e-9, 1 - 1e-9, n)
    return np.asarray(prior.quantile(level))


def _truncated(prior: Prior, x: FloatArray, high: float = np.inf) -> FloatArray:
    """Return the log density of a prior truncated at 0 and another value, at values inside."""
    below, upto = prior.probability(np.array([0.0, high]))
    return np.asarray(prior.log_density(x) - np.log(upto - below))


class HertzWear(Law, frozen=True, tag="hertz-wear", tag_field="kind"):
    """Preload lost by wear of the rolling contacts: P(s) = (1 - (s / s_w)^n)^1.5."""

    life_km: Annotated[Prior, _lognormal(8000)]
    exponent: Uniform = Uniform(0.7, 1.6)
    outer: ClassVar[float] = 1.5
    label: ClassVar[str] = fact("wear of the contacts (Hertz)")
    names: ClassVar[tuple[str, ...]] = ("life_m", "exponent")

    def __post_init__(self) -> None:
        _expect_mass("life_km", self.life_km, *constants.LIFE_KM)
        least, most = constants.EXPONENT
        if not least <= self.exponent.low < self.exponent.high <= most:
            needed = f"a range within {least:g} to {most:g}"
            raise ValueError(f"exponent needs {needed}, got {self.exponent}")

    def natural(self, y: FloatArray, now: float) -> FloatArray:
        """Convert y1 = n ln(now / s_w) and y2 = logit of n in its range."""
        n = self.exponent.quantile(expit(y[:, 1]))
        ratio = np.exp(np.clip(-y[:, 0] / n, -_LARGEST_LN, _LARGEST_LN))
        return np.column_stack([now * ratio, n])

    def log_prior(self, y: FloatArray, now: float) -> FloatArray:
        """Return the log prior with |d(s_w, n)/d(y1, y2)| = (s_w / n) (dn/dy2)."""
        life, n = HertzWear.natural(self, y, now).T
        slope = log_expit(y[:, 1]) + log_expit(-y[:, 1])
        return np.asarray(_truncated(self.life_km, life / _KM) + np.log(life / _KM / n) + slope)

    def draw(self, rng: np.random.Generator, n: int, now: float) -> FloatArray:
        """Draw coordinates from the prior."""
        life = _KM * _draw(self.life_km, rng, n, 0.0)
        share = rng.uniform(1e-6, 1 - 1e-6, n)
        exponent = self.exponent.quantile(share)
        return np.column_stack([exponent * np.log(now / life), np.log(share / (1 - share))])

    def health(self, theta: FloatArray, travel: FloatArray) -> FloatArray:
        """Return the health, 0 from s_w on."""
        life, n = theta[:, :1], theta[:, 1:]
        with np.errstate(over="ignore"):
            left = 1 - (np.maximum(travel, 0) / life) ** n
        return np.asarray(np.maximum(left, 0) ** self.outer)

    def passage(self, theta: FloatArray, limit: FloatArray) -> FloatArray:
        """Return the travel at the limit, in closed form."""
        loss = 1 - np.minimum(limit, 1.0) ** (1 / self.outer)
        return np.asarray(theta[:, 0] * loss ** (1 / theta[:, 1]))


class Power(HertzWear, frozen=True, tag="power", tag_field="kind"):
    """Loss as a power of travel: h(s) = 1 - (s / s_p)^n, without a physical model."""

    outer: ClassVar[float] = 1.0
    label: ClassVar[str] = fact("loss as a power of travel")


class Loosening(Law, frozen=True, tag="loosening", tag_field="kind"):
    """Joint that settles towards a floor: k(s) = k_f + (1 - k_f) exp(-s / s_m)."""

    life_km: Annotated[Prior, _lognormal(8000)]
    floor: Annotated[Prior, msgspec.Meta(examples=[{"kind": "uniform", "low": 0.3, "high": 1.0}])]
    label: ClassVar[str] = fact("loosening towards a floor")
    names: ClassVar[tuple[str, ...]] = ("floor", "life_m")

    def __post_init__(self) -> None:
        _expect_mass("life_km", self.life_km, *constants.LIFE_KM)
        _expect_mass("floor", self.floor, 0.0, 1.0)

    def natural(self, y: FloatArray, now: float) -> FloatArray:
        """Convert y1 = ln[(1 - k_f)(1 - exp(-now / s_m))], the loss so far, and y2 = ln s_m."""
        life = np.exp(np.clip(y[:, 1], -_LARGEST_LN, _LARGEST_LN))
        share = np.log(-np.expm1(-now / life))
        floor = 1 - np.exp(np.minimum(y[:, 0] - share, _LARGEST_LN))
        return np.column_stack([floor, life])

    def log_prior(self, y: FloatArray, now: float) -> FloatArray:
        """Return the log prior with |d(k_f, s_m)/d(y1, y2)| = (1 - k_f) s_m."""
        floor, life = self.natural(y, now).T
        inside = (floor >= 0) & (floor < 1)
        rest = np.where(inside, 1 - floor, 1.0)
        value = _truncated(self.floor, floor, 1.0) + _truncated(self.life_km, life / _KM)
        return np.where(inside, value + np.log(rest * life / _KM), -np.inf)

    def draw(self, rng: np.random.Generator, n: int, now: float) -> FloatArray:
        """Draw coordinates from the prior."""
        life = _KM * _draw(self.life_km, rng, n, 0.0)
        floor = _draw(self.floor, rng, n, 0.0, 1.0)
        return np.column_stack([np.log((1 - floor) * -np.expm1(-now / life)), np.log(life)])

    def health(self, theta: FloatArray, travel: FloatArray) -> FloatArray:
        """Return the stiffness."""
        floor, life = theta[:, :1], theta[:, 1:]
        return np.asarray(floor + (1 - floor) * np.exp(-np.maximum(travel, 0) / life))

    def passage(self, theta: FloatArray, limit: FloatArray) -> FloatArray:
        """Return the travel at the limit, inf where the floor lies above it."""
        floor, life = theta.T
        reached = floor < limit
        ratio = (1 - floor) / np.where(reached, limit - floor, 1.0)
        return np.where(reached, life * np.log(np.maximum(ratio, 1.0)), np.inf)


class Linear(Law, frozen=True, tag="linear", tag_field="kind"):
    """Loss proportional to travel: h(s) = 1 - r s; a negative rate is a gain."""

    rate_per_km: Annotated[Prior, _lognormal(5e-5)]
    label: ClassVar[str] = fact("loss in proportion to travel")
    names: ClassVar[tuple[str, ...]] = ("rate_per_m",)

    def natural(self, y: FloatArray, now: float) -> FloatArray:
        """Convert y1 = r now, the loss so far."""
        return y / now

    def log_prior(self, y: FloatArray, now: float) -> FloatArray:
        """Return the log prior with dr/dy1 = 1 / now."""
        value = self.rate_per_km.log_density(y[:, 0] / now * _KM)
        return np.asarray(value + np.log(_KM / now))

    def draw(self, rng: np.random.Generator, n: int, now: float) -> FloatArray:
        """Draw coordinates from the prior."""
        return (_draw(self.rate_per_km, rng, n) / _KM * now)[:, None]

    def health(self, theta: FloatArray, travel: FloatArray) -> FloatArray:
        """Return the health, not below 0."""
        return np.asarray(np.maximum(1 - theta * np.maximum(travel, 0), 0))

    def passage(self, theta: FloatArray, limit: FloatArray) -> FloatArray:
        """Return the travel at the limit, inf without a loss."""
        rate = theta[:, 0]
        losing = rate > 0
        passed = np.maximum(1 - limit, 0.0) / np.where(losing, rate, 1.0)
        return np.where(losing | (limit >= 1), passed, np.inf)


class Unchanging(Law, frozen=True, tag="none", tag_field="kind"):
    """No degradation: h(s) = 1."""

    label: ClassVar[str] = fact("no change")

    def natural(self, y: FloatArray, now: float) -> FloatArray:
        """Return the empty coordinates as they are."""
        return y

    def log_prior(self, y: FloatArray, now: float) -> FloatArray:
        """Return zeros."""
        return np.zeros(y.shape[0])

    def draw(self, rng: np.random.Generator, n: int, now: float) -> FloatArray:
        """Return empty coordinates."""
        return np.empty((n, 0))

    def health(self, theta: FloatArray, travel: FloatArray) -> FloatArray:
        """Return ones."""
        return np.ones((theta.shape[0], travel.shape[-1]))

    def passage(self, theta: FloatArray, limit: FloatArray) -> FloatArray:
        """Return inf, or 0 for a limit at the initial value."""
        return np.where(np.broadcast_to(limit, theta.shape[:1]) >= 1, 0.0, np.inf)


def _late(y: FloatArray) -> FloatArray:
    """Return the coordinates of the late loss of `Accelerating` as those of `HertzWear`."""
    return np.column_stack([y[:, 0] + log_expit(y[:, 2]), y[:, 1]])


class Accelerating(HertzWear, frozen=True, tag="accelerating", tag_field="kind", kw_only=True):
    """Slow loss that accelerates: ln h(s) = -b s / s_w - (s / s_w)^n."""

    slow: Annotated[Lognormal, _lognormal(0.1)]
    exponent: Uniform = Uniform(2.0, 12.0)
    label: ClassVar[str] = fact("slow loss that accelerates")
    names: ClassVar[tuple[str, ...]] = ("life_m", "exponent", "slow")

    def natural(self, y: FloatArray, now: float) -> FloatArray:
        """Convert y1 = ln of -ln h(now), y2 = logit of n, y3 = logit of the late share of -ln h."""
        wear = super().natural(_late(y), now)
        slow = np.clip(y[:, 0] + log_expit(-y[:, 2]), -_LARGEST_LN, _LARGEST_LN)
        return np.column_stack([wear, np.exp(slow) * wear[:, 0] / now])

    def log_prior(self, y: FloatArray, now: float) -> FloatArray:
        """Return the log prior; d(ln late, ln slow)/d(y1, y3) has the determinant -1."""
        slow = self.natural(y, now)[:, 2]
        density = self.slow.log_density(slow) + np.log(slow)
        return np.asarray(super().log_prior(_late(y), now) + density)

    def draw(self, rng: np.random.Generator, n: int, now: float) -> FloatArray:
        """Draw coordinates from the prior."""
        wear = super().draw(rng, n, now)
        late, slow = wear[:, 0], _draw(self.slow, rng, n)
        slow = np.log(slow * now / super().natural(wear, now)[:, 0])
        return np.column_stack([np.logaddexp(late, slow), wear[:, 1], late - slow])

    def health(self, theta: FloatArray, travel: FloatArray) -> FloatArray:
        """Return the health."""
        return np.asarray(np.exp(-self._loss(theta, np.maximum(travel, 0))))

    def _loss(self, theta: FloatArray, travel: FloatArray) -> FloatArray:
        life, n, slow = theta.T[:, :, None]
        with np.errstate(over="ignore"):
            return np.asarray(slow * travel / life + (travel / life) ** n)

    def passage(self, theta: FloatArray, limit: FloatArray) -> FloatArray:
        """Return the travel at the limit, by bisection; 0 for a limit of 1 or more."""
        loss = np.maximum(-np.log(limit), 0.0)
        low, high = np.zeros(len(theta)), theta[:, 0] * loss ** (1 / theta[:, 1])
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            before = self._loss(theta, middle[:, None])[:, 0] < loss
            low, high = np.where(before, middle, low), np.where(before, high, middle)
        return high


class Free(Law, frozen=True, tag="free", tag_field="kind", kw_only=True):
    """A smooth change of either direction without a physical model.

    ln h(s) = a g(s / s_now) / g(1) with g(x) = (1 - exp(-c x^b)) / c: the change a by now, whenever
    now is, by a power of the travel (c = 0), one that settles (c > 0) or accelerates (c < 0).
    a ~ N(0, `std`²), ln b ~ N(0, `exponent_sigma`²), c ~ N(0, `bend_std`²).
    """

    std: Annotated[float, within(*constants.EFFECT)] = 0.15
    exponent_sigma: Annotated[float, within(*constants.SIGMA)] = 0.5
    bend_std: Annotated[float, within(*constants.EFFECT)] = 2.0
    label: ClassVar[str] = fact("change of either direction without a law")
    names: ClassVar[tuple[str, ...]] = ("per_power", "exponent", "bend")

    def natural(self, y: FloatArray, now: float) -> FloatArray:
        """Convert a / std, ln b / exponent_sigma and c / bend_std to factors r and k of s^b.

        ln h = r s^b φ(k s^b) with φ(z) = (1 - exp(-z)) / z.
        """
        exponent = np.exp(np.clip(self.exponent_sigma * y[:, 1], -_LARGEST_LN, _LARGEST_LN))
        bend = self.bend_std * y[:, 2]
        with np.errstate(over="ignore", under="ignore"):
            scale = float(now) ** -exponent
            per_power = self.std * y[:, 0] * scale / _settled(bend)
        return np.column_stack([per_power, exponent, bend * scale])

    def log_prior(self, y: FloatArray, now: float) -> FloatArray:
        """Return the log prior density."""
        return np.asarray(-0.5 * np.sum(y**2, axis=1) - 1.5 * np.log(2 * np.pi))

    def draw(self, rng: np.random.Generator, n: int, now: float) -> FloatArray:
        """Draw coordinates from the prior."""
        return rng.standard_normal((n, 3))

    def health(self, theta: FloatArray, travel: FloatArray) -> FloatArray:
        """Return the health, which may be above 1."""
        per_power, exponent, bend = theta.T[:, :, None]
        with np.errstate(over="ignore", invalid="ignore"):
            power = np.maximum(travel, 0) ** exponent
            change = per_power * power * _settled(bend * power)
        # Far beyond now the change has no bound; nor has what it was far from there.
        change = np.where(np.isnan(change), -_LARGEST_LN, change)
        return np.asarray(np.exp(np.clip(change, -_LARGEST_LN, _LARGEST_LN)))

    def passage(self, theta: FloatArray, limit: FloatArray) -> FloatArray:
        """Return the travel at the limit, inf where the change settles above it."""
        per_power, exponent, bend = theta.T
        loss = np.log(np.minimum(limit, 1.0))
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            power = loss / np.where(per_power < 0, per_power, -1.0)
            # -ln(1 - k q) / k, which is q for k = 0; NaN where it settles before.
            curved = -np.log1p(-bend * power) / np.where(bend == 0, 1.0, bend)
            power = np.where(np.abs(bend * power) < _LEAST_BEND, power, curved)
            travel = power ** (1 / exponent)
        reached = (per_power < 0) & ~np.isnan(travel)
        return np.where(reached, travel, np.where(loss == 0, 0.0, np.inf))


def _settled(z: FloatArray) -> FloatArray:
    """Return (1 - exp(-z)) / z, 1 at 0."""
    z = np.maximum(z, -_LARGEST_LN)
    near = np.abs(z) < _LEAST_BEND
    return np.asarray(np.where(near, 1 - z / 2, -np.expm1(-z) / np.where(near, 1.0, z)))


def _checked(law: Any, others: Sequence[type[Law]]) -> type[Law]:
    """Return a law of another package; `TypeError` or `ValueError` if it is none."""
    if not (isinstance(law, type) and issubclass(law, Law)):
        raise TypeError(f"it is {law!r}, needed a subclass of Law")
    kind = law.__struct_config__.tag
    if not isinstance(kind, str) or kind in [own.__struct_config__.tag for own in others]:
        raise ValueError(f"its tag is {kind!r}, needed one that no other law has")
    return law


LAWS = "lmshealth.laws"
"""Group of entry points: each names a subclass of `Law` with a tag of its own."""

if TYPE_CHECKING:
    AnyLaw = HertzWear | Loosening | Power | Linear | Unchanging | Accelerating | Free
else:
    _SHIPPED = (HertzWear, Loosening, Power, Linear, Unchanging, Accelerating, Free)
    AnyLaw = Union[load_plug_ins(LAWS, "law", _SHIPPED, _checked)]  # noqa: UP007
