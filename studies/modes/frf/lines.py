"""How far apart may the excited lines of a frequency response be, and is the reason right if not?

Method
    A machine with one mode of 60 to 120 Hz in the band and one above it, a damping of 0.5 to 5 %, a
    multisine from 8 to 176 Hz whose lines are 0.5 to 8 Hz apart, 1 % of noise. Where at least three
    lines fall within three half-power bandwidths the mode must be found, elsewhere it must be
    refused as ``too-few-lines``; frequencies whose third line is within 5 % of the end of that
    range are not drawn. Controls with a line every 0.25 Hz: a motor whose cube exceeds its current
    must be refused as ``nonlinear``, six heavily damped modes in noise of their size as ``noise``.
Run time
    Three minutes on two processors.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lmshealth import read_frf
from studies.harness.claims import Claim, counted, covered
from studies.harness.data.logs import make_log
from studies.harness.study import Row, Study, judge_scores
from studies.modes.frf.records import BAND, RATE, Machine, multisine

SPACINGS = (0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)  # Hz
DAMPINGS = (0.005, 0.01, 0.02, 0.03, 0.05)
LINES, BANDWIDTHS = 3, 3  # what is asked for
SIZE, PERIODS = 1600, 6


def main() -> None:
    """Run the study; ``--quick`` does one seed of every second damping."""
    study = Study(__file__, __doc__, seeds=12)
    seeds, dampings = (1, DAMPINGS[::2]) if study.quick else (study.options.seeds, DAMPINGS)
    tasks = [(d, zeta, k) for d in SPACINGS for zeta in dampings for k in range(seeds)]
    with study.pool() as pool:
        rows = study.trials.collect(one_record, tasks, pool=pool)
        controls = {
            reason: study.trials.collect(one_control, [(reason, k) for k in range(seeds)])
            for reason in ("nonlinear", "noise")
        }
    shown = [row for row in rows if row["n_lines"] >= LINES]
    hidden = [row for row in rows if row["n_lines"] < LINES]
    z = np.array([row["z"] for row in shown if row["z"]])
    answer: Row = {
        "n_records": len(rows),
        "found": {"hits": sum(bool(row["z"]) for row in shown), "n": len(shown)},
        "refused": {"hits": sum(row["reasons"] == ["too-few-lines"] and not row["z"]
                                for row in hidden), "n": len(hidden)},
        "controls": {reason: {"hits": sum(row == [reason] for row in own), "n": len(own)}
                     for reason, own in controls.items()},
        "frequency": judge_scores(z[:, 0]),
        "damping": judge_scores(z[:, 1]),
    }  # fmt: skip
    counts = {"found": answer["found"], "refused": answer["refused"], **answer["controls"]}
    answer["passed"] = {name: part["hits"] == part["n"] for name, part in counts.items()}
    study.conclude(answer, details={"rows": rows})


def one_record(spacing: float, damping: float, seed: int) -> Row:
    """Return the lines that show a mode, its errors in σ if it is found, and reasons if not."""
    rng = np.random.default_rng([seed, round(10 * spacing), round(1000 * damping)])
    lines = np.arange(np.ceil(8 / spacing), np.floor(176 / spacing) + 1) * spacing
    while True:
        f = rng.uniform(60, 120)
        share = np.abs(lines - f) / (BANDWIDTHS * damping * f)
        if abs(np.sort(share)[LINES - 1] - 1) > 0.05:
            break
    # 16 s hold a whole number of every period.
    line = np.zeros(SIZE * 2 + 1, dtype=complex)
    at = np.round(lines * 4 * SIZE / RATE).astype(int)
    line[at] = np.exp(2j * np.pi * rng.uniform(size=lines.size))
    given = np.fft.irfft(line, 4 * SIZE)
    machine = Machine(modes=((f, damping, 1.0), (260.0, 0.02, 0.8)), white=0.01, process=0.0)
    signals = machine.noise(rng, given, machine.answer(given))
    log = make_log(dict(zip(("current", "acc"), signals, strict=True)), RATE)
    modes = read_frf(log, "current", "acc").modes
    # Heavily damped poles are the background of the fit.
    reasons = {r.reason for r in modes.refused} - {"overdamped", "outside-band"}
    row: Row = {"spacing": spacing, "damping": damping, "frequency_hz": f,
                "n_lines": int(np.count_nonzero(share < 1)), "n_modes": len(modes.names),
                "reasons": sorted(reasons), "z": []}  # fmt: skip
    if len(modes.names) == 1:
        error = np.array([modes.ln_frequency[0], modes.ln_damping[0]]) - np.log([f, damping])
        row["z"] = (error / np.sqrt(np.diag(modes.cov))).tolist()
    return row


def one_control(reason: str, seed: int) -> list[str]:
    """Return why nothing is published of a record that is spoilt for a known reason."""
    rng = np.random.default_rng([seed, 1])
    given = multisine(rng, SIZE)
    if reason == "nonlinear":
        machine = Machine(white=0.01, process=0.0)
        answer = machine.answer(given + 3 * given**3 - 9 * given)
    else:
        modes = tuple((f, 0.1, 1.0) for f in np.linspace(45, 115, 6).tolist())
        machine = Machine(modes=modes, white=4.0, process=0.0)
        answer = machine.answer(given)
    signals = machine.noise(rng, np.tile(given, PERIODS), np.tile(answer, PERIODS))
    log = make_log(dict(zip(("current", "acc"), signals, strict=True)), RATE)
    modes_found = read_frf(log, "current", "acc", band=BAND).modes
    return [*modes_found.names, *sorted({r.reason for r in modes_found.refused})]


def claims(answer: Row) -> Iterator[Claim]:
    """Claim what is found and refused, coverage, and the other two reasons."""
    found, refused, passed = answer["found"], answer["refused"], answer["passed"]
    yield counted(
        "modes found with three lines in three half-power bandwidths, lines 0.5 to 8 Hz apart",
        *(found["hits"], found["n"]),
        met=passed["found"],
    )
    yield counted(
        "modes with fewer lines refused, and as too few lines",
        *(refused["hits"], refused["n"]),
        met=passed["refused"],
    )
    yield covered(
        "95 % intervals of f and ζ of those found", [answer["frequency"], answer["damping"]]
    )
    for reason, part in answer["controls"].items():
        yield counted(
            f"records spoilt otherwise that are refused as {reason}",
            *(part["hits"], part["n"]),
            met=passed[reason],
        )


if __name__ == "__main__":
    main()
