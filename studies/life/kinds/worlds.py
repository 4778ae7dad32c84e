"""Lives of the plant, by kind: what wears, by which course, and what else moves its modes.

A course is the loss over the share of the life, as a share of the loss at the limit: 0 at 0 and 1
at 1. All is drawn without the laws, priors and maps of `lmshealth`.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from studies.life.kinds.plant import (
    FREQUENCY_HZ,
    LIMITS,
    LN_ZETA,
    MODES,
    PARAMETERS,
    Array,
    drift,
    drifts_alone,
)

SEED, N_LOGS = 20261127, 30
SHARES = (0.5, 0.7, 0.9)  # of the life, at the last log
LIFE_KM = 3000.0, 0.42  # median, and standard deviation of the logarithm: 1,500 to 6,000 km (90 %)
KM_PER_DAY = 3.0, 8.0
# Ranges of the standard deviations of ln f; the second is of logs of 20 s.
STD_F, WIDE_STD_F, STD_ZETA = (2e-4, 6e-4), (1e-3, 1.6e-3), 0.08
MAP_ERROR, WIDE_MAP_ERROR = 0.05, 0.1
REFERENCE_C = 21.0
COMMON_LOGS = 10.0
# Share of the loss at the limit from which a parameter is degraded (README), and how close is near.
DEGRADED, NEAR = 0.25, 0.05
_START = datetime(2023, 3, 1, 8, tzinfo=UTC)

Course = Callable[[Array], Array]


@dataclass(frozen=True, slots=True)
class World:
    """What becomes of a machine; the defaults are a machine that stays as it is."""

    preload: str = ""  # course of its loss
    mount: str = ""  # course of its loss, or "settling", by which it becomes stiffer
    lone: tuple[str, float] | None = None  # mode that moves by another cause, and its size
    map_error: float = MAP_ERROR  # relative, of the effect of each parameter on each mode
    std: tuple[float, float] = STD_F  # range of the standard deviations of ln f
    walk: float = 3e-4  # standard deviation of the random walk of ln f over the logs
    wander: float = 0.0  # standard deviation of its stationary wander, five logs long
    common: float = 0.0  # the same of a wander of all modes together, `COMMON_LOGS` long
    busier: float = 1.0  # factor on the travel per day from one of the logs on
    season_k: float = 6.0  # amplitude of the seasons
    per_kelvin: float = -5e-4  # median effect on ln f
    # Standard deviation of the jumps of ln f at one log, which is declared as a retuning.
    retuned: float = 0.0
    jumps: bool = False  # whether the verdict ``step`` is right
    # Action in the middle third that restores the one parameter; the other's limit ends the life.
    work: str = ""


COURSES = (
    "hertz", "linear", "power", "exponential", "late", "bathtub", "onset", "steps", "relubrication",
)  # fmt: skip
WEARING = {f"preload, {course}": World(preload=course) for course in COURSES}
WEARING["preload, steps"] = World(preload="steps", jumps=True)
OTHERS = {
    "mount, loosening": World(mount="loosening"),
    "both": World(preload="hertz", mount="loosening"),
    "opposite": World(preload="linear", mount="settling"),
    "preload, linear, map 10 % wrong": World(preload="linear", map_error=WIDE_MAP_ERROR),
    "mount, loosening, map 10 % wrong": World(mount="loosening", map_error=WIDE_MAP_ERROR),
    "preload, linear, short logs": World(preload="linear", std=WIDE_STD_F),
    "mount, loosening, short logs": World(mount="loosening", std=WIDE_STD_F),
    "preload, linear, a declared step": World(preload="linear", retuned=0.01),
    "preload, linear, a sudden loss": World(preload="jump", jumps=True),
    "preload, linear, common wander": World(preload="linear", walk=0.0, common=2e-3),
    "preload, linear, usage doubles": World(preload="linear", busier=2.0),
    "preload, hertz, mount tightened": World("hertz", "loosening", work="mount-tightened"),
    "mount, loosening, guide replaced": World("hertz", "loosening", work="guide-replaced"),
}
RESTORED = {"guide-replaced": 0, "mount-tightened": 1}
LONE = {
    f"{mode} alone, {100 * size:.0f} %": World(lone=(mode, size))
    for mode in MODES
    for size in (0.01, 0.02)
}
HEALTHY = {
    "healthy, quiet": World(walk=0.0),
    "healthy, wander": World(walk=0.0, wander=8e-4),
    "healthy, temperature": World(walk=0.0, season_k=12.0, per_kelvin=-1e-3),
    "healthy, common wander": World(walk=0.0, common=2e-3),
}
WORLDS = WEARING | OTHERS | LONE | HEALTHY


@dataclass(frozen=True, slots=True, eq=False)
class Life:
    """Logs of a life with its truth. Logs first, modes or parameters last."""

    world: World
    share: float  # of the life, at the last log
    travel: Array  # in m since the first log
    days: Array  # since the first log
    temperature: Array  # in °C
    ln_f: Array  # estimates, and the standard deviation that they state
    std: Array
    ln_zeta: Array
    # Of each parameter the loss at u = 1, and its course at the logs, ``(n_logs, 2)``.
    size: Array
    course: Array
    left_km: float  # true, to the first limit; inf if never
    left_days: float
    retuned_at: int  # first log after the declared step; their number without one
    worked_at: int  # first log after the work; their number without any

    @property
    def ln_health(self) -> Array:
        """Return the true ln preload and ln mount stiffness at the logs, ``(n_logs, 2)``."""
        return np.log1p(-self.size * self.course)

    @property
    def right_verdicts(self) -> tuple[str, ...]:
        """Return the verdicts that are right; none where a loss is close to being one."""
        if self.world.lone:
            return ("outside-map",)
        lost = self.size * self.course[-1] / (1 - np.array(list(LIMITS.values())))
        if np.any(np.abs(lost - DEGRADED) < NEAR):
            return ()
        words = [
            word for word, own in zip(("preload", "mount"), lost, strict=True) if own > DEGRADED
        ]
        verdict = "both" if len(words) == 2 else "".join(words) or "healthy"
        return (verdict, "step") if self.world.jumps else (verdict,)

    def logs(self) -> dict[str, Any]:
        """Return what is known of the life, as JSON can express it."""
        moments = [(_START + timedelta(days=float(day))).isoformat() for day in self.days]
        tuned = np.arange(N_LOGS) >= self.retuned_at
        work = ""
        if self.world.work:
            day = float(self.days[self.worked_at - 1 : self.worked_at + 1].mean())
            work = (_START + timedelta(days=day)).isoformat()
        return {
            "work": [self.world.work, work],
            "modes": MODES,
            "recorded_at": moments,
            "travel": self.travel.tolist(),
            "temperature_c": self.temperature.tolist(),
            "servo_id": [f"v{1 + later}" for later in tuned],
            "ln_f": self.ln_f.tolist(),
            "ln_zeta": self.ln_zeta.tolist(),
            "std": self.std.tolist(),
        }


def course(rng: np.random.Generator, kind: str) -> Course:
    """Draw a course."""
    if kind == "hertz":
        n, worn = rng.uniform(0.8, 1.4), 1 - LIMITS["guide_preload"] ** (2 / 3)
        return lambda u: (1 - (1 - worn * u**n) ** 1.5) / (1 - LIMITS["guide_preload"])
    if kind == "loosening":
        length = rng.uniform(0.3, 1.2)
        return lambda u: np.expm1(-u / length) / np.expm1(-1 / length)
    if kind == "exponential":
        rate = rng.uniform(0.7, 2.5)
        return lambda u: np.expm1(rate * u) / np.expm1(rate)
    if kind == "onset":
        onset = rng.uniform(0.15, 0.6)
        return lambda u: np.maximum(u - onset, 0.0) / (1 - onset)
    if kind == "steps":
        at = np.r_[np.sort(rng.uniform(size=int(rng.integers(7, 16)))), 1.0]
        sizes = rng.dirichlet(np.full(at.size, 3.0))
        return lambda u: (u[..., None] >= at) @ sizes
    if kind == "jump":
        # Seen by a fifth of the logs at the least.
        begin, size = rng.uniform(0.2, 0.4), rng.uniform(0.25, 0.4)
        return lambda u: (1 - size) * u + size * (u >= begin)
    if kind == "relubrication":
        times, parts = np.sort(rng.uniform(0.15, 0.6, 2)), rng.uniform(0.1, 0.3, 2)
        back = parts * [times[0], times[1] - parts[0] * times[0]]
        # Each takes back a part of what is lost, over 4 % of the life.
        return lambda u: (
            (u - np.clip((u[..., None] - times) / 0.04, 0, 1) @ back) / (1 - back.sum())
        )
    return _sum_of_powers(rng, kind)


def _sum_of_powers(rng: np.random.Generator, kind: str) -> Course:
    """Draw a running-in, an even loss, and the rest by a power of the travel."""
    early, even, n = 0.0, 1.0, 1.0
    if kind == "power":
        even, n = 0.0, rng.choice([rng.uniform(0.6, 0.8), rng.uniform(1.4, 2.0)])
    elif kind == "late":
        even, n = rng.uniform(0.1, 0.3), rng.uniform(5, 9)
    elif kind == "bathtub":
        early, even, n = *rng.uniform(0.05, 0.125, 2), rng.uniform(7, 11)
    return lambda u: early * -np.expm1(-u / 0.03) + even * u + (1 - early - even) * u**n


def life_of(name: str, number: int) -> Life:
    """Draw a life of a kind."""
    world, rng = WORLDS[name], np.random.default_rng([SEED, zlib.crc32(name.encode()), number])
    share = SHARES[number % len(SHARES)]
    u = share * np.r_[0.0, np.sort(rng.uniform(size=N_LOGS - 2)), 1.0]
    length_km = LIFE_KM[0] * float(np.exp(LIFE_KM[1] * rng.standard_normal()))
    km_per_day = float(rng.uniform(*KM_PER_DAY))
    size, lost, worked_at = _losses(rng, world, u)
    ln_health = np.log1p(-size * lost)
    wrong = world.map_error * rng.standard_normal((2, len(MODES)))
    true = drift(ln_health) + np.sum(wrong * drifts_alone(ln_health), axis=-2)
    if world.lone:
        mode, moved = world.lone
        sign = -1 if (number // len(SHARES)) % 2 else 1
        true[:, MODES.index(mode)] += sign * moved * _smooth(rng, u / share)
    retuned_at = N_LOGS
    if world.retuned:
        retuned_at = int(rng.integers(N_LOGS // 3, 5 * N_LOGS // 6))
        true[retuned_at:] += world.retuned * rng.standard_normal(len(MODES))
    # The travel as if all of it were at the last usage.
    paced = u
    if world.busier != 1:
        slow = np.minimum(u, share * rng.uniform(0.3, 0.85))
        paced = u + (world.busier - 1) * slow
        km_per_day *= world.busier
    days = length_km * paced / km_per_day
    temperature, heated = _temperature(rng, world, days)
    std = rng.uniform(*world.std, (N_LOGS, len(MODES)))
    ln_f = np.log(FREQUENCY_HZ) + true + heated + _walks(rng, world, u)
    left = length_km * (1 - share) if np.any(size > 0) else np.inf
    return Life(
        world=world, share=share, travel=1000 * length_km * u, days=days, temperature=temperature,
        ln_f=ln_f + std * rng.standard_normal(std.shape), std=std,
        ln_zeta=LN_ZETA + STD_ZETA * rng.standard_normal(std.shape), size=size, course=lost,
        left_km=left, left_days=left / km_per_day, retuned_at=retuned_at,
        worked_at=worked_at,
    )  # fmt: skip


def _losses(rng: np.random.Generator, world: World, u: Array) -> tuple[Array, Array, int]:
    """Draw what each parameter loses; of two the first to reach its limit does so at u = 1.

    One that work restores begins anew at the log that is returned; their number without work.
    """
    size, lost, slower = np.zeros(2), np.zeros((N_LOGS, 2)), np.ones(2)
    worked_at, restored = N_LOGS, RESTORED.get(world.work)
    if world.preload and world.mount:
        later = int(rng.integers(2)) if restored is None else restored
        slower[later] = rng.uniform(1.0, 1.6)
    if restored is not None:
        worked_at = int(rng.integers(N_LOGS // 3, 2 * N_LOGS // 3))
    for j, (parameter, kind) in enumerate(
        zip(PARAMETERS, (world.preload, world.mount), strict=True)
    ):
        if kind == "settling":
            size[j], lost[:, j] = -rng.uniform(0.08, 0.2), -np.expm1(-u / rng.uniform(0.15, 0.5))
        elif kind:
            own = u if world.mount == "settling" else u / slower[j]
            by = course(rng, kind)
            size[j], lost[:, j] = 1 - LIMITS[parameter], by(own)
            if j == restored:
                lost[worked_at:, j] = by(own[worked_at:] - own[worked_at])
    return size, lost, worked_at


def _smooth(rng: np.random.Generator, part: Array) -> Array:
    """Draw a smooth onset from 0 to 1, complete at the last log."""
    begin, end = rng.uniform(0.0, 0.4), rng.uniform(0.8, 1.0)
    x = np.clip((part - begin) / (end - begin), 0.0, 1.0)
    return np.asarray(x**2 * (3 - 2 * x))


def _temperature(rng: np.random.Generator, world: World, days: Array) -> tuple[Array, Array]:
    """Draw the temperatures of the logs, and how ln f follows them."""
    season = np.sin(2 * np.pi * days / 365.25 + rng.uniform(0, 2 * np.pi))
    temperature = REFERENCE_C + world.season_k * season + 3 * rng.standard_normal(N_LOGS)
    slopes = world.per_kelvin * np.exp(0.4 * rng.standard_normal(len(MODES)))
    return temperature, np.outer(temperature - REFERENCE_C, slopes)


def _walks(rng: np.random.Generator, world: World, u: Array) -> Array:
    """Draw the random walk of ln f over the travel, and its stationary wander."""
    steps = np.sqrt(np.diff(u, prepend=0.0) / u[-1])[:, None]
    walk = world.walk * np.cumsum(steps * rng.standard_normal((N_LOGS, len(MODES))), axis=0)
    lags = np.abs(np.subtract.outer(np.arange(N_LOGS), np.arange(N_LOGS)))
    root = np.linalg.cholesky(np.exp(-lags / 5.0))
    walk += world.wander * root @ rng.standard_normal(walk.shape)
    if world.common:
        root = np.linalg.cholesky(np.exp(-lags / COMMON_LOGS))
        walk += world.common * (root @ rng.standard_normal(N_LOGS))[:, None]
    return np.asarray(walk)
