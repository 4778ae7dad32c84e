"""What does a simulated log cost in time and memory?

Question
    Does a log of 60 s with four signals at 20 kHz take less than 2 s on one core and less than
    500 MB, and how does that compare with stepping the same state space by python-control?
Method
    A fresh process with one thread per stage: processor time of `record` after a first short log
    (imports, caches), and the process's peak memory.  Peer in the same process:
    `control.forced_response` on the exactly discretised closed loop, 2 s of the same noise,
    scaled to 60 s.  Negative control: `record` of 30 s must cost about half.
Run time
    Half a minute.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator

import numpy as np

from models.dynamics.plant import NOISE_INPUTS, closed_loop
from models.dynamics.stages import STAGES, stage_named
from models.recordings.disturbances import noise_levels
from models.recordings.recording import SAMPLE_RATE_HZ, record
from studies.harness.claims import Claim, span
from studies.harness.study import Row, Study

STEP = "simulated plants"

SECONDS, PEER_SECONDS = 60.0, 2.0
BOUND_S, BOUND_MB = 2.0, 500.0
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> None:
    """Run the study; ``--quick`` measures one stage once and records nothing."""
    study = Study(__file__, __doc__, child="")
    if study.options.child:
        print(json.dumps(measure(study.options.child, 1 if study.quick else 3)))
        return
    names = ["lms-y"] if study.quick else list(STAGES)
    found = {name: in_own_process(name, study.quick) for name in names}
    answer = {
        "stages": found,
        "bound_s": BOUND_S,
        "bound_mb": BOUND_MB,
        "passed": {
            "time": all(row["record_60s_cpu_s"] < BOUND_S for row in found.values()),
            "memory": all(row["peak_mb"] < BOUND_MB for row in found.values()),
        },
    }
    study.conclude(answer, quick_may_fail=True)


def in_own_process(name: str, quick: bool) -> dict[str, float]:
    """Measure a stage in a process that has done nothing else, with one thread."""
    environment = {**os.environ, **dict.fromkeys(_THREADS, "1")}
    command = [sys.executable, "-m", "studies.simulation_cost.run", "--child", name]
    command += ["--quick"] if quick else []
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout))


def cost(work: Callable[[], object], repeats: int) -> float:
    """Return the least processor time (s) of a few runs: the machine is shared."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


def measure(name: str, repeats: int) -> dict[str, float]:
    """Return what 60 s and 30 s of a stage cost, and what the peer would take for 60 s."""
    stage = stage_named(name)
    rng = np.random.default_rng(0)
    record(stage, seconds=1.0, rng=rng)
    whole = cost(lambda: record(stage, seconds=SECONDS, rng=rng), repeats)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    half = cost(lambda: record(stage, seconds=SECONDS / 2, rng=rng), repeats)
    peer = cost(lambda: step_by_step(name), min(repeats, 2)) * SECONDS / PEER_SECONDS
    return {
        "record_60s_cpu_s": round(whole, 2),
        "record_30s_cpu_s": round(half, 2),
        "peak_mb": round(peak_mb, 1),
        "forced_response_60s_cpu_s": round(peer, 1),
        "peer_over_ours": round(peer / whole, 1),
    }


def step_by_step(name: str) -> None:
    """Run two seconds of noise through the closed loop by python-control."""
    import control

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
    rows = answer["stages"].values()
    passed = answer["passed"]
    peers = span(row["peer_over_ours"] for row in rows)
    yield Claim(
        "60 s of four signals, processor time",
        span((row["record_60s_cpu_s"] for row in rows), "s"),
        "least of three turns",
        f"{answer['bound_s']} s required; stepping by python-control takes {peers} times",
        passed["time"],
    )
    yield Claim(
        "its memory",
        span((row["peak_mb"] for row in rows), "MB"),
        "",
        f"{answer['bound_mb']:.0f} MB required",
        passed["memory"],
    )


if __name__ == "__main__":
    main()
