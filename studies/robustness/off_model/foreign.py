"""Are close modes kept apart where another program states errors that are far off?

Method
    Masts with two pairs of close modes (1.5 to 2.5 and 4 to 8 Hz, 6 to 12 standard deviations of
    the scatter apart) whose frequencies follow the temperature by -4e-4 per K (10 %): 100 hourly
    logs, with up to 14 K by the weather and 6 K by the day. Estimates scatter by 0.05 to 0.15 %; a
    tenth of them is missing, 5 % of the logs have a spurious one. Stated standard deviations are
    those of the scatter times 0.25, 1, 4, 8 or 15, and 30 % up or down from log to log. Modes have
    no name, the right name (without and with a description of modes and temperature), or only a
    description. Judged are labels, modes, alarms and 90 % intervals of the temperature's slopes.
    Control, which must fail: association that takes stated errors as they are, as before.
Run time
    23 minutes on two shared processors.
"""

from __future__ import annotations

import zlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import timedelta
from unittest.mock import patch

import numpy as np

from lmshealth.calibration.lives import START
from lmshealth.calibration.ranks import share_row
from lmshealth.io.log import Metadata
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.modes import Modes
from lmshealth.stage.description import Covariate, Description, ModeSpec, Stage
from lmshealth.tracking import constants
from lmshealth.tracking.association import associate
from lmshealth.tracking.history import History, build_history
from lmshealth.tracking.track import track
from studies.harness.claims import Claim, counted
from studies.harness.study import Row, Study
from studies.robustness.off_model.worlds import Array

SEED, N_LIVES, N_LOGS, CONTROL_LOGS = 20261125, 5, 100, 50
FACTORS = (0.25, 1.0, 4.0, 8.0, 15.0)
NAMES = ("unnamed", "named", "named and described", "described")
QUICK = (("named and described", 8.0, 0, 24), ("unnamed", 8.0, 0, 24))
MISSING, SPURIOUS, APART = 0.1, 0.05, (6.0, 12.0)
MODES = ("a1", "a2", "b1", "b2")
REFERENCE_C, PER_KELVIN = 10.0, -4e-4
# Asked for: labels given, and right ones among them, lives that alarm, slopes held at 90 %.
LEAST_GIVEN, LEAST_RIGHT, MOST_ALARMS, LEAST_HELD = 0.9, 0.99, 0.02, 0.85
_REACH = 1.6448536  # standard deviations of a 90 % interval
NOT_MET = {"alarms": "3 of 100 alarm; a rate of 2 % gives as many in one of three samples"}


@dataclass(frozen=True, slots=True, eq=False)
class Mast:
    """Estimates of a mast, with the mode that each is of."""

    logs: tuple[LogEstimates, ...]
    truth: dict[tuple[int, float], int]  # mode by log and ln f of an estimate, -1 if spurious
    ln_f: Array  # at the reference temperature, ``(n_modes,)``
    per_kelvin: Array  # slopes of ln f, ``(n_modes,)``


def main() -> None:
    """Run the study; ``--quick`` takes two short lives and records nothing."""
    study = Study(__file__, __doc__)
    tasks = [(n, f, k, N_LOGS) for k in range(N_LIVES) for n in NAMES for f in FACTORS]
    controls = [(names, f, 0, CONTROL_LOGS) for names in NAMES for f in (4.0, 15.0)]
    with study.pool() as pool:
        rows = study.trials.collect(one, list(QUICK) if study.quick else tasks, pool=pool)
        before = study.trials.collect(one_before, QUICK[1:] if study.quick else controls, pool=pool)
    answer: Row = {
        "seed": SEED,
        "factors": {str(f): summed([row for row in rows if row["factor"] == f]) for f in FACTORS
                    if any(row["factor"] == f for row in rows)},
        "names": {n: summed([row for row in rows if row["names"] == n]) for n in NAMES
                  if any(row["names"] == n for row in rows)},
        "all": summed(rows),
        "control": summed(before),
    }  # fmt: skip
    answer["passed"] = verdicts(answer)
    study.conclude(answer, not_met=NOT_MET, quick_may_fail=True)


