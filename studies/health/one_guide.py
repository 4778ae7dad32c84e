"""What is gained where one guide serves an X and a Y stage, and what does X alone not identify?

Method
    Preload, mount of X and mount of Y are drawn from the priors of the descriptions. Drifts are
    those of the plants of `models`, not of the maps' surrogates, with a relative error of 5 % drawn
    for the effect of each parameter on each mode, and noise of 0.1 % with half of its variance
    common to the modes of a machine. `infer` and `infer_together` answer; judged are the coverages
    of 50 and 90 % intervals (99.9 % Clopper-Pearson), the width of the 90 % interval of the
    preload, and how often a parameter is claimed as determined. Controls that must fail: two guides
    whose preloads are drawn apart taken for one; intervals of the preload of half the width.
Run time
    A quarter of an hour of one processor.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from lmshealth.health.inference import infer, infer_together
from lmshealth.health.results import Health
from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking.read_tables import Drifts
from models.dynamics.modal_map import guide_frequencies
from models.dynamics.stages import stage_named
from studies.harness.claims import Claim, at_level, covered, percents
from studies.harness.command_line import short_chains
from studies.harness.study import Row, Study, judge_places

Array = NDArray[np.float64]
SEED = 20261123
N_PAIRS, N_CONTROL = 150, 60
LEVELS = (0.5, 0.9)
NOISE, MAP_ERROR = 1e-3, 0.05
WHEN = datetime(2026, 6, 1, tzinfo=UTC)
SHARED = "guide_preload"


def drifts_of(stage: Stage, preload: float, mount: float, rng: np.random.Generator) -> Drifts:
    """Make the drifts of a machine's modes from its plant, with errors of the map and noise."""
    machine, modes = stage_named(stage.name), stage.informative

    def ln_f(*condition: float) -> Array:
        found = guide_frequencies(machine, *condition)
        return np.log([found[name] for name in modes])

    new = ln_f(1.0, 1.0)
    alone = np.array([ln_f(preload, 1.0), ln_f(1.0, mount)]) - new
    wrong = np.sum(MAP_ERROR * rng.standard_normal(alone.shape) * alone, axis=0)
    n = len(modes)
    cov = NOISE**2 * (0.5 * np.eye(n) + 0.5)
    drift = ln_f(preload, mount) - new + wrong + rng.multivariate_normal(np.zeros(n), cov)
    return Drifts(stage.name, (WHEN,), np.array([1e6]), modes, drift[None], cov[None])


def one_pair(seed: int, apart: bool) -> Row:
    """Infer one pair of machines alone and together; ``apart`` if their preloads differ."""
    rng = np.random.default_rng([SEED, seed])
    x_stage, y_stage = load_stage("lms-x"), load_stage("lms-y")
    (preload, mount_x), (other, mount_y) = np.exp(x_stage.prior.draw(rng, 2))
    machines = [
        (drifts_of(x_stage, preload, mount_x, rng), x_stage),
        (drifts_of(y_stage, other if apart else preload, mount_y, rng), y_stage),
    ]
    both = infer_together(machines, [SHARED], (SEED, seed))
    row = {"together": judged_health(both, (preload, mount_x, mount_y))}
    if not apart:
        row["X alone"] = judged_health(infer(*machines[0], (SEED, seed)), (preload, mount_x))
        row["Y alone"] = judged_health(infer(*machines[1], (SEED, seed)), (preload, mount_y))
    return row


def judged_health(health: Health, truth: tuple[float, ...]) -> Row:
    """Return for each parameter the level of the truth, the width of ln, and whether it is claimed.

    ``half_level`` is the level in the posterior shrunk to half its width about its median.
    """
    rows = {}
    for j, name in enumerate(health.parameters):
        draws = health.samples[0, :, j]
        half = (np.log(draws) + np.median(np.log(draws))) / 2
        rows[name] = {
            "level": float(np.mean(draws < truth[j])),
            "half_level": float(np.mean(half < np.log(truth[j]))),
            "width": float(np.ptp(np.log(np.quantile(draws, [0.05, 0.95])))),
            "published": bool(health.publishable_parameters()[j]),
        }
    return rows


