"""How fast are posteriors of health and of whole lives, beside other ways to the same numbers?

Method
    One epoch of LMS-Y with a fifth of the preload and a tenth of the mount gone. Ours is what
    `lmshealth infer` does: four ensembles until 50 autocorrelation times; the effective sample size
    is arviz's, the smaller of middle and tails. dynesty and nautilus have the same surrogate and
    prior and their usual settings, and the effective sample size of their weights. A plain loop of
    emcee with its default moves solves the plant of `models` for every walker; its autocorrelation
    time is that of a long chain of the same moves over the surrogate. Quantiles are compared with
    those of a grid. The life has wear, loosening, temperature and a random walk; its posterior
    weighs all courses that the laws allow. The likelihood of the course in which both parts
    degrade, at one setting of walk and noise, is computed by filterpy too, log by log. Processor
    times are medians over turns.
Answer
    Yes. Quantiles are those of a grid within a fiftieth of a standard deviation. On the same
    machine shared by four processes all times are half as long again, ratios within a fifth. Lives
    were recorded when one course was all; now that courses are weighed a walker takes 15 µs, 333
    times less than the loop over filterpy, and the posterior of 100 logs 5.7 s.
Run time
    Some minutes of one processor. dynesty and nautilus come with the extra ``peers``; without them
    their rows are missing.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from lmshealth.health.inference import infer
from lmshealth.health.results import Health
from lmshealth.stage.description import load_stage
from lmshealth.tracking.read_tables import Drifts
from studies.common.cost import cpu_s
from studies.common.histories import START
from studies.harness.claims import Claim, Older, number
from studies.harness.study import Row, Study
from studies.sampling_speed.contestants import compare, epoch_posterior
from studies.sampling_speed.life import life_posterior

STEP = "infer"
OLDER = {
    "result": Older("38ea0d4464b9", "the courses of a life were weighed, which its times are of")
}

SEED = 20261122
ESS_PER_S, EPOCH_S, LIFE_S, TIMES, R_HAT = 2000.0, 3.0, 10.0, 20.0, 1.01
# Quantiles in standard deviations, and log likelihoods of lives.
SAME_QUANTILES, SAME_LIKELIHOOD = 0.1, 1e-4


def converged_epochs(seed: int, turns: int) -> Row:
    """Time all that `infer` does of one epoch."""
    stage = load_stage("lms-y")
    (view,) = epoch_posterior(stage).machines
    drifts = Drifts("AX-Y", (START,), np.array([1e6]), view.modes, view.drift[None], view.cov[None])
    found: list[Health] = []
    seconds = [
        cpu_s(lambda turn=turn: found.append(infer(drifts, stage, seed + turn)))
        for turn in range(turns)
    ]
    r_hat = max(float(one.r_hat.max()) for one in found)
    return {"cpu_s": float(np.median(seconds)), "worst_r_hat": r_hat, "turns": turns}


def main() -> None:
    """Run the study; ``--quick`` does little of it and records nothing."""
    study = Study(__file__, __doc__)
    quick, once = study.quick, study.trials.once
    turns = 1 if quick else 7
    if not quick:  # the first call imports what the libraries put off until then
        converged_epochs(SEED, 1)
    answer: Row = {
        "seed": SEED,
        "epoch": once(partial(compare, quick=quick), SEED, turns),
        "converged_epoch": once(converged_epochs, SEED, turns),
        "life": once(partial(life_posterior, quick=quick), SEED, turns),
    }
    answer["passed"] = verdicts(answer, quick=quick)
    study.conclude(answer)


def verdicts(answer: Row, *, quick: bool) -> dict[str, bool]:
    """Return the checks; times are judged in the recorded run alone."""
    rows = {row["program"]: row for row in answer["epoch"]["programs"]}
    life, likelihood = answer["life"], answer["life"]["likelihood"]
    errors = [row.get("rms_error_of_quantiles", 0.0) for row in rows.values()]
    r_hat = max(answer["converged_epoch"]["worst_r_hat"], life["worst_r_hat"])
    checks = {
        "quantiles are those of a grid": max(errors) < SAME_QUANTILES,
        "lives have filterpy's likelihood": likelihood["largest_difference"] < SAME_LIKELIHOOD,
        "a walker takes a twentieth of a filterpy loop": likelihood["times_faster"] >= TIMES,
        "epochs and lives converge": r_hat < R_HAT,
        "no other way gives more effective draws a second": all(
            row["ours_is_times_faster"] >= 1 for row in rows.values()
        ),
    }
    if not quick:
        rate = rows["lmshealth"]["ess_per_s"]
        checks |= {
            "2,000 effective draws of an epoch a second": rate >= ESS_PER_S,
            "a converged epoch in 3 s": answer["converged_epoch"]["cpu_s"] < EPOCH_S,
            "a life of 100 logs in 10 s": life["cpu_s"] < LIFE_S,
        }
    return checks


def claims(answer: Row) -> Iterator[Claim]:
    """Claim draws a second beside other programs, and times of epochs and lives."""
    epoch, life = answer["epoch"], answer["life"]
    ours, *others = epoch["programs"]
    times = [f"{number(row['ours_is_times_faster'])} times {row['program']}" for row in others]
    yield Claim(
        "effective draws of an epoch a second",
        number(ours["ess_per_s"]),
        f"median of {epoch['turns']} turns",
        f"2,000 required; {', '.join(times)}",
        ours["ess_per_s"] >= 2000 and all(row["ours_is_times_faster"] >= 1 for row in others),
    )
    one = answer["converged_epoch"]
    yield Claim(
        "a converged epoch",
        f"{number(one['cpu_s'])} s",
        f"median of {one['turns']} turns",
        "3 s required",
        one["cpu_s"] < 3,
    )
    walker = life["likelihood"]
    yield Claim(
        "a walker of a life, with the likelihood of a loop over filterpy",
        f"{number(walker['us_per_walker'])} µs, {number(walker['times_faster'])} times faster",
        "",
        f"20 times required; likelihoods differ by {number(walker['largest_difference'])}",
        walker["times_faster"] >= 20,
    )
    yield Claim(
        f"the posterior of a life of {walker['logs']} logs",
        f"{number(life['cpu_s'])} s",
        f"median of {len(life['runs'])} turns" if "runs" in life else "",
        "10 s required",
        life["cpu_s"] < 10,
    )


if __name__ == "__main__":
    main()
