"""Do the samples of a log show that frequencies above half of its sample rate are folded into it?

Method
    A machine with modes below the band's end, or with further ones above it, is simulated at 20 kHz
    under white and low-passed forces, with little and much noise of the sensor. Each record is then
    reduced to 1,250, 500 and 400 Hz, once by leaving samples out (aliased) and once through a
    filter. What would show aliasing is energy at half of the sample rate: the median power density
    from 0.46 to 0.495 of the rate over the level that a tenth of the band stays below. A criterion
    is of use if some threshold separates the two kinds; its errors are the least share of records
    that the best threshold misjudges. The control is a ratio that separates by construction.

Run time
    One minute.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from studies.harness.claims import Claim, span
from studies.harness.study import Row, Study

RATE, REDUCTIONS = 20_000, (16, 40, 50)
BELOW = ((126.0, 0.018), (137.0, 0.018), (155.0, 0.02))
ABOVE = ((420.0, 0.01), (780.0, 0.01), (1500.0, 0.02))
NOISES = (0.01, 0.1, 0.3)


def main() -> None:
    """Measure the energy at half of the sample rate with and without aliasing."""
    study = Study(__file__, __doc__, repeats=5)
    rng = np.random.default_rng(20261127)
    ratios: dict[str, list[float]] = {"aliased": [], "filtered": []}
    for _ in range(1 if study.quick else study.options.repeats):
        for record in records(rng, seconds=10 if study.quick else 40):
            for n in REDUCTIONS:
                ratios["aliased"].append(at_nyquist(record[::n]))
                reduced = signal.decimate(record, n, ftype="fir", zero_phase=True)
                ratios["filtered"].append(at_nyquist(reduced))
    control = {"aliased": [1 + x for x in ratios["aliased"]], "filtered": [0.5] * 3}
    found = {name: sorted(round(x, 3) for x in values) for name, values in ratios.items()}
    errors = least_error(ratios)
    study.conclude(
        {
            "ratios": {name: [x[0], x[len(x) // 2], x[-1]] for name, x in found.items()},
            "least_error": errors,
            "control_least_error": least_error(control),
            "passed": {"the comparison separates what differs": least_error(control) == 0},
        }
    )


def records(rng: np.random.Generator, seconds: float) -> Iterator[NDArray[np.float64]]:
    """Yield accelerations at 20 kHz, ``(n_samples,)``: modes, forces, noises."""
    n = int(seconds * RATE)
    low = signal.butter(2, 300, fs=RATE)
    for modes, is_low, noise in product((BELOW, BELOW + ABOVE), (False, True), NOISES):
        record = np.zeros(n)
        for frequency, damping in modes:
            omega = 2 * np.pi * frequency
            poles = [1, 2 * damping * omega, omega**2]
            filters = signal.bilinear([1, 0, 0], poles, RATE)
            force = rng.standard_normal(n)
            record += signal.lfilter(*filters, signal.lfilter(*low, force) if is_low else force)
        yield record + noise * record.std() * rng.standard_normal(n)


def at_nyquist(record: NDArray[np.float64]) -> float:
    """Return the power density below half of the rate over the level of the lowest tenth."""
    frequency, power = signal.welch(record, 1.0, nperseg=512)
    power = np.convolve(power, np.ones(5) / 5, "same")
    top = (frequency > 0.46) & (frequency < 0.495)
    used = (frequency > 0.02) & (frequency < 0.495)
    return float(np.median(power[top]) / np.quantile(power[used], 0.1))


def least_error(ratios: dict[str, list[float]]) -> float:
    """Return the mean of missed and false shares at the best threshold, in either direction."""
    aliased, filtered = (np.array(ratios[name]) for name in ("aliased", "filtered"))
    errors = [
        (np.mean(aliased <= at) + np.mean(filtered > at)) / 2 for at in (*aliased, *filtered, 0.0)
    ]
    return round(float(min(min(errors), 1 - max(errors))), 3)


def claims(record: Row) -> list[Claim]:
    """Claim how well the best threshold separates aliased records from filtered ones."""
    least, most = (record["ratios"]["aliased"][k] for k in (0, 2))
    return [
        Claim(
            "aliased records and filtered ones that the best threshold misjudges",
            f"{record['least_error']:.0%}",
            f"energy at half of the rate of aliased records {span((least, most))} times the floor, "
            f"of filtered ones {span(record['ratios']['filtered'][k] for k in (0, 2))} times",
            "no threshold is of use, and nothing is flagged",
        )
    ]


if __name__ == "__main__":
    main()
