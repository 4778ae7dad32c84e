"""What does one new log of a machine cost, beside its whole history?

Method
    A life of stage Y whose preload wears and whose mount loosens, from estimates as identified, in
    a store and a process of its own for each length of the history (`life`). Three runs of what
    `run` does after identification (assessment, page, rows of tables): all logs but the last, then
    all, then nothing new. Then the machine is assessed from nothing. Both answers are random, the
    first by an update of the draws before, and means of health now and of the remaining travel up
    to the horizon must agree within four standard errors, from the published effective sample
    sizes. Control, which must fail: the life without the last third of its logs.
Run time
    Six minutes on one processor.
"""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from lmshealth._private.serialize import fingerprint
from lmshealth.io.log import Metadata
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.modes import Modes
from studies.cost.new_log.life import NAME, SEED
from studies.harness.claims import Claim, number
from studies.harness.cost import in_own_process
from studies.harness.data.lives import drawn, history_of, life_of, plan_of, recorded, rng_of
from studies.harness.study import Row, Study

LENGTHS, QUICK_LENGTHS = (60, 600, 6000), (8,)
# Asked: s of processor time of a new log and of a first run of 60 logs; growth; memory in MB.
MOST_NEW, MOST_FIRST, MOST_GROWTH, MOST_MB = 5.0, 45.0, 1.5, 350.0
MOST_APART = 4.0
FLEET = 1000
NOT_MET = {
    "a new log takes at most 5 s": (
        "outcomes of all logs are read and associated again, their figures drawn, and their rows "
        "written"
    ),
    "growth with the history": "as these grow with the number of logs",
    "memory": (
        "most of it is imported libraries, among them pyarrow: pandas imports it where it is "
        "installed"
    ),
}


def main() -> None:
    """Run the study; ``--quick`` takes a short history and records nothing."""
    study = Study(__file__, __doc__)
    lengths = QUICK_LENGTHS if study.quick else LENGTHS
    also = ("studies.cost.new_log.life",)
    rows = [study.trials.once(measured, n, also=also) for n in lengths]
    study.conclude(
        {"histories": rows, "passed": verdicts(rows)}, not_met=NOT_MET, quick_may_fail=True
    )


def measured(n: int) -> Row:
    """Measure a history of so many logs."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "estimates.pickle"
        path.write_bytes(pickle.dumps(readings(n)))
        found: Row = in_own_process("studies.cost.new_log.life", path)
    cost = found["cpu_s"]
    shares = {"new_over_first": cost["new"] / cost["first"]}
    return {"logs": n, **found, **shares, "unchanged_over_new": cost["unchanged"] / cost["new"]}


def readings(n: int, kind: str = "both", seed: int = SEED) -> list[LogEstimates]:
    """Draw the estimates of the logs of a life."""
    life = life_of(plan_of("lms-y", kind, seed, n))
    history = history_of(life, drawn(life, *recorded("lms-y"), rng_of(41, 0, seed)))
    m, found = len(history.modes), []
    for k in range(n):
        modes = Modes(
            names=history.modes, sources=("joint",) * m, channels=("acc_pitch",) * m,
            ln_frequency=history.ln_frequency[k], ln_damping=history.ln_damping[k],
            cov=history.cov[k], snr=np.full(m, 50.0), dispersion=np.ones(m), flags=("",) * m,
            shape_channels=(), shapes=np.zeros((m, 0)), lines=(), refused=(),
        )  # fmt: skip
        covariates = {name: float(values[k]) for name, values in history.covariates.items()}
        metadata = Metadata(NAME, history.recorded_at[k], float(history.travel[k]), covariates)
        digest, error = fingerprint("log", kind, seed, n, k), float(history.loop_error[k])
        found.append(LogEstimates(history.logs[k], digest, metadata, modes, error))
    return found


def verdicts(rows: Sequence[Row]) -> dict[str, bool]:
    """Return what is asked, by name."""
    first, last = rows[0], rows[-1]
    return {
        "a new log takes at most 5 s": all(row["cpu_s"]["new"] <= MOST_NEW for row in rows),
        "a first run of 60 logs takes at most 45 s": first["cpu_s"]["first"] <= MOST_FIRST,
        "growth with the history": last["cpu_s"]["new"] <= MOST_GROWTH * first["cpu_s"]["new"],
        "memory": all(row["peak_mb"] <= MOST_MB for row in rows),
        "an unchanged machine costs nothing": all(row["unchanged_over_new"] < 0.05 for row in rows),
        "health is that of a run from nothing": all(
            row["health_apart"] < MOST_APART for row in rows
        ),
        "lives are those of a run from nothing": all(row["apart"] < MOST_APART for row in rows),
        "another life differs": any(row["control_apart"] > MOST_APART for row in rows),
    }


def claims(record: Row) -> Iterator[Claim]:
    """Claim costs of a new log, their growth, and the equality of the answers."""
    passed = record["passed"]
    for row in record["histories"]:
        cost = row["cpu_s"]
        yield Claim(
            f"processor time after one new log of {row['logs']}, over that of the first run",
            number(row["new_over_first"]),
            "",
            f"{number(cost['new'])} s beside {number(cost['first'])} s; without a new log "
            f"{number(cost['unchanged'])} s; peak memory {row['peak_mb']:.0f} MB",
            met=cost["new"] <= MOST_NEW,
        )
    first, last = record["histories"][0], record["histories"][-1]
    yield Claim(
        f"growth of that time from {first['logs']} to {last['logs']} logs",
        number(last["cpu_s"]["new"] / first["cpu_s"]["new"]),
        beside=f"at most {MOST_GROWTH} required",
        met=passed["growth with the history"],
    )
    hours = [FLEET * first["cpu_s"][part] / 2 / 3600 for part in ("first", "new")]
    yield Claim(
        f"{FLEET:,} machines of {first['logs']} logs from estimates, on two processors, reckoned",
        f"{number(hours[0])} h",
        beside=f"after a new log of each {number(hours[1])} h",
    )
    health, apart = (
        ", ".join(number(row[name]) for row in record["histories"])
        for name in ("health_apart", "apart")
    )
    control = ", ".join(number(row["control_apart"]) for row in record["histories"])
    yield Claim(
        "mean remaining travel after an update and from nothing, apart in standard errors",
        apart,
        beside=f"without the last third of the logs {control}",
        met=passed["lives are those of a run from nothing"],
    )
    yield Claim(
        "mean health after an update and from nothing, apart in standard errors",
        health,
        met=passed["health is that of a run from nothing"],
    )


if __name__ == "__main__":
    main()