def judged(rows: list[Row], level_name: str = "level") -> list[Row]:
    """Judge the coverage of central intervals."""
    levels = np.array([row[level_name] for row in rows])
    return [judge_places(levels, nominal) for nominal in LEVELS]


def summary(rows: list[Row]) -> Row:
    """Summarise one parameter over all trials."""
    return {
        "coverage": judged(rows),
        "median_width": float(np.median([row["width"] for row in rows])),
        "published": float(np.mean([row["published"] for row in rows])),
    }


def main() -> None:
    """Run the study; ``--quick`` does one pair by short chains, no control, and records nothing."""
    study = Study(__file__, __doc__)
    n = 1 if study.quick else N_PAIRS
    with short_chains() if study.quick else nullcontext():
        trials = study.trials.collect(one_pair, [(k, False) for k in range(n)])
    ways = {
        way: {name: summary([t[way][name] for t in trials]) for name in trials[0][way]}
        for way in ("X alone", "Y alone", "together")
    }
    gain = [t["Y alone"][SHARED]["width"] / t["together"][SHARED]["width"] for t in trials]
    answer: Row = {
        "seed": SEED,
        "pairs": n,
        "ways": ways,
        "preload_narrower_than_y_alone": float(np.median(gain)),
    }
    if not study.quick:
        control = study.trials.collect(one_pair, [(10_000 + k, True) for k in range(N_CONTROL)])
        answer["controls"] = {
            "two guides taken for one": judged([t["together"][SHARED] for t in control]),
            "half the width": judged([t["together"][SHARED] for t in trials], "half_level"),
        }
    answer["passed"] = verdicts(answer, quick=study.quick)
    study.conclude(answer)


def verdicts(answer: Row, *, quick: bool) -> dict[str, bool]:
    """Return the checks; one pair has no control."""
    ways = answer["ways"]
    rows = [row for way in ways.values() for own in way.values() for row in own["coverage"]]
    mounts = [ways["X alone"]["mount_stiffness"], ways["together"]["lms-x:mount_stiffness"]]
    known = [ways["Y alone"]["mount_stiffness"], *(way[SHARED] for way in ways.values())]
    gain = answer["preload_narrower_than_y_alone"]
    checks = {
        "all intervals cover": all(row["holds"] for row in rows),
        "the mount of X is never claimed": all(own["published"] == 0 for own in mounts),
        "preload and the mount of Y are claimed": all(own["published"] == 1 for own in known),
        "together the preload is known better than from Y": gain > 1,
    }
    if not quick:
        checks |= {
            f"{name} does not cover": not any(row["holds"] for row in own)
            for name, own in answer["controls"].items()
        }
    return checks


def claims(answer: Row) -> Iterator[Claim]:
    """Claim what is gained where one guide serves X and Y, and what is never claimed."""
    ways = answer["ways"]
    width = {way: percents([own["guide_preload"]["median_width"]]) for way, own in ways.items()}
    yield Claim(
        "preload is known from both to (median width of the 90 % interval)",
        width["together"],
        f"{answer['pairs']} pairs",
        f"{width['Y alone']} from Y, {width['X alone']} from X",
        answer["preload_narrower_than_y_alone"] > 1,
    )
    rows = [row for way in ways.values() for own in way.values() for row in own["coverage"]]
    for nominal in (0.5, 0.9):
        controls = [row for own in answer["controls"].values() for row in at_level(own, nominal)]
        yield covered(
            f"intervals of {100 * nominal:.0f} % cover",
            at_level(rows, nominal),
            "two guides taken for one, and half the width: "
            + percents(row["share"] for row in controls),
        )
    mounts = [ways["X alone"]["mount_stiffness"], ways["together"]["lms-x:mount_stiffness"]]
    shares = [own["published"] for own in mounts]
    yield Claim("how often the mount of X is claimed", percents(shares), "", "", not any(shares))


if __name__ == "__main__":
    main()
