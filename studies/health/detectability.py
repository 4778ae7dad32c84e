"""Which loss of preload or mount stiffness is detectable, with how many logs of which length?

Method
    Maps of `lmshealth.plan` (as many logs now as in the baseline) give the smallest loss that a
    one-sided test detects with 95 % power at 1 % false alarms. At some points drifts are drawn
    with the planned covariance, and a loss is detected if their posterior by quadrature, under
    the prior of the description and the error of the map, gives it more than 99 %: for the
    planned loss and for none; as planned (map exact, other parameter drawn from its prior), and
    as shipped (map sensitivities good to 5 %, or to 10 % with a probability of a quarter) with
    the other parameter unchanged or drawn from its prior. Shares have 99.9 % Clopper-Pearson
    intervals. The Cramér-Rao law of planning is compared with standard deviations and errors of
    identified simulated logs of four lengths.
Run time
    Six minutes on one processor.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import msgspec
import numpy as np

from lmshealth.calibration.ranks import judge_coverage
from lmshealth.errors import BadQuestion
from lmshealth.stage.constants import MAP_ERRORS
from lmshealth.stage.description import Stage, load_stage
from lmshealth.stage.identifiability import identifiability_of, plan
from models.dynamics.plant import GUIDE_MODES
from models.lives.simulation import Plan
from studies.harness.claims import Claim, covered, percents, span
from studies.harness.data.cramer_rao import long_record_law
from studies.harness.data.lives import Array, identified, life_of, rng_of
from studies.harness.study import Row, Study

SHORT, LONG = (1, 20.0), (20, 300.0)  # logs, and seconds of each

POWER, FALSE_ALARM = 0.95, 0.01
ASKED = (("lms-y", "guide_preload"), ("lms-y", "mount_stiffness"), ("lms-x", "guide_preload"))
# What no log shows: the mount that the housing of X is bolted to over its full surface.
UNSEEN = ("lms-x", "mount_stiffness")
DURATIONS = (10.0, 15.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0, 300.0, 450.0, 600.0)
COUNTS: tuple[int, ...] = (1, 2, 3, 5, 8, 12, 20, 30, 50, 100)
CHECKED = ((20.0, 1), (60.0, 5), (300.0, 20))
RAW_DURATIONS: tuple[float, ...] = (10.0, 20.0, 60.0, 120.0)
RAW_LOGS = 16
N_GRID = 61  # points of the quadrature in each direction
SEED = 31


def main() -> None:
    """Run the study; ``--quick`` plans and checks less, and records nothing."""
    study = Study(__file__, __doc__)
    n, seconds, logs, counts = 300, RAW_DURATIONS, RAW_LOGS, COUNTS
    if study.quick:
        n, seconds, logs, counts = 2, (10.0,), 2, COUNTS[::3]
    each = study.trials.collect
    answer: Row = {
        "power": POWER,
        "false_alarm": FALSE_ALARM,
        "durations_s": list(DURATIONS),
        "logs": list(counts),
        "maps": [smallest_losses(*asked, counts) for asked in ASKED],
        "unseen": refused(*UNSEEN),
        "checks": [row for rows in each(checks, [(*asked, n) for asked in ASKED]) for row in rows],
        "law": law("lms-y"),
        "identified": each(measured, [("lms-y", duration, logs) for duration in seconds]),
    }
    study.conclude(answer | {"passed": verdicts(answer)}, quick_may_fail=True)


def stage_with(name: str, *, baseline: int = 5, model_std: float | None = None) -> Stage:
    """Load a description with another number of baseline logs, or error of the map."""
    stage = load_stage(name)
    spec = stage.description.map
    assert spec is not None
    if model_std is not None:
        spec = msgspec.structs.replace(spec, model_std=model_std, common_std=0.0)
    first = msgspec.structs.replace(stage.description.baseline, logs=baseline)
    description = msgspec.structs.replace(stage.description, map=spec, baseline=first)
    return replace(stage, description=description)


def smallest_losses(name: str, parameter: str, counts: tuple[int, ...]) -> Row:
    """Find the smallest loss for every length and number of logs, ``(n_counts, n_durations)``."""
    table = []
    for n in counts:
        found = plan(
            stage_with(name, baseline=n), parameter, 0.05,
            power=POWER, false_alarm=FALSE_ALARM, durations=DURATIONS,
        )  # fmt: skip
        # Logs that are too short to be identified have no loss.
        losses = [effort.smallest_loss_many for effort in found.efforts]
        table.append([None if np.isnan(loss) else loss for loss in losses])
    return {"stage": name, "parameter": parameter, "smallest_loss": table}


def refused(name: str, parameter: str) -> Row:
    """Return the answer of planning to a parameter that the modes do not constrain."""
    message = None
    try:
        plan(load_stage(name), parameter, 0.05)
    except BadQuestion as error:
        message = str(error)
    return {"stage": name, "parameter": parameter, "message": message}


def checks(name: str, parameter: str, trials: int) -> list[Row]:
    """Count calls of the planned smallest loss, and of none, at some points."""
    rows = []
    arms = {
        "as planned": (0.0, True),
        "as shipped, the other as it was": (None, False),
        "as shipped, the other from its prior": (None, True),
    }
    for point, (duration, n) in enumerate(CHECKED):
        found = plan(
            stage_with(name, baseline=n), parameter, 0.05,
            power=POWER, false_alarm=FALSE_ALARM, durations=(duration,),
        )  # fmt: skip
        loss = found.efforts[0].smallest_loss_many
        for arm, (model_std, free) in arms.items():
            stage = stage_with(name, model_std=model_std)
            variance = identifiability_of(stage).drift_variance(duration, n, n)
            rng = rng_of(SEED, ASKED.index((name, parameter)), point, len(arm))
            hits, false = (
                sum(called(stage, parameter, size, variance, free, rng) for _ in range(trials))
                for size in (loss, 0.0)
            )
            rows.append({
                "stage": name, "parameter": parameter, "arm": arm, "duration_s": duration,
                "logs": n, "smallest_loss": loss, "power": judge_coverage(hits, trials, POWER),
                "false_alarms": judge_coverage(false, trials, FALSE_ALARM),
            })  # fmt: skip
    return rows


def called(
    stage: Stage, parameter: str, loss: float, variance: Array, free: bool,
    rng: np.random.Generator,
) -> bool:  # fmt: skip
    """Draw one machine's drifts and return whether its loss is detected."""
    j = [p.name for p in stage.parameters].index(parameter)
    x = stage.prior.draw(rng, 1)[0] if free else stage.baseline_point.copy()
    x[j] = stage.baseline_point[j] + np.log1p(-loss)
    modes = stage.informative
    drift = stage.drift(x[None], modes)[0] + np.sqrt(variance) * rng.standard_normal(variance.size)
    # Points over all that the data allow, the posterior being no wider than a linear one by much.
    assert stage.modal_map is not None
    # An error that all modes have in common scales a loss, and decides nothing about its sign.
    own_errors = replace(identifiability_of(stage), common_std=0.0)
    cov = np.linalg.inv(own_errors.precision(variance))
    steps = np.stack(np.meshgrid(*[np.linspace(-7, 7, N_GRID)] * x.size), -1).reshape(-1, x.size)
    points = x + steps @ np.linalg.cholesky(cov).T
    points = points[stage.modal_map.inside(points)]
    predicted = stage.drifts(points, modes)
    parts = []
    assert stage.description.map is not None
    own = stage.description.map.model_std
    for scale, weight in MAP_ERRORS:
        total = variance + (scale * own) ** 2 * np.sum(predicted[1:] ** 2, axis=0)
        misfit = np.sum((drift - predicted[0]) ** 2 / total + np.log(total), axis=1)
        parts.append(np.log(weight) - 0.5 * misfit)
    log_density = stage.prior.log_density(points) + np.logaddexp.reduce(parts, axis=0)
    density = np.exp(log_density - log_density.max())
    lost = density[points[:, j] < stage.baseline_point[j]].sum() / density.sum()
    return bool(lost > 1 - FALSE_ALARM)


