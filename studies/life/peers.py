"""Is the remaining life predicted better than by particle filters and a line, on the same lives?

Method
    Lives of the study `kinds` (30 logs up to 50, 70 or 90 % of the life): losses of preload by two
    courses that the law of progpy's filter has as well (linear, power), and by one that it has not
    (late). `lmshealth` assesses raw estimates with the shipped laws. Peers: the `ParticleFilter` of
    progpy with 2,000 particles (100 by default) and its `MonteCarlo` predictor, as its guide to
    parameter estimation has it (travel, length and exponent of a power law, and a factor on each
    mode's drift, with small process noise in the filter and none in the prediction); a plain
    bootstrap particle filter (loss, its rate, whose logarithm is a random walk, and the factors;
    systematic resampling, propagation to the limit); the least-squares line of the modes' mean
    drift over the travel with its prediction interval (Student's t), up to the drift at the limit.
    They have advantages: the plant's map itself, that the mount stays, and, of the filters, the
    distribution of the lengths and the size of the map's error; temperature is removed by least
    squares on temperature and powers of the travel, and the first log is the baseline. Noise, walk
    and jitter of the filters were chosen by their scores on the first two kinds here.
    Scores on the same lives: coverage of 90 % intervals of health and of the remaining life, mean
    continuous ranked probability score (CRPS) of the remaining life in km, up to 10,000 km, root
    mean square error of the median of ln preload, and processor time in s. Control, which every
    program must surpass: the distribution of lengths without any log.
Run time
    A quarter of an hour on one processor. progpy comes with the extra ``peers``.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import numpy as np

from lmshealth.calibration.ranks import clopper_pearson
from studies.harness.claims import Claim, number
from studies.harness.metrics import crps, mean
from studies.harness.study import Row, Study
from studies.life.kinds.answers import answer
from studies.life.kinds.plant import LIMITS, MODES, Array, drift, map_table
from studies.life.kinds.worlds import LIFE_KM, MAP_ERROR, REFERENCE_C, Life, life_of

KINDS, LIVES = ("preload, linear", "preload, power", "preload, late"), 24
OURS, CONTROL = "lmshealth", "no log"
LOST = 1 - LIMITS["guide_preload"]
PARTICLES, SAMPLES, HORIZON_KM, STEP_KM = 2000, 300, 10_000.0, 20.0
# Of a log's ln f beside the map: stated errors, walk, and the baseline.
NOISE, JITTER, POWER_STD = 7e-4, 3e-4, 0.4
# Of the plain filter: particles, walk of ln rate over a median life, jitter of the factors.
PLAIN, RATE_WALK, FACTOR_JITTER = 5000, 0.5, 3e-3
_SCALES = [f"scale_{mode}" for mode in MODES]


def main() -> None:
    """Run the study; ``--quick`` does one life by all others and records nothing."""
    study = Study(__file__, __doc__)
    n, work = (1, WORK) if study.quick else (LIVES, {OURS: by_lmshealth} | WORK)
    rows, tasks = {}, [(kind, k) for kind in KINDS for k in range(n)]
    for name, own in work.items():
        found = study.trials.collect(own, tasks)
        rows[name] = {kind: scored(kind, found[i * n :][:n]) for i, kind in enumerate(KINDS)}
    study.conclude({"programs": rows, "passed": judge(rows)}, not_met=NOT_MET, quick_may_fail=True)


def by_lmshealth(kind: str, k: int) -> Row:
    """Assess a life, and return draws of ln preload now and of the travel left in km."""
    found = answer(life_of(kind, k).logs(), map_table(), k)
    health = found["health"].get("guide_preload")
    return {"health": health, "left": found["left_km"], "cpu_s": found["cpu_s"]}


def without_logs(kind: str, k: int) -> Row:
    """Return the distribution of the travel left by that of all lengths alone."""
    rng, life = np.random.default_rng(k), life_of(kind, k)
    length = LIFE_KM[0] * np.exp(LIFE_KM[1] * rng.standard_normal(10 * SAMPLES))
    left = length - life.travel[-1] / 1e3
    return {"health": None, "left": left[left > 0][:SAMPLES].tolist(), "cpu_s": 0.0}


def preload_model() -> Any:
    """Return a model of progpy, which is imported late."""
    from progpy import PrognosticsModel

    class Preload(PrognosticsModel):  # type: ignore[misc]
        """Loss of preload by a power of the travel, which is the time (km)."""

        is_vectorized = True
        inputs: ClassVar[list[str]] = []
        states: ClassVar = ["travel", "ln_life", "ln_power", *_SCALES]
        outputs: ClassVar = list(MODES)
        events: ClassVar = ["limit"]

        def next_state(self, x: Row, u: object, dt: float) -> object:
            kept = {name: x[name] for name in self.states}
            return self.StateContainer(kept | {"travel": x["travel"] + dt})

        def output(self, x: Row) -> object:
            found = _drift(np.atleast_1d(_ln_health(x))).T * [x[name] for name in _SCALES]
            return self.OutputContainer(dict(zip(MODES, found, strict=True)))

        def event_state(self, x: Row) -> dict[str, Array]:
            return {"limit": 1 - _loss(x) / LOST}

    noise = {"travel": 0.0, "ln_life": JITTER, "ln_power": JITTER}
    noise |= dict.fromkeys(_SCALES, JITTER / 10)
    return Preload(process_noise=noise, measurement_noise=NOISE)


def by_progpy(kind: str, k: int) -> Row:
    """Filter a life by progpy, and predict it."""
    from progpy.predictors import MonteCarlo
    from progpy.state_estimators import ParticleFilter
    from progpy.uncertain_data import UnweightedSamples

    start, life, rng = time.process_time(), life_of(kind, k), np.random.default_rng(k)
    np.random.seed(k)  # noqa: NPY002 (progpy draws from the global generator)
    model = preload_model()
    prior = {
        "travel": np.zeros(PARTICLES),
        "ln_life": rng.normal(np.log(LIFE_KM[0]), LIFE_KM[1], PARTICLES),
        "ln_power": rng.normal(0.0, POWER_STD, PARTICLES),
        **{scale: rng.normal(1.0, MAP_ERROR, PARTICLES) for scale in _SCALES},
    }
    begin = UnweightedSamples(prior, _type=model.StateContainer)
    own = ParticleFilter(model, begin, measurement_noise=dict.fromkeys(MODES, NOISE))
    travel, seen = _drifts(life)
    for s, row in zip(travel, seen.tolist(), strict=True):
        if s > own.t:
            own.estimate(s, {}, dict(zip(MODES, row, strict=True)), dt=s - own.t)
    now = {name: np.array(own.x.key(name), dtype=float) for name in model.states}
    model.parameters["process_noise"] = 0
    predicted = MonteCarlo(model).predict(
        own.x.sample(SAMPLES), t0=travel[-1], dt=STEP_KM, horizon=travel[-1] + HORIZON_KM,
        save_freq=1e9,
    )  # fmt: skip
    ends = [np.inf if one is None else float(one) for one in predicted.time_of_event.key("limit")]
    left = np.minimum(np.array(ends) - travel[-1], HORIZON_KM)
    cpu_s = time.process_time() - start
    return {"health": _ln_health(now).tolist(), "left": left.tolist(), "cpu_s": cpu_s}


def _loss(x: Row) -> Array:
    """Return the loss of preload of states."""
    share = np.maximum(np.asarray(x["travel"], dtype=float), 1e-9) / np.exp(x["ln_life"])
    return np.asarray(LOST * share ** np.exp(x["ln_power"]))


def _ln_health(x: Row) -> Array:
    return np.asarray(np.log1p(-np.minimum(_loss(x), 0.95)))


def _drifts(life: Life) -> tuple[Array, Array]:
    """Return travel in km, and ln f since the first log without the effect of temperature."""
    travel, warm = life.travel / 1e3, life.temperature - REFERENCE_C
    table = np.column_stack([travel[:, None] ** [0, 0.5, 1, 2], warm])
    seen = life.ln_f - np.outer(warm, np.linalg.lstsq(table, life.ln_f, rcond=None)[0][-1])
    return travel, seen - seen[0]


def _drift(ln_preload: Array) -> Array:
    """Return the drifts of the modes by the map, ``(..., n_modes)``."""
    return drift(np.stack([ln_preload, 0 * ln_preload], axis=-1))


def by_particles(kind: str, k: int) -> Row:
    """Filter a life by a bootstrap filter of loss, ln rate and factors, and propagate it."""
    start, life, rng = time.process_time(), life_of(kind, k), np.random.default_rng([k, 1])
    travel, seen = _drifts(life)
    walk, loss = RATE_WALK / np.sqrt(LIFE_KM[0]), np.zeros(PLAIN)
    ln_rate = np.log(LOST / LIFE_KM[0]) + LIFE_KM[1] * rng.standard_normal(PLAIN)
    factor = 1 + MAP_ERROR * rng.standard_normal((PLAIN, len(MODES)))
    for step, row in zip(np.diff(travel), seen[1:], strict=True):
        ln_rate += walk * np.sqrt(step) * rng.standard_normal(PLAIN)
        loss = np.minimum(loss + step * np.exp(ln_rate), 0.95)
        misfit = np.sum((row - factor * _drift(np.log1p(-loss))) ** 2, axis=1) / NOISE**2
        below = np.cumsum(np.exp(-0.5 * (misfit - misfit.min())))
        # Systematic resampling; the factors, which have no process, are jittered.
        chosen = np.searchsorted(below / below[-1], (np.arange(PLAIN) + rng.uniform()) / PLAIN)
        loss, ln_rate, factor = loss[chosen], ln_rate[chosen], factor[chosen]
        factor += FACTOR_JITTER * rng.standard_normal(factor.shape)
    steps = rng.standard_normal((int(HORIZON_KM / STEP_KM), PLAIN))
    rates = np.exp(ln_rate + walk * np.sqrt(STEP_KM) * np.cumsum(steps, axis=0))
    whole = np.sum(loss + STEP_KM * np.cumsum(rates, axis=0) < LOST, axis=0)
    return _answer(np.log1p(-loss), STEP_KM * (whole + 0.5), start)


def by_line(kind: str, k: int) -> Row:
    """Extrapolate the least-squares line of the mean drift to its value at the limit."""
    start, life, rng = time.process_time(), life_of(kind, k), np.random.default_rng([k, 2])
    travel, seen = _drifts(life)
    table = np.column_stack([np.ones_like(travel), travel])
    best, rss, *_ = np.linalg.lstsq(table, seen.mean(axis=1), rcond=None)
    std = np.sqrt(rss / rng.chisquare(travel.size - 2, PLAIN))
    root = np.linalg.cholesky(np.linalg.inv(table.T @ table))
    level, slope = best[:, None] + std * (root @ rng.standard_normal((2, PLAIN)))
    grid = np.linspace(-1.5, 0.5, 2001)  # of ln preload
    by_map = _drift(grid).mean(axis=1)
    limit = np.interp(np.log1p(-LOST), grid, by_map) - std * rng.standard_normal(PLAIN)
    end = np.where(slope < 0, (limit - level) / np.minimum(slope, -1e-12), np.inf)
    now = np.interp(level + slope * travel[-1], by_map, grid)
    return _answer(now, np.clip(end - travel[-1], 0.0, HORIZON_KM), start)


def _answer(health: Array, left: Array, start: float) -> Row:
    """Return draws of ln preload and of the travel left in km, and the processor time in s."""
    health, left = (draws[:: PLAIN // SAMPLES].tolist() for draws in (health, left))
    return {"health": health, "left": left, "cpu_s": time.process_time() - start}


WORK = {"progpy": by_progpy, "plain particle filter": by_particles, "straight line": by_line,
        CONTROL: without_logs}  # fmt: skip
_LATE = "no log shows the fast end yet: no law of a peer has it, and by ours it may begin any time"
NOT_MET = {f"preload, late: {name} predicts better than no log": _LATE for name in (OURS, *WORK)}
NOT_MET["preload, power: straight line predicts better than no log"] = "the drift is not even"


def scored(kind: str, found: list[Row]) -> Row:
    """Score the answers to lives of a kind; lists have a value of each life, None without one."""
    lives = [life_of(kind, k) for k in range(len(found))]
    row: Row = {"n": len(found), "cpu_s": float(np.median([own["cpu_s"] for own in found]))}
    truths = {"health": [one.ln_health[-1, 0] for one in lives]}
    for what, truth in (truths | {"left": [one.left_km for one in lives]}).items():
        each = [_placed(t, own[what]) for t, own in zip(truth, found, strict=True)]
        there = [one for one in each if one]
        row[what] = {
            "held": [sum(one["held"] for one in there), len(there)],
            "width": float(np.median([one["width"] for one in there])) if there else None,
            **{key: [one and one[key] for one in each] for key in ("crps", "square")},
        }
    return row


def _placed(truth: float, draws: list[float] | None) -> Row | None:
    """Return score, squared error of the median, width of the 90 % interval, and if it holds."""
    if not draws:
        return None
    low, middle, high = np.quantile(draws, [0.05, 0.5, 0.95])
    score = crps(np.array(draws)[:, None], np.array([truth]), horizon=HORIZON_KM)[0]
    row = {"crps": float(score), "square": float(middle - truth) ** 2, "width": float(high - low)}
    return row | {"held": bool(low <= truth <= high)}


def judge(rows: Row) -> dict[str, bool]:
    """Return whether logs help all, and whether `lmshealth` holds what it states and is better."""
    passed = {}
    for kind in KINDS:
        score = {name: mean(row[kind]["left"]["crps"])[0] for name, row in rows.items()}
        none, own = score.pop(CONTROL), score.get(OURS)
        for name, value in score.items():
            passed[f"{kind}: {name} predicts better than no log"] = value < none
            passed |= {f"{kind}: as good as {name}": own <= value} if own else {}
        if own:
            held = clopper_pearson(*rows[OURS][kind]["left"]["held"])
            passed[f"{kind}: intervals hold"] = held[1] >= 0.9
    return passed


def claims(answer: Row) -> Iterator[Claim]:
    """Claim errors, coverage and time; not met where a peer, or no log, has the smaller figure."""
    rows = answer["programs"]
    for kind in KINDS:
        own = {name: row[kind] for name, row in rows.items()}
        score = {name: mean(row["left"]["crps"]) for name, row in own.items()}
        what, lives = "score of the remaining life (0 is best)", f", {own[OURS]['n']} lives"
        yield _least(f"{what}, {kind}", score, " km", lives)
        square = {k: mean(row["health"]["square"]) for k, row in own.items() if k != CONTROL}
        off = {k: (value**0.5, error / (2 * value**0.5)) for k, (value, error) in square.items()}
        yield _least(f"root mean square error of ln preload now, {kind}", off, "", lives)
        what = f"90 % intervals that hold the remaining life, and their median width, {kind}"
        counts = {name: _counts(row) for name, row in own.items()}
        figure, met = counts.pop(OURS), answer["passed"][f"{kind}: intervals hold"]
        yield Claim(what, figure, "", _beside(counts), met)
    cpu = {k: (max(row[kind]["cpu_s"] for kind in KINDS), 0.0) for k, row in rows.items()}
    cpu.pop(CONTROL)
    yield _least("processor time a life", cpu, " s", "")


def _least(what: str, found: Mapping[str, tuple[float, float]], unit: str, more: str) -> Claim:
    """Claim a figure with its error, and that no other program has a smaller one."""
    texts = {name: f"{number(value)}{unit}" for name, (value, _) in found.items()}
    figure, (own, error) = texts.pop(OURS), found[OURS]
    interval = f"± {number(error)}{unit}{more}" if error else ""
    return Claim(what, figure, interval, _beside(texts), own <= min(found.values())[0])


def _beside(texts: Mapping[str, str]) -> str:
    return "; ".join(f"{name} {text}" for name, text in texts.items())


def _counts(row: Row) -> str:
    (held, n), (known, all_) = row["left"]["held"], row["health"]["held"]
    more = f", of preload now {known} of {all_}" if all_ else ""
    return f"{held} of {n}, {number(row['left']['width'])} km{more}"


if __name__ == "__main__":
    main()
