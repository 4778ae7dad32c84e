"""Lives of two modes or more, with known truth: which mode each estimate is of."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lmshealth.tracking.association.associate import Estimates

N_AFTER = 15
Labels = Sequence[Sequence[str | None]]

Array = NDArray[np.float64]

N_LOGS = 60
STD_F, STD_ZETA = 1e-3, 0.1
N_CHANNELS = 4
MISSED, SPURIOUS = 0.2, 0.1
MERGED_LOGS = 15
# Modes nearer than this in ln f, or shapes with less of their own than this, are of no clear mode.
CLEAR, PURE = 6 * STD_F, 0.9


# True ln frequencies ``(n_logs, n_modes)``, shapes ``(n_logs, n_modes, n)``, and the logs in which
# modes are not clear, ``(n_logs,)``
Paths = tuple[Array, Array, NDArray[np.bool_]]


@dataclass(frozen=True, slots=True, eq=False)
class Life:
    """Estimates and the truth about them."""

    clock: Array  # Odometer of each log, shape ``(n_logs,)``, from 0 to 1
    epochs: tuple[Estimates, ...]  # One for each log
    truth: tuple[tuple[int, ...], ...]  # For each estimate its mode; -1 for a spurious one
    ln_f: Array  # True ln frequencies, ``(n_logs, n_modes)``
    before: int  # The first log with modes near each other
    after: int  # The first log with modes clear of each other again


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """What a life is like."""

    paths: Callable[[Array, np.random.Generator], Paths]
    named: bool = True  # By the order of frequencies
    shaped: bool = False  # With shapes
    gaps: bool = False  # Logs miss modes and show spurious ones


def directions(rng: np.random.Generator, n_modes: int) -> Array:
    """Shapes at right angles, one a row."""
    return np.asarray(np.linalg.qr(rng.standard_normal((N_CHANNELS, n_modes)))[0].T)


def _near(ln_f: Array) -> NDArray[np.bool_]:
    return np.asarray(np.abs(ln_f[:, 0] - ln_f[:, 1]) < CLEAR)


def _still(shapes: Array, n: int) -> Array:
    return np.repeat(shapes[None], n, axis=0)


def crossing(clock: Array, rng: np.random.Generator) -> Paths:
    """Two modes on straight lines that cross in the middle third of the life."""
    at = rng.uniform(1 / 3, 2 / 3)
    slopes = rng.uniform(0.03, 0.1, 2) * (1, -1)
    ln_f = np.log(120.0) + (clock[:, None] - at) * slopes
    return ln_f, _still(directions(rng, 2), clock.size), _near(ln_f)


def veering(clock: Array, rng: np.random.Generator) -> Paths:
    """Two modes whose coupling keeps frequencies apart while shapes go over."""
    ln_f, shapes, _ = crossing(clock, rng)
    coupling = rng.uniform(1.0, 5.0) * STD_F
    half = (ln_f[:, 0] - ln_f[:, 1]) / 2
    centre, reach = ln_f.mean(1), np.hypot(half, coupling)
    angle = 0.5 * np.arctan2(coupling, half)
    mixed = np.stack(
        [np.outer(np.cos(angle), shapes[0, 0]) + np.outer(np.sin(angle), shapes[0, 1]),
         np.outer(-np.sin(angle), shapes[0, 0]) + np.outer(np.cos(angle), shapes[0, 1])],
        axis=1,
    )  # fmt: skip
    # Column 0 is the upper branch; a mode is the branch that is nearer to its own shape.
    upper = np.cos(angle) ** 2 >= 0.5
    branch = np.column_stack([centre + reach, centre - reach])
    own = np.where(upper[:, None], branch, branch[:, ::-1])
    mixing = np.maximum(np.cos(angle) ** 2, np.sin(angle) ** 2) < PURE
    shapes = np.where(upper[:, None, None], mixed, mixed[:, ::-1])
    return own, shapes, mixing | _near(own)


def merging(clock: Array, rng: np.random.Generator) -> Paths:
    """Two modes that come together, stay so for some logs, and part on either side."""
    start = int(rng.integers(20, 26))
    stop = start + MERGED_LOGS
    slope = rng.uniform(0.05, 0.1)
    apart = slope * (np.maximum(clock[start] - clock, 0) + np.maximum(clock - clock[stop], 0))
    side = np.where((np.arange(clock.size) > stop) & (rng.random() < 0.5), -1.0, 1.0)
    ln_f = np.log(120.0) + np.column_stack([side * apart, -side * apart]) / 2
    return ln_f, _still(directions(rng, 2), clock.size), _near(ln_f)


def separate(clock: Array, rng: np.random.Generator) -> Paths:
    """Five modes far from each other that wander and drift."""
    start = np.log([45.0, 89.0, 126.0, 136.6, 271.6])
    steps = np.diff(clock, prepend=0.0)[:, None]
    walk = np.cumsum(2e-3 * np.sqrt(steps) * rng.standard_normal((clock.size, 5)), axis=0)
    ln_f = start + clock[:, None] * rng.uniform(-0.03, 0.0, 5) + walk
    return ln_f, np.full((clock.size, 5, N_CHANNELS), np.nan), np.zeros(clock.size, dtype=bool)


KINDS = {
    "crossing, named by order": Kind(paths=crossing),
    "crossing, unnamed": Kind(paths=crossing, named=False),
    "crossing, with shapes": Kind(paths=crossing, shaped=True),
    "veering, with shapes": Kind(paths=veering, shaped=True),
    "merging": Kind(paths=merging),
    "crossing, missed and spurious": Kind(paths=crossing, gaps=True),
    "well apart": Kind(paths=separate),
}


def make_life(kind: Kind, rng: np.random.Generator) -> Life:
    """Draw a life of irregular logs."""
    steps = rng.gamma(2.0, size=N_LOGS - 1)
    clock = np.concatenate([[0.0], np.cumsum(steps) / steps.sum()])
    ln_f, shapes, unclear = kind.paths(clock, rng)
    names = [f"mode_{i + 1}" for i in range(ln_f.shape[1])]
    rows = [_log(kind, ln_f[k], shapes[k], names, rng) for k in range(clock.size)]
    upside = ln_f[:, 0] > ln_f[:, 1]
    turned = np.flatnonzero(unclear | (upside != upside[0]))
    before = int(turned[0]) if turned.size else N_LOGS // 2
    after = int(np.flatnonzero(unclear)[-1]) + 1 if unclear.any() else before
    epochs, truth = zip(*rows, strict=True)
    return Life(clock, epochs, truth, ln_f, before, after)


def _log(
    kind: Kind, ln_f: Array, shapes: Array, names: list[str], rng: np.random.Generator
) -> tuple[Estimates, tuple[int, ...]]:
    modes = [i for i in range(ln_f.size) if not (kind.gaps and rng.random() < MISSED)]
    values = ln_f[modes] + STD_F * rng.standard_normal(len(modes))
    seen = shapes[modes] + 0.05 * rng.standard_normal((len(modes), N_CHANNELS))
    if kind.gaps and rng.random() < SPURIOUS:
        modes.append(-1)
        values = np.append(values, ln_f.mean() + rng.uniform(-0.15, 0.15))
        seen = np.vstack([seen, rng.standard_normal(N_CHANNELS)])
    order = np.argsort(values)
    values, seen, modes = values[order], seen[order], [modes[i] for i in order]
    n = len(modes)
    # What is spurious has any damping; modes have the same, which cannot distinguish them.
    spread = np.where(np.array(modes, dtype=int) < 0, 1.0, STD_ZETA)
    zeta = np.log(0.015) + spread * rng.standard_normal(n)
    estimates = Estimates(
        names=_named(modes, values, ln_f, names) if kind.named else ("",) * n,
        sources=("acc",) * n,
        ln_frequency=values,
        ln_damping=zeta,
        cov=np.diag(np.repeat([STD_F**2, STD_ZETA**2], n)),
        shapes=seen if kind.shaped else np.empty((n, 0)),
    )
    return estimates, tuple(modes)


def _named(modes: list[int], values: Array, ln_f: Array, names: list[str]) -> tuple[str, ...]:
    """Name by order: a complete log by rank, others by the nearest place of that order."""
    if len(modes) == ln_f.size and -1 not in modes:
        return tuple(names)
    places = np.sort(ln_f)
    given = [names[int(np.argmin(np.abs(places - value)))] for value in values]
    return tuple(name if given.index(name) == i else "" for i, name in enumerate(given))


def judge(life: Life, labels: Labels) -> Counter[str]:
    """Compare labels with the truth; a track is the mode that it shows at first.

    For the logs before, in and after the crossing are counted estimates of modes, those labelled
    and those with the label of another mode; ``false_births`` are tracks of spurious estimates and
    second tracks of a mode; ``lives`` is 1, and ``lives_swapped`` if any is after the crossing.
    """
    own = _owners(life, labels)
    modes = list(own.values())
    count = Counter(lives=1, false_births=len(modes) - len({mode for mode in modes if mode >= 0}))
    for k, (given, truth) in enumerate(zip(labels, life.truth, strict=True)):
        part = "before" if k < life.before else "after" if k >= life.after else "near"
        for label, mode in zip(given, truth, strict=True):
            if mode < 0:
                count["spurious"] += 1
                count["taken"] += label is not None
            else:
                count[f"real_{part}"] += 1
                count[f"labelled_{part}"] += label is not None
                count[f"swapped_{part}"] += label is not None and own[label] != mode
    count["lives_swapped"] = int(count["swapped_after"] > 0)
    return count


def _owners(life: Life, labels: Labels) -> dict[str, int]:
    """Find the mode of each track: what most of its first five estimates are of."""
    shown: dict[str, list[int]] = {}
    for given, truth in zip(labels, life.truth, strict=True):
        for label, mode in zip(given, truth, strict=True):
            if label is not None:
                shown.setdefault(label, []).append(mode)
    return {label: Counter(modes[:5]).most_common(1)[0][0] for label, modes in shown.items()}


def recovered(life: Life, labels: Labels) -> NDArray[np.float64]:
    """Return the share labelled in each of the first logs after the crossing; NaN without one."""
    share = np.full(N_AFTER, np.nan)
    for j, k in enumerate(range(life.after, min(life.after + N_AFTER, len(labels)))):
        own = [
            given is not None for given, i in zip(labels[k], life.truth[k], strict=True) if i >= 0
        ]
        share[j] = np.mean(own) if own else np.nan
    return share


def nearest(life: Life) -> Labels:
    """Return each estimate to the mode that was last seen nearest: what is commonly done."""
    last = np.sort(life.ln_f[0])
    labels = []
    for epoch in life.epochs:
        given = []
        for value in epoch.ln_frequency:
            mode = int(np.argmin(np.abs(last - value)))
            given.append(f"track_{mode}")
            last[mode] = value
        labels.append(given)
    return labels