def law(name: str) -> Row:
    """Tell the standard deviation of ln f of one log against its length: bound and law."""
    seen = identifiability_of(load_stage(name))
    bound = np.sqrt([seen.log_variance(duration) for duration in DURATIONS])
    return {
        "stage": name,
        "durations_s": list(DURATIONS),
        "bound": {mode.name: bound[:, i].tolist() for i, mode in enumerate(seen.modes)},
        "long_record": {
            mode.name: long_record_law(mode.frequency_hz, mode.damping_ratio,
                                       np.array(DURATIONS))[0].tolist()
            for mode in seen.modes
        },
    }  # fmt: skip


def measured(name: str, duration: float, logs: int) -> Row:
    """Simulate logs of a machine that does not change, identify them, compare with the truth."""
    simulated = Plan(name, "healthy", logs, duration, SEED)
    life, found = life_of(simulated), identified(simulated)
    seen = identifiability_of(load_stage(name))
    off = found.ln_frequency - life.ln_frequency
    std = np.sqrt(np.einsum("kii->ki", found.cov)[:, : len(GUIDE_MODES)])
    names = [mode.name for mode in seen.modes]
    bound = dict(zip(names, np.sqrt(seen.log_variance(duration)), strict=True))
    rows = {}
    for i, mode in enumerate(GUIDE_MODES):
        there = np.isfinite(off[:, i])
        n = int(there.sum())
        rms = float(np.sqrt(np.mean(off[there, i] ** 2)))
        rows[mode] = {
            "n": n,
            "stated_std": float(np.sqrt(np.mean(std[there, i] ** 2))),
            "rms_error": rms,
            "rms_error_se": rms / float(np.sqrt(2 * n)),
            "stated_over_bound": float(np.sqrt(np.mean(std[there, i] ** 2)) / bound[mode]),
        }
    return {"duration_s": duration, "logs": logs, "modes": rows}


