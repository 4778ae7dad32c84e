"""Is a mode that disagrees with the map named, and none where the map is right?

Method
    Preloads of stage Y that lose 28 to 38 % over 20 logs by a power of 0.9 to 1.2, with estimates
    as identified, and a mount that keeps its stiffness. The drifts of the modes follow the shipped
    map exactly, or those of one mode are 30 % larger. A life is warned of if `modes_off_map`
    returns a mode; it names the right one if that is the first. Control: the exact map, where at
    most 2 % may be warned of; intervals are by Clopper and Pearson, one life each.
Answer
    With the exact map none of 60 lives is warned of. A mode whose drifts are 30 % larger is warned
    of in 22 of 36 lives, each time by its right name and with a size whose interval holds the
    truth: less than the 80 % that were hoped for.
Run time
    Six minutes on one processor.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np

from lmshealth.prognosis.life_posterior import fit_life
from lmshealth.prognosis.map_error import modes_off_map
from lmshealth.stage.description import Stage
from studies.harness.claims import Claim, counted, number
from studies.harness.data.histories import make_history
from studies.harness.study import Row, Study
from studies.life.fleet.lives import machine
from studies.robustness.off_model.worlds import LN_F, LN_ZETA, MODES, STD_F, STD_ZETA

SEED, N_LOGS, LENGTH_M = 20261126, 20, 2e6
N_EXACT, N_WRONG, SIZE = 60, 12, 0.3
MOST_FALSE, LEAST_NAMED = 0.02, 0.8
EXACT = "exact"
_POWER = (
    "a mode that is 30 % off the map passes for the declared error of the map and an error of the "
    "other modes in two of five lives; more modes, or larger losses, would separate them"
)
NOT_MET = {f"{mode}: named": _POWER for mode in MODES}


def main() -> None:
    """Run the study; ``--quick`` does one life of each and records nothing."""
    study = Study(__file__, __doc__)
    n_exact, n_wrong = (1, 1) if study.quick else (N_EXACT, N_WRONG)
    tasks = [(EXACT, k) for k in range(n_exact)]
    tasks += [(mode, k) for k in range(n_wrong) for mode in (MODES[1:2] if study.quick else MODES)]
    rows = study.trials.collect(one, tasks)
    answer: Row = {"seed": SEED, "size": SIZE, "worlds": {}}
    for world in dict.fromkeys(world for world, _ in tasks):
        own = [row for row in rows if row["world"] == world]
        named = [row for row in own if row["named"] == world]
        answer["worlds"][world] = {
            "n": len(own),
            "warned": sum(row["named"] is not None for row in own),
            "named": len(named),
            "held": sum(abs(row["size"] - SIZE) < 1.645 * row["std"] for row in named),
            "std": float(np.median([row["std"] for row in named])) if named else None,
        }
    answer["passed"] = verdicts(answer["worlds"])
    study.conclude(answer, not_met=NOT_MET, quick_may_fail=True)


@cache
def stage() -> Stage:
    """Load the description of all lives."""
    return machine()


def one(world: str, number_: int) -> Row:
    """Draw a life of which one mode, or none, disagrees with the map; return what is named."""
    rng = np.random.default_rng([SEED, number_, [EXACT, *MODES].index(world)])
    u = np.r_[0.0, np.sort(rng.uniform(size=N_LOGS - 2)), 1.0]
    x = np.tile(stage().baseline_point, (N_LOGS, 1))
    x[:, 0] += np.log1p(-rng.uniform(0.28, 0.38) * u ** rng.uniform(0.9, 1.2))
    drift = stage().drift(x, MODES)
    if world != EXACT:
        drift[:, MODES.index(world)] *= 1 + SIZE
    temperature = 21 + 5 * rng.standard_normal(N_LOGS)
    std = np.tile(np.r_[STD_F, STD_ZETA], (N_LOGS, 1))
    values = np.hstack([LN_F + drift - 5e-4 * (temperature - 21)[:, None],
                        np.tile(LN_ZETA, (N_LOGS, 1))])  # fmt: skip
    values += std * rng.standard_normal(std.shape)
    ln_f, ln_zeta = np.hsplit(values, 2)
    estimates = ln_f, ln_zeta, std[:, :, None] ** 2 * np.eye(std.shape[1])
    history = make_history(
        MODES, LENGTH_M * u, estimates, covariates={"temperature_c": temperature}
    )
    life = fit_life(history, stage(), [SEED, number_], chains=False, n_draws=2000)
    found = modes_off_map(life, np.random.SeedSequence([SEED, number_]))
    first = found[0] if found else None
    return {
        "world": world,
        "named": first and first.mode,
        "size": first and first.size,
        "std": first and first.std,
        "probability": first and first.probability,
    }


def verdicts(worlds: Row) -> dict[str, bool]:
    """Return the checks: few warnings with the exact map, and most wrong modes named."""
    exact = worlds[EXACT]
    checks = {"exact map: warnings": exact["warned"] <= MOST_FALSE * exact["n"]}
    for world, row in worlds.items():
        if world != EXACT:
            checks[f"{world}: named"] = row["named"] >= LEAST_NAMED * row["n"]
    return checks


def claims(answer: Row) -> Iterator[Claim]:
    """Claim false warnings, and the power to name a mode."""
    for world, row in answer["worlds"].items():
        if world == EXACT:
            what = "lives warned of a mode that disagrees with the map, exact map"
            met = answer["passed"]["exact map: warnings"]
            yield counted(what, row["warned"], row["n"], f"{MOST_FALSE:.0%} accepted", met=met)
        else:
            yield counted(
                f"lives in which the mode is named whose drifts are 30 % larger: {world}",
                row["named"],
                row["n"],
                f"{row['warned']} warned; 90 % intervals of the size hold {row['held']}, "
                f"median standard deviation {number(row['std'] or np.nan)}",
                met=answer["passed"][f"{world}: named"],
            )


if __name__ == "__main__":
    main()