def mast(names: str, factor: float, seed: int, n_logs: int) -> Mast:
    """Draw a mast and its estimates."""
    rng = np.random.default_rng([SEED, seed, zlib.crc32(f"{names} {factor}".encode())])
    pair = np.array([0, 0, 1, 1])
    scatter = rng.uniform(5e-4, 1.5e-3, 2)[pair]
    half = 0.5 * scatter * rng.uniform(*APART, 2)[pair]
    centre = np.log([rng.uniform(1.5, 2.5), rng.uniform(4.0, 8.0)])[pair]
    ln_f = centre + half * (-1, 1, -1, 1)
    per_kelvin = PER_KELVIN * np.exp(0.1 * rng.standard_normal(4))
    hours = np.arange(n_logs) + rng.uniform(-0.2, 0.2, n_logs)
    warm = 7 * np.sin(2 * np.pi * (hours / (2.5 * N_LOGS) + rng.uniform()))
    warm += 3 * np.sin(2 * np.pi * hours / 24)
    logs, truth = [], dict[tuple[int, float], int]()
    for k in range(n_logs):
        found = np.flatnonzero(rng.random(4) >= MISSING)
        place = ln_f[found] + per_kelvin[found] * warm[k]
        place += scatter[found] * rng.standard_normal(found.size)
        std = scatter[found] * np.exp(0.3 * rng.standard_normal(found.size))
        if rng.random() < SPURIOUS:
            place = np.append(place, np.log(rng.uniform(1.0, 10.0)))
            std, found = np.append(std, 1e-3), np.append(found, -1)
        order = np.argsort(place)
        found, place = found[order], place[order]
        given = tuple(MODES[i] if i >= 0 and names.startswith("named") else "" for i in found)
        zeta = np.log(0.01) + 0.2 * rng.standard_normal(found.size)
        cov = np.diag((factor * np.r_[std[order], np.full(found.size, 0.2)]) ** 2)
        moment = Metadata("mast", START + timedelta(hours=float(hours[k])), None,
                          {"temperature_c": REFERENCE_C + float(warm[k])})  # fmt: skip
        logs.append(LogEstimates(f"{k:05d}", "", moment, modes_of(given, place, zeta, cov)))
        truth |= {(k, float(y)): int(i) for y, i in zip(place, found, strict=True)}
    return Mast(tuple(logs), truth, ln_f, per_kelvin)


def modes_of(names: tuple[str, ...], ln_f: Array, ln_zeta: Array, cov: Array) -> Modes:
    """Make estimates without shapes."""
    n, unknown = len(names), np.full(len(names), np.nan)
    return Modes(
        names=names, sources=("acc",) * n, channels=("",) * n, ln_frequency=ln_f,
        ln_damping=ln_zeta, cov=cov, snr=unknown, dispersion=unknown, flags=("",) * n,
        shape_channels=(), shapes=np.empty((n, 0)), lines=(), refused=(),
    )  # fmt: skip


def described(life: Mast) -> Stage:
    """Describe the modes of a mast and its temperature."""
    modes = tuple(
        ModeSpec(name, float(f), 0.01, search=0.1)
        for name, f in zip(MODES, np.exp(life.ln_f), strict=True)
    )
    covariate = Covariate("temperature_c", REFERENCE_C, constants.COVARIATE_STD)
    return Stage(Description(name="mast", mode=modes, covariate=(covariate,)), None, "0" * 64)


def one(names: str, factor: float, seed: int, n_logs: int) -> Row:
    """Associate and track one life, and judge it."""
    life = mast(names, factor, seed, n_logs)
    stage = described(life) if "described" in names else None
    history, refused = build_history(life.logs, stage)
    row, of = judge(life, history, names)
    found = track(history, stage)
    slopes = [e for e in found.effects if e.covariate == "temperature_c" and e.mode in of]
    off = [e.coefficient - float(life.per_kelvin[of[e.mode]]) for e in slopes]
    return {
        **row,
        "names": names,
        "factor": factor,
        "ambiguous": sum(refusal.reason == "ambiguous" for refusal in refused),
        "slopes": len(slopes),
        "slopes_held": sum(abs(o) < _REACH * e.std for o, e in zip(off, slopes, strict=True)),
        "alarms": len(found.alarms),
    }


def _unscaled(logs: Sequence[object], *_: object) -> list[dict[str, float]]:
    return [{}] * len(logs)


