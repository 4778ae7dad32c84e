"""What does a simulated log cost in time and memory?

Method
    A fresh process with one thread per case: processor time of `record` for 60 s of four signals
    at 20 kHz, after a first short log, and the process's peak memory; required are 2 s and 500 MB,
    with friction 3 s and 700 MB (its compiler takes 150 MB). Peer in the same process:
    `control.forced_response` on the exactly discretised closed loop, 2 s of the same noise, scaled
    to 60 s. Control: 30 s must cost about half.
Run time
    One minute.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator

import control
import numpy as np

from models.dynamics.plant import NOISE_INPUTS, closed_loop
from models.dynamics.stages import stage_named
from models.recordings.disturbances import noise_levels
from models.recordings.effects import EFFECTS
from models.recordings.recording import SAMPLE_RATE_HZ, record
from studies.common.cost import cpu_s, in_own_process, memory_bytes
from studies.harness.claims import Claim, span
from studies.harness.study import Row, Study

STEP = "simulated plants"

SECONDS, PEER_SECONDS = 60.0, 2.0
# Stage and effects of each case, with its bounds in s and MB.
CASES = {
    "lms-x": ("linear", 2.0, 500.0),
    "lms-y": ("linear", 2.0, 500.0),
    "lms-y-full, disturbed": ("disturbed", 2.0, 500.0),
    "lms-y-full, full": ("full", 3.0, 700.0),
}


def main() -> None:
    """Run the study; ``--quick`` measures one stage once and records nothing."""
    study = Study(__file__, __doc__, child="")
    if study.options.child:
        print(json.dumps(measure(study.options.child, 1 if study.quick else 3)))
        return
    names, quick = (["lms-y"], ["--quick"]) if study.quick else (list(CASES), [])
    script = "studies.simulation_cost.run"
    found = {name: in_own_process(script, "--child", name, *quick) for name in names}
    answer = {
        "stages": found,
        "passed": {
            "time": all(row["record_60s_cpu_s"] < row["bound_s"] for row in found.values()),
            "memory": all(row["peak_mb"] < row["bound_mb"] for row in found.values()),
        },
    }
    study.conclude(answer, quick_may_fail=True)


def measure(name: str, repeats: int) -> dict[str, float]:
    """Return what 60 s and 30 s of a case cost at least, and what the peer would take for 60 s."""
    kind, bound_s, bound_mb = CASES[name]
    plant = name.partition(",")[0]
    stage, rng, effects = stage_named(plant), np.random.default_rng(0), EFFECTS[kind]

    def least(work: Callable[[], object], turns: int) -> float:
        return min(cpu_s(work) for _ in range(turns))

    record(stage, seconds=1.0, rng=rng, effects=effects)
    whole = least(lambda: record(stage, seconds=SECONDS, rng=rng, effects=effects), repeats)
    peak_mb = memory_bytes() / 2**20
    half = least(lambda: record(stage, seconds=SECONDS / 2, rng=rng, effects=effects), repeats)
    peer = least(lambda: step_by_step(plant), min(repeats, 2)) * SECONDS / PEER_SECONDS
    return {
        "record_60s_cpu_s": round(whole, 2),
        "record_30s_cpu_s": round(half, 2),
        "peak_mb": round(peak_mb, 1),
        "forced_response_60s_cpu_s": round(peer, 1),
        "peer_over_ours": round(peer / whole, 1),
        "bound_s": bound_s,
        "bound_mb": bound_mb,
    }


def step_by_step(name: str) -> None:
    """Run two seconds of noise through the closed loop by python-control."""
    stage = stage_named(name)
    system = closed_loop(stage).driven_by(NOISE_INPUTS)
    plant = control.ss(system.a, system.b, system.c, system.d)
    sampled = control.c2d(plant, 1 / SAMPLE_RATE_HZ, method="zoh")
    levels = noise_levels(stage, np.asarray(0.010), SAMPLE_RATE_HZ)
    samples = round(PEER_SECONDS * SAMPLE_RATE_HZ)
    white = np.random.default_rng(0).standard_normal((levels.size, samples)) * levels[:, None]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        control.forced_response(sampled, np.arange(samples) / SAMPLE_RATE_HZ, white)


def claims(answer: Row) -> Iterator[Claim]:
    """Claim time and memory of a simulated minute."""
    friction = [row for name, row in answer["stages"].items() if CASES[name][0] == "full"]
    others = [row for row in answer["stages"].values() if row not in friction]
    for rows, what in ((others, "without friction"), (friction, "with friction and all effects")):
        peers = span(row["peer_over_ours"] for row in rows)
        met = all(row["record_60s_cpu_s"] < row["bound_s"] for row in rows)
        yield Claim(
            f"60 s of four signals {what}, processor time",
            span((row["record_60s_cpu_s"] for row in rows), "s"),
            "least of three turns",
            f"{rows[0]['bound_s']} s required; stepping by python-control takes {peers} times",
            met,
        )
        memory = span((row["peak_mb"] for row in rows), "MB")
        beside = f"{rows[0]['bound_mb']:.0f} MB required"
        yield Claim("its memory", memory, "", beside,
                    all(row["peak_mb"] < row["bound_mb"] for row in rows))  # fmt: skip


if __name__ == "__main__":
    main()
