"""Is the remaining life predicted better than by the particle filter of progpy, on the same lives?

Method
    Lives of the study `kinds` (30 logs up to 50, 70 or 90 % of the life): losses of preload by two
    courses that the peer's law has as well (linear, power), and by one that it has not (late).
    `lmshealth` assesses raw estimates with the shipped laws. The peer is the `ParticleFilter` of
    progpy with 2,000 particles (100 by default) and its `MonteCarlo` predictor, as its guide to
    parameter estimation has it: states are the travel, the length and the exponent of a power law,
    and a factor on each mode's drift, with small process noise in the filter and none in the
    prediction. It has advantages: the plant's map itself, that the mount stays, the
    distribution of the lengths, and the size of the map's error; temperature is removed by least
    squares on temperature and powers of the travel, and the first log is the baseline.
    Scores of both on the same lives: coverage of 90 % intervals of health and of the remaining
    life, mean continuous ranked probability score of the remaining life up to 10,000 km, and
    processor time. Control, which must be worse: the distribution of lengths without any log.
    Noise, jitter and baseline of the peer were chosen by its scores on the first two kinds here.
Run time
    Ten minutes on one processor. progpy comes with the extra ``peers``.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np

from lmshealth.calibration.ranks import clopper_pearson
from studies.harness.claims import Claim, number
from studies.harness.metrics import crps
from studies.harness.study import Row, Study
from studies.life.kinds.answers import IMPORTANCE, answer
from studies.life.kinds.plant import LIMITS, MODES, Array, drift, map_table
from studies.life.kinds.worlds import LIFE_KM, MAP_ERROR, REFERENCE_C, life_of

KINDS, LIVES = ("preload, linear", "preload, power", "preload, late"), 8
PEER, OURS, CONTROL = "progpy", "lmshealth", "no log"
LOST = 1 - LIMITS["guide_preload"]
PARTICLES, SAMPLES, HORIZON_KM, STEP_KM = 2000, 300, 10_000.0, 20.0
# Of a log's ln f beside the map: stated errors, walk, and the baseline.
NOISE, JITTER, POWER_STD = 7e-4, 3e-4, 0.4
NOT_MET = {
    f"preload, late: {name} predicts better than no log": f"a fast end that no log shows yet: {why}"
    for name, why in ((PEER, "its law has none"), (OURS, "it may begin at any time"))
}
_SCALES = [f"scale_{mode}" for mode in MODES]


def main() -> None:
    """Run the study; ``--quick`` does one life by the peer alone and records nothing."""
    study = Study(__file__, __doc__)
    tasks = [(kind, k) for k in range(1 if study.quick else LIVES) for kind in KINDS]
    work = {PEER: by_progpy, CONTROL: without_logs} | ({} if study.quick else {OURS: by_lmshealth})
    found = {name: study.trials.collect(own, tasks) for name, own in work.items()}
    rows = {
        name: {kind: scored(kind, [one for one, task in zip(own, tasks, strict=True)
                                   if task[0] == kind]) for kind in KINDS}
        for name, own in found.items()
    }  # fmt: skip
    study.conclude({"programs": rows, "passed": judge(rows)}, not_met=NOT_MET, quick_may_fail=True)


def by_lmshealth(kind: str, k: int) -> Row:
    """Assess a life, and return draws of ln preload now and of the travel left in km."""
    found = answer(life_of(kind, k).logs(), map_table(), k, IMPORTANCE)
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

        def initialize(self, u: object = None, z: object = None) -> object:
            return self.StateContainer(dict.fromkeys(self.states, 0.0))

        def next_state(self, x: Row, u: object, dt: float) -> object:
            kept = {name: x[name] for name in self.states}
            return self.StateContainer(kept | {"travel": x["travel"] + dt})

        def output(self, x: Row) -> object:
            ln_health = np.atleast_1d(_ln_health(x))
            found = drift(np.stack([ln_health, 0 * ln_health], axis=-1))
            scales = [x[name] for name in _SCALES]
            return self.OutputContainer(dict(zip(MODES, found.T * scales, strict=True)))

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
    rows = zip(*(values.tolist() for values in prior.values()), strict=True)
    particles = [model.StateContainer(dict(zip(prior, row, strict=True))) for row in rows]
    begin = UnweightedSamples(particles, _type=model.StateContainer)
    own = ParticleFilter(model, begin, measurement_noise=dict.fromkeys(MODES, NOISE))
    # Ln f since the first log, without the effect of temperature.
    travel, warm = life.travel / 1e3, life.temperature - REFERENCE_C
    table = np.column_stack([travel[:, None] ** [0, 0.5, 1, 2], warm])
    seen = life.ln_f - np.outer(warm, np.linalg.lstsq(table, life.ln_f, rcond=None)[0][-1])
    seen -= seen[0]
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


def scored(kind: str, found: list[Row]) -> Row:
    """Score the answers to lives of a kind, of which the first ones are asked for."""
    lives = [life_of(kind, k) for k in range(len(found))]
    both = list(zip(lives, found, strict=True))
    health = [(one.ln_health[-1, 0], own["health"]) for one, own in both if own["health"]]
    left = [(one.left_km, np.array(own["left"])) for one, own in both if own["left"]]
    scores = [float(crps(own[:, None], np.array([t]), horizon=HORIZON_KM)[0]) for t, own in left]
    off = [np.median(own) - t for t, own in health]
    return {
        "n": len(found),
        "health": _held([(t, np.array(own)) for t, own in health]),
        "health_rms": float(np.sqrt(np.mean(np.square(off)))) if off else None,
        "left": _held(left),
        "left_width": float(np.median([np.ptp(np.quantile(own, [0.05, 0.95])) for _, own in left])),
        "crps_km": float(np.mean(scores)),
        "cpu_s": float(np.median([own["cpu_s"] for own in found])),
    }


def _held(pairs: list[tuple[float, Array]]) -> list[int]:
    """Count the truths inside 90 % intervals, and all."""
    inside = [np.quantile(own, 0.05) <= t <= np.quantile(own, 0.95) for t, own in pairs]
    return [sum(map(bool, inside)), len(inside)]


def judge(rows: Row) -> dict[str, bool]:
    """Return whether logs help both, and whether `lmshealth` holds what it states and is better."""
    score = {name: {kind: own[kind]["crps_km"] for kind in KINDS} for name, own in rows.items()}
    passed = {
        f"{kind}: {name} predicts better than no log": score[name][kind] < score[CONTROL][kind]
        for name in rows
        for kind in KINDS
        if name != CONTROL
    }
    for kind, row in rows.get(OURS, {}).items():
        passed[f"{kind}: as good as {PEER}"] = score[OURS][kind] <= score[PEER][kind]
        passed[f"{kind}: intervals hold"] = clopper_pearson(*row["left"])[1] >= 0.9
    return passed


def claims(answer: Row) -> Iterator[Claim]:
    """Claim error, coverage and time beside the peer, and where the peer is better."""
    rows = answer["programs"]
    for kind in KINDS:
        ours, peer, none = (rows[name][kind] for name in (OURS, PEER, CONTROL))
        yield Claim(
            f"score of the remaining life (0 is best), {kind}",
            f"{number(ours['crps_km'])} km",
            f"{ours['n']} lives",
            f"{PEER} {number(peer['crps_km'])} km, no log {number(none['crps_km'])} km",
            ours["crps_km"] <= peer["crps_km"],
        )
        yield Claim(
            f"90 % intervals that hold the remaining life, and their median width, {kind}",
            _counts(ours),
            beside=f"{PEER} {_counts(peer)}; preload now {_health(ours)}, {PEER} {_health(peer)}",
            met=answer["passed"][f"{kind}: intervals hold"],
        )
    ours, peer = (max(rows[name][kind]["cpu_s"] for kind in KINDS) for name in (OURS, PEER))
    yield Claim("processor time a life", f"{number(ours)} s", beside=f"{PEER} {number(peer)} s")


def _counts(row: Row) -> str:
    return f"{row['left'][0]} of {row['left'][1]}, {number(row['left_width'])} km"


def _health(row: Row) -> str:
    return f"{row['health'][0]} of {row['health'][1]} with rms {number(row['health_rms'])} of ln"


if __name__ == "__main__":
    main()