def one_before(names: str, factor: float, seed: int, n_logs: int) -> Row:
    """Associate one life with the errors as they are stated."""
    life = mast(names, factor, seed, n_logs)
    with ExitStack() as stack:
        stack.enter_context(patch.object(constants, "TAKING_PROBABILITY", 1.0))
        stack.enter_context(patch.object(associate, "learn_scales", _unscaled))
        history, refused = build_history(life.logs, described(life) if "desc" in names else None)
    ambiguous = sum(refusal.reason == "ambiguous" for refusal in refused)
    return {**judge(life, history, names)[0], "names": names, "factor": factor,
            "ambiguous": ambiguous}  # fmt: skip


def judge(life: Mast, history: History, names: str) -> tuple[Row, dict[str, int]]:
    """Count labels, and find the true mode that each mode of the history is: most of its labels."""
    labels: dict[str, Counter[int]] = defaultdict(Counter)
    for c, series in enumerate(history.series):
        for k in np.flatnonzero(np.isfinite(history.ln_frequency[:, c])).tolist():
            labels[series.mode][life.truth[k, float(history.ln_frequency[k, c])]] += 1
    of = {mode: count.most_common(1)[0][0] for mode, count in labels.items()}
    right = sum(count[of[mode]] for mode, count in labels.items())
    kept = sorted(of.values()) == list(range(len(MODES)))
    if names != "unnamed" and names != "named":
        kept = kept and all(MODES[i] == mode for mode, i in of.items())
    row = {
        "real": sum(i >= 0 for i in life.truth.values()),
        "given": sum(count.total() for count in labels.values()),
        "right": right,
        "kept": kept,  # every mode once, under its own name where a description has it
    }
    return row, {mode: i for mode, i in of.items() if i >= 0}


def summed(rows: list[Row]) -> Row:
    """Sum what was counted."""
    counts = ("real", "given", "right", "ambiguous", "slopes", "slopes_held")
    total = {key: sum(row.get(key, 0) for row in rows) for key in counts}
    lives: Row = {key: share_row(sum(bool(row[key]) for row in rows), len(rows))
             for key in ("kept", "alarms") if key in rows[0]}  # fmt: skip
    return {**total, **lives}


def verdicts(answer: Row) -> dict[str, bool]:
    """Return whether modes and slopes are right whatever is stated, and the control fails."""
    checks: dict[str, bool] = {}
    for factor, row in answer["factors"].items():
        checks[f"labels given: {factor}"] = row["given"] >= LEAST_GIVEN * row["real"]
        checks[f"labels right: {factor}"] = row["right"] >= LEAST_RIGHT * row["given"]
        checks[f"modes kept: {factor}"] = row["kept"]["hits"] == row["kept"]["n"]
    every, before = answer["all"], answer["control"]
    checks["alarms"] = every["alarms"]["share"] <= MOST_ALARMS
    checks["slopes held"] = every["slopes_held"] >= LEAST_HELD * every["slopes"]
    checks["with errors as stated labels are missing (control)"] = (
        before["given"] < LEAST_GIVEN * before["real"]
    )
    return checks


def claims(answer: Row) -> Iterator[Claim]:
    """Claim labels, modes, slopes and alarms, beside the control."""
    passed, before = answer["passed"], answer["control"]
    for factor, row in answer["factors"].items():
        beside = f"{100 * row['given'] / row['real']:.0f} % of the estimates have a label, "
        beside += f"{100 * row['right'] / row['given']:.1f} % of these the right one"
        yield counted(
            f"errors stated {factor} times: lives whose four close modes are kept",
            row["kept"]["hits"],
            row["kept"]["n"],
            beside,
            met=all(fine for name, fine in passed.items() if name.endswith(f": {factor}")),
        )
    every = answer["all"]
    yield counted(
        "temperature slopes inside their 90 % intervals",
        every["slopes_held"],
        every["slopes"],
        f"control: {100 * before['given'] / before['real']:.0f} % of the estimates have a label",
        met=passed["slopes held"],
    )
    alarms = every["alarms"]
    yield counted("healthy masts that alarm", alarms["hits"], alarms["n"], met=passed["alarms"])


if __name__ == "__main__":
    main()
