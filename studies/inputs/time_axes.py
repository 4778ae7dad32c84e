"""Is a wrong time axis, or a degenerate set of channels, ever used without a word?

Method
    Recordings of 24 s with two modes of drawn frequency and damping (1 to 2 %), sampled at the
    moments of an odd clock at 500 Hz on average: rates that step, clocks that drift or oscillate,
    jitter, stamps that are rounded, gaps, stamps that repeat, run backwards or jump by an hour,
    empty rows, another rate in the header. Eight of each kind, in five formats in turn. What is
    read and not refused is identified; the frequencies are compared with the truth. Degenerate
    sets: a channel beside its copy, opposite, multiple, or combination, beside values of 1e-300
    and 1e300, zeros, and counts. Assumptions: stamps are those of the samples but for rounding;
    the errors are normal, so that with true standard deviations 0.27 % of the frequencies are
    beyond 3. Controls: the same samples with the mean rate in the place of the stamps must give
    wrong frequencies, and a copy that is not compared with the others must not be named.
Run time
    Ten minutes on one processor.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter
from scipy.stats import binom, norm

import lmshealth
from lmshealth.errors import BadLog
from lmshealth.io import channel_checks
from studies.harness.claims import Claim, controls_seen, counted
from studies.harness.study import Row, Study
from studies.inputs.damaged.logfiles import Archive, LogFile, write

Floats = NDArray[np.float64]
Rng = np.random.Generator


RATE, N, BASE = 500.0, 12_000, 4000.0
N_EACH, N_SETS, N_QUICK, QUICK_KINDS = 8, 10, 1, 5
BAND = (45.0, 170.0)
_SEED = 20261125
_FORMATS = (".csv", ".parquet", ".h5", ".mat", ".tdms")
_SIGMAS, _FAR = 3.0, 5.0
_SAMPLES = "acc_x_m_s2"


def _clock(interval: Floats) -> Floats:
    """Return moments of samples from their intervals in units of the nominal one."""
    return np.concatenate([[0.0], np.cumsum(interval)[:-1]]) / RATE


def _steps(*rates: float) -> Floats:
    return _clock(np.repeat(1 / np.array(rates), -(-N // len(rates)))[:N])


# Kinds of clocks: a function of the generator that returns moments of the samples and their stamps.
Kind = Callable[[Rng], tuple[Floats, Floats]]
_INDEX = np.arange(N, dtype=np.float64)


def _exact(moments: Callable[[Rng], Floats]) -> Kind:
    def make(rng: Rng) -> tuple[Floats, Floats]:
        t = moments(rng)
        return t, t.copy()

    return make


def _stamped(stamps: Callable[[Floats, Rng], Floats]) -> Kind:
    return lambda rng: (_INDEX / RATE, stamps(_INDEX / RATE, rng))


def _jump(by: float) -> Kind:
    return _stamped(lambda t, rng: t + by * (t > rng.uniform(5, 19)))


def _gaps(n: int) -> Kind:
    def moments(rng: Rng) -> Floats:
        interval = np.ones(N)
        interval[rng.choice(N - 1, n, replace=False)] += rng.integers(1, 60, n)
        return _clock(interval)

    return _exact(moments)


def _sine(amplitude: float, period: float) -> Kind:
    return _exact(lambda rng: (_INDEX + amplitude * np.sin(2 * np.pi * _INDEX / period)) / RATE)


def _noise(std: float) -> Kind:
    return _exact(lambda rng: (_INDEX + std * rng.standard_normal(N)) / RATE)


def _repeated(n: int) -> Kind:
    def stamps(t: Floats, rng: Rng) -> Floats:
        at = 1 + rng.choice(N - 1, n, replace=False)
        t[at] = t[at - 1]
        return t + 1e-7 * _INDEX  # of a clock that no decimals hold

    return _stamped(lambda t, rng: np.maximum.accumulate(stamps(t, rng) - 1e-7 * _INDEX))


KINDS: dict[str, Kind] = {
    "uniform": _stamped(lambda t, rng: t),
    "one step": _exact(lambda rng: _steps(1.0, rng.uniform(0.7, 0.95))),
    "three steps": _exact(lambda rng: _steps(*rng.uniform(0.8, 1.2, 4))),
    "a small step": _exact(lambda rng: _steps(1.0, 1 + rng.uniform(0.002, 0.01))),
    "step beyond two": _exact(lambda rng: _steps(1.0, 0.4)),
    "drift": _exact(lambda rng: _clock(1 + rng.uniform(0.1, 0.25) * _INDEX / N)),
    "slow drift": _exact(lambda rng: _clock(1 + rng.uniform(1e-3, 1e-2) * _INDEX / N)),
    "slow oscillation": _sine(5.0, 4000.0),
    "oscillation": _sine(0.4, 400.0),
    "fast oscillation": _sine(0.1, 7.0),
    "faint oscillation": _sine(0.01, 7.0),
    "faint jitter": _noise(0.01),
    "jitter": _noise(0.05),
    "strong jitter": _noise(0.25),
    "rounded to 1 ms": lambda rng: (t := _INDEX / RATE / rng.uniform(0.9, 1.1), np.round(t, 3)),
    "rounded to 0.1 ms": _stamped(lambda t, rng: np.round(t, 4)),
    "float32": _stamped(lambda t, rng: (t + 60).astype(np.float32).astype(np.float64)),
    "seconds since 1970": _stamped(lambda t, rng: t + 1.7e9),
    "few gaps": _gaps(5),
    "gaps": _gaps(100),
    "too many gaps": _gaps(600),
    "repeated stamps": _repeated(3),
    "backward stamps": _jump(-0.5),
    "an hour on": _jump(3600.0),
    "an hour back": _jump(-3600.0),
}
# Without stamps: what else is wrong.
PLAIN = ("empty rows", "an empty row", "another rate in the header")
UNCHECKED = ("one step", "drift")
FAR = "no frequency is far off without a word"
NOT_MET = {FAR: "a peak of the noise 0.1 Hz inside of the searched band is taken for a mode"}


def main() -> None:
    """Run the study; ``--quick`` does a part of it and records nothing."""
    study = Study(__file__, __doc__)
    n, n_sets = (N_QUICK, N_QUICK) if study.quick else (N_EACH, N_SETS)
    kinds = (*KINDS, *PLAIN)[:: QUICK_KINDS if study.quick else 1]
    sets = tuple(SETS)[:: QUICK_KINDS if study.quick else 1]
    with study.pool() as pool:
        collect = partial(study.trials.collect, pool=pool)
        rows = collect(try_axis, [(kind, k) for k in range(n) for kind in kinds])
        controls = collect(try_axis, [(kind, 0, False) for kind in UNCHECKED])
        degenerate = collect(try_set, [(name, k) for k in range(n_sets) for name in sets])
        unnamed = collect(try_set, [("copy", 0, False)])[0]
    study.conclude(judge(rows, controls, degenerate, unnamed), not_met=NOT_MET)


def vibration(rng: Rng, moments: Floats) -> tuple[Floats, Floats]:
    """Return frequencies of two modes in Hz, and their acceleration at these moments in s."""
    truth = np.array([rng.uniform(60, 85), rng.uniform(110, 145)])
    n = int((moments.max() + 1) * BASE)
    x = np.zeros(n)
    for f, zeta in zip(truth, rng.uniform(0.01, 0.02, 2), strict=True):
        pole = np.exp(2 * np.pi * f / BASE * (-zeta + 1j * np.sqrt(1 - zeta**2)))
        x += lfilter([1, -2, 1], np.poly([pole, pole.conj()]), rng.standard_normal(n))
    own = CubicSpline(np.arange(n) / BASE, x)(moments)
    return truth, own / own.std() + 0.3 * rng.standard_normal(moments.size)


def try_axis(kind: str, number: int, checked: bool = True) -> Row:
    """Write one log of an odd clock, and return what is read and found."""
    rng = np.random.default_rng([_SEED, sum(kind.encode()), number])
    moments, stamps = KINDS.get(kind, KINDS["uniform"])(rng)
    truth, values = vibration(rng, moments)
    metadata, columns = {}, {_SAMPLES: values}
    if kind in KINDS and checked:
        columns = {"time_s": stamps, **columns}
    else:
        metadata = {"sample_rate_hz": repr(float((N - 1) / (stamps[-1] - stamps[0])))}
    suffix = ".csv" if kind in PLAIN else _FORMATS[number % len(_FORMATS)]
    if kind == "another rate in the header":
        metadata, columns = {"sample_rate_hz": repr(1.01 * RATE)}, {"time_s": stamps, **columns}
    with tempfile.TemporaryDirectory(prefix="axes-") as folder:
        path = Path(folder) / f"log{suffix}"
        if kind in PLAIN[:2]:
            step = 10 if kind == PLAIN[0] else N // 2
            lines = ["" if k % step == step - 1 else repr(float(v)) for k, v in enumerate(values)]
            path.write_text("\n".join([f"# sample_rate_hz: {RATE}", _SAMPLES, *lines]) + "\n")
        else:
            write(Archive(path.parent), path, LogFile(columns, metadata))
        return {"kind": kind, "format": suffix, **_found(path, truth)}


def _found(path: Path, truth: Floats) -> Row:
    """Read and identify a log; return its refusals and the errors of its frequencies in σ."""
    try:
        log = lmshealth.read_log(path)
        modes = lmshealth.identify(log, band=BAND)
    except BadLog as error:
        return {"refused": error.reason, "named": [], "z": [], "n_channels": 0}
    errors = modes.frequency[:, None] - truth
    nearest = np.abs(errors).argmin(axis=1)
    z = errors[np.arange(errors.shape[0]), nearest] / modes.frequency_std
    named = sorted({f"{one.channel}: {one.reason}" for one in log.refused})
    return {"refused": "", "named": named, "z": z.tolist(), "n_channels": len(log.channels)}


# Degenerate sets: a second or third channel of the first and of noise, and what must be refused.
Other = Callable[[Floats, Rng], Sequence[Floats]]
SETS: dict[str, tuple[Other, str]] = {
    "copy": (lambda x, rng: [x], "dependent"),
    "opposite": (lambda x, rng: [-x], "dependent"),
    "multiple": (lambda x, rng: [rng.uniform(1e-6, 1e6) * x], "dependent"),
    "offset copy": (lambda x, rng: [x + 9.81], "dependent"),
    "combination": (
        lambda x, rng: [w := rng.standard_normal(N), x + rng.uniform(1, 3) * w],
        "dependent",
    ),
    "1e-300": (lambda x, rng: [1e-300 * rng.standard_normal(N)], "flat"),
    "1e300": (lambda x, rng: [1e300 * rng.standard_normal(N)], "missing-samples"),
    "zeros": (lambda x, rng: [np.zeros(N)], "flat"),
    "counts": (lambda x, rng: [1e5 * (x + 0.5 * rng.standard_normal(N))], ""),
    "all of these": (
        lambda x, rng: [x, -x, np.zeros(N), 1e-300 * x, 1e300 * x],
        "dependent flat missing-samples",
    ),
}


def try_set(name: str, number: int, checked: bool = True) -> Row:
    """Write one log of degenerate channels, and return what is read and found."""
    rng = np.random.default_rng([_SEED, 1, sum(name.encode()), number])
    truth, values = vibration(rng, _INDEX / RATE)
    make, reasons = SETS[name]
    columns = {_SAMPLES: values}
    columns |= {f"acc_{k}_m_s2": other for k, other in enumerate(make(values, rng))}
    accept_all = patch.object(channel_checks, "independent", lambda own, *_: [*range(len(own))])
    with tempfile.TemporaryDirectory(prefix="axes-") as folder:
        path = Path(folder) / "set.h5"
        write(Archive(path.parent), path, LogFile(columns, {"sample_rate_hz": repr(RATE)}))
        with nullcontext() if checked else accept_all:
            found = _found(path, truth)
    named = {one.split(": ")[1] for one in found["named"]}
    return {"kind": name, "named_right": named == set(reasons.split()), **found}


def judge(
    rows: Sequence[Row], controls: Sequence[Row], degenerate: Sequence[Row], unnamed: Row
) -> Row:
    """Count the frequencies that are off, with and without a refusal or a warning."""
    silent = [z for row in [*rows, *degenerate] if not row["named"] for z in row["z"]]
    named = [z for row in [*rows, *degenerate] if row["named"] for z in row["z"]]
    beyond, far = _beyond(silent, _SIGMAS), _beyond(silent, _FAR)
    # As many as 3 standard deviations of normal errors allow in one of a thousand studies.
    allowed = int(binom.isf(1e-3, max(1, len(silent)), 2 * norm.sf(_SIGMAS)))
    seen = {f"{row['kind']} without stamps": _beyond(row["z"], _FAR) > 0 for row in controls} | {
        "a copy that is not compared": not unnamed["named_right"]
    }
    counts = Counter(
        (row["kind"], row["refused"] or ("named" if row["named"] else "silent")) for row in rows
    )
    return {
        "axes": len(rows),
        "sets": len(degenerate),
        "sets_named_right": sum(row["named_right"] for row in degenerate),
        "frequencies_silent": len(silent),
        "silent_beyond_3": beyond,
        "silent_beyond_5": far,
        "allowed_beyond_3": allowed,
        "frequencies_named": len(named),
        "named_beyond_3": _beyond(named, _SIGMAS),
        "named_beyond_5": _beyond(named, _FAR),
        "wrong": [
            row
            for row in [*rows, *degenerate]
            if _beyond(row["z"], _SIGMAS) or not row.get("named_right", True)
        ],
        "verdicts": [{"kind": k, "verdict": v, "logs": n} for (k, v), n in counts.items()],
        "controls": seen,
        "passed": {
            FAR: not far and beyond <= allowed,
            "every degenerate set is named right": all(row["named_right"] for row in degenerate),
            "controls are found": all(seen.values()),
        },
    }


def _beyond(z: Sequence[float], limit: float) -> int:
    return int(np.count_nonzero(np.abs(z) > limit))


def claims(answer: Row) -> Iterator[Claim]:
    """Claim that no frequency is wrong without a word, and that degenerate channels are named."""
    yield counted(
        f"frequencies of {answer['axes']} odd time axes and {answer['sets']} degenerate sets that "
        "are beyond 3 σ without a refusal or warning",
        answer["silent_beyond_3"],
        answer["frequencies_silent"],
        f"{answer['allowed_beyond_3']} by chance; {controls_seen(answer['controls'])}",
        met=answer["passed"][FAR],
    )
    yield counted(
        "degenerate sets of channels named with the right reason",
        answer["sets_named_right"],
        answer["sets"],
        met=answer["sets_named_right"] == answer["sets"],
    )


if __name__ == "__main__":
    main()