def verdicts(answer: Row) -> dict[str, bool]:
    """Return the checks."""
    arms = {arm: [row for row in answer["checks"] if row["arm"] == arm]
            for arm in ("as planned", "as shipped, the other as it was")}  # fmt: skip
    tables = [np.array(one["smallest_loss"], dtype=float) for one in answer["maps"]]
    steps = [np.diff(table, axis=axis) for table in tables for axis in (0, 1)]
    return {
        "more and longer logs see less": all((own[np.isfinite(own)] < 0).all() for own in steps),
        "the mount of X is not shown": answer["unseen"]["message"] is not None,
        "the power is the planned one": all(row["power"]["holds"] for row in arms["as planned"]),
        "false alarms are the planned ones": all(
            row["false_alarms"]["holds"] for row in arms["as planned"]
        ),
        "as shipped no more false alarms": all(
            row["false_alarms"]["low"] <= FALSE_ALARM
            for row in answer["checks"]
            if row["arm"] != "as planned"
        ),
    }


def claims(answer: Row) -> Iterator[Claim]:
    """Claim smallest losses, and that the posterior has the planned power and false alarms."""
    for asked in answer["maps"]:
        losses = [
            asked["smallest_loss"][answer["logs"].index(n)][answer["durations_s"].index(seconds)]
            for n, seconds in (SHORT, LONG)
        ]
        yield Claim(
            f"smallest loss of {asked['parameter']} of {asked['stage']} that one log of 20 s shows",
            f"{100 * losses[0]:.1f} %",
            f"power {100 * answer['power']:.0f} %, "
            f"false alarms {100 * answer['false_alarm']:.0f} %",
            f"twenty of 300 s show {100 * losses[1]:.1f} %",
        )
    planned = [row for row in answer["checks"] if row["arm"] == "as planned"]
    yield covered(
        f"power of the posterior, {len(planned)} points",
        [row["power"] for row in planned],
        f"{100 * answer['power']:.0f} % planned",
    )
    yield covered(
        "its false alarms",
        [row["false_alarms"] for row in planned],
        f"{100 * answer['false_alarm']:.0f} % planned",
    )
    free = [
        row["power"]["share"] for row in answer["checks"]
        if row["arm"] == "as shipped, the other from its prior" and row["stage"] == "lms-y"
    ]  # fmt: skip
    yield Claim(
        "power in Y where the other parameter has moved and the map has its error",
        percents(free),
        "",
        "no part of the plan",
    )
    over = [m["stated_over_bound"] for row in answer["identified"] for m in row["modes"].values()]
    yield Claim("standard deviations of identification over the bound of the plan", span(over))


if __name__ == "__main__":
    main()
