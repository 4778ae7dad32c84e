"""Frequency response from one channel of a log to another, and the modes in it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from lmshealth._arrays import BoolArray, FloatArray
from lmshealth.errors import BadLog
from lmshealth.io.log import Channel, Log, Refusal
from lmshealth.modal.frf.periods import find_period
from lmshealth.modal.frf.rational import HEAVY
from lmshealth.modal.frf.response_fit import ResponseFit, fit_response
from lmshealth.modal.frf.responses import EXCITED, Frf, Pair, from_periods, from_record
from lmshealth.modal.modes import Modes
from lmshealth.modal.targets import USABLE, WORST_STD_LN_F, WORST_STD_LN_ZETA
from lmshealth.signal.segments import find_phases
from lmshealth.signal.spectral_lines import Line, name_lines
from lmshealth.stage.description import Stage

# The second difference of a displacement reaches over this part of the shortest period.
_LAG_PERIODS = 8.0
_FEWEST_SAMPLES = 256
_FEWEST_PER_PERIOD = 32
# Standard deviations of a mean coherence beyond what noise alone shows.
_ANSWERS = 5.0
# Power of a mode over that of the distortion around it, below which it is not reported.
_LEAST_OVER_DISTORTION = 16.0


@dataclass(frozen=True, slots=True, eq=False)
class FrfReading:
    """What a log says about the response of one channel to another.

    Attributes
    ----------
    frf : Frf
        As measured.
    fit : ResponseFit
        The rational transfer function fitted to it.
    modes : Modes
        Its modes that are credible, and why others are not.
    """

    frf: Frf
    fit: ResponseFit
    modes: Modes


def read_frf(
    log: Log,
    input: str,
    output: str,
    *,
    band: tuple[float, float] | None = None,
    period: float | None = None,
) -> FrfReading:
    r"""Measure the frequency response between two channels and identify its modes.

    The longest stretch of constant velocity without gaps is used. An input that repeats is cut
    into whole periods; the first is left out where it differs from the others by more than their
    scatter. Modes are those of the response: to a disturbance added to the servo's current they
    are the modes of the closed loop, to the whole current those of the machine without its servo.

    Parameters
    ----------
    log : Log
        Units do not matter to the modes: an input in V or a force may stand in a column of
        currents, an angle in one of displacements.
    input, output : str
        Channel names.
    band : (float, float), optional
        In Hz; by default that in which the input is excited.
    period : float, optional
        Of the excitation in s, as far as known: the true one is sought within 1 %. By default it
        is found from the input, if that repeats.

    Raises
    ------
    BadLog
        If a channel is missing or constant, the record is too short, nothing is excited in the
        band, or the output does not answer.

    References
    ----------
    Pintelon2012

    Examples
    --------
    A current shakes something that rings at 126.4 Hz with a damping of 1.5 %:

    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> import lmshealth
    >>> rng, rate, frequency, damping = np.random.default_rng(1), 1000, 126.4, 0.015
    >>> pole = np.exp(2 * np.pi * frequency / rate * (-damping + 1j * np.sqrt(1 - damping**2)))
    >>> current, noise = rng.standard_normal((2, 30 * rate))
    >>> answer = lfilter([1, -2, 1], np.poly([pole, pole.conj()]), current) + 0.5 * noise
    >>> head = "# sample_rate_hz: 1000\ncurrent_a,acc_roll_m_s2"
    >>> table = np.column_stack([current, answer])
    >>> np.savetxt("shaken.csv", table, delimiter=",", header=head, comments="")
    >>> log = lmshealth.read_log("shaken.csv")
    >>> reading = lmshealth.read_frf(log, "current", "acc_roll", band=(90, 170))
    >>> print(f"{reading.modes.frequency[0]:.2f} Hz, {reading.modes.damping_ratio[0]:.2%}")
    126.40 Hz, 1.50%
    """
    given, answer = _channel(log, input), _channel(log, output)
    if input == output:
        raise BadLog(log.name, "channel", f"{input} is both input and output; needed are two")
    start, stop = _stretch(log)
    top = USABLE * log.sample_rate
    low, high = band or (0.0, top)
    if low >= top:
        raise BadLog(
            log.name,
            "sample-rate",
            f"{log.sample_rate:g} Hz shows nothing above {top:.4g} Hz; the band begins at {low:g}",
        )
    pair = _signals(log, (given, answer), start, stop)
    samples = _period(log, pair[0], period)
    band = _excited_band(pair[0], log.sample_rate, (low, min(high, top)), samples)
    lag = 0
    if answer.kind == "displacement":
        lag = max(1, int(log.sample_rate / (_LAG_PERIODS * band[1])))
        pair = _differenced(pair, lag, samples)
    measured = Pair(log, (input, output), pair, lag)
    if samples is None:
        frf, ordinates = from_record(measured, band)
    else:
        frf, ordinates = from_periods(measured, band, samples)
    _check_answer(log, frf)
    fit = fit_response(ordinates)
    return FrfReading(frf, fit, _modes(log, frf, answer, fit))


def _channel(log: Log, name: str) -> Channel:
    for channel in log.channels:
        if channel.name == name:
            return channel
    there = [channel.name for channel in log.channels]
    why = "".join(f"; {name} was refused: {r.detail}" for r in log.refused if r.channel == name)
    raise BadLog(log.name, "channel", f"no usable channel {name!r}; there are {there}{why}")


def _stretch(log: Log) -> tuple[int, int]:
    """Choose the longest stretch of constant velocity; of a log that never moves, of rest."""
    phases = find_phases(log)
    kinds = ("constant", "whole")
    if all(phase.kind == "idle" for phase in phases):
        kinds = ("idle", "idle")
    able = [phase for phase in phases if phase.kind in kinds]
    longest = max(able, key=lambda phase: phase.stop - phase.start, default=None)
    if longest is None or longest.stop - longest.start < _FEWEST_SAMPLES:
        n = 0 if longest is None else longest.stop - longest.start
        raise BadLog(
            log.name,
            "too-short",
            f"the longest stretch of constant velocity without gaps has {n} samples, "
            f"{n / log.sample_rate:.3g} s; needed are at least {_FEWEST_SAMPLES}",
        )
    return longest.start, longest.stop


def _signals(
    log: Log, channels: tuple[Channel, Channel], start: int, stop: int
) -> tuple[FloatArray, FloatArray]:
    first, second = (channel.values[start:stop] for channel in channels)
    for channel, values in zip(channels, (first, second), strict=True):
        if values.size and values.max() == values.min():
            raise BadLog(
                log.name, "constant", f"{channel.name} is {values[0]:g} throughout the stretch used"
            )
    return first, second


def _period(log: Log, values: FloatArray, stated: float | None) -> float | None:
    """Find the period of the excitation in samples; None where it does not repeat."""
    duration = values.size / log.sample_rate
    if stated is not None and stated * log.sample_rate < _FEWEST_PER_PERIOD:
        raise BadLog(
            log.name,
            "period",
            f"a period of {stated:g} s has {stated * log.sample_rate:.3g} samples, needed are at "
            f"least {_FEWEST_PER_PERIOD}; it is stated in seconds",
        )
    if stated is not None and stated > duration / 2:
        raise BadLog(
            log.name,
            "period",
            f"a period of {stated:g} s does not fit twice into the {duration:.4g} s of constant "
            "velocity without gaps; record longer",
        )
    return find_period(values, None if stated is None else stated * log.sample_rate)


def _excited_band(
    values: FloatArray, sample_rate: float, band: tuple[float, float], period: float | None
) -> tuple[float, float]:
    """Cut a band down to where the input is excited."""
    if period is not None:
        # Of parts of a period, lines would differ by how near they stand to a harmonic.
        values = values[values.size - round(int(values.size / period) * period) :]
    amplitude = np.abs(fft.rfft(values - values.mean()))
    frequency = np.arange(amplitude.size) * sample_rate / values.size
    amplitude[(frequency < band[0]) | (frequency > band[1])] = 0.0
    excited = frequency[amplitude >= max(EXCITED * amplitude.max(), np.finfo(float).tiny)]
    # Half a line more at either end, lest rounding cost the last one.
    line = 0.5 * sample_rate / values.size
    return (excited[0] - line, excited[-1] + line) if excited.size else band


def name_modes(modes: Modes, stage: Stage) -> Modes:
    """Name modes as a stage description does, where there is no doubt.

    Parameters
    ----------
    modes : Modes
        Of one response.
    stage : Stage
        A mode has a name if it alone lies where the description looks for that name, and for no
        other; all others have none, and `track` finds out whose they are.
    """
    near = _near(modes, stage)
    names = [""] * len(modes.names)
    for mode, spec in zip(near, stage.modes, strict=True):
        if mode.sum() == 1 and near[:, mode].sum() == 1:
            names[int(mode.argmax())] = spec.name
    return replace(modes, names=tuple(names))


def why_unnamed(modes: Modes, stage: Stage) -> Iterator[str]:
    """Say why modes have no name after `name_modes`, where a description looks for any there.

    Parameters
    ----------
    modes : Modes
        Named.
    stage : Stage
        By which they are named.
    """
    near = _near(modes, stage)
    for place in np.flatnonzero([not name for name in modes.names]):
        sought = [spec.name for spec, own in zip(stage.modes, near, strict=True) if own[place]]
        told = f"the mode at {modes.frequency[place]:.5g} Hz has no name: "
        then = "; track finds out whose it is, or write its name into column mode"
        if len(sought) > 1:
            several = f"{', '.join(sought[:-1])} and {sought[-1]}"
            both = "both" if len(sought) == 2 else "all"
            yield f"{told}{several} are {both} looked for there{then}"
        elif sought:
            yield f"{told}it is not alone where {sought[0]} is looked for{then}"


def _near(modes: Modes, stage: Stage) -> BoolArray:
    """Tell which modes lie where which are looked for, ``(n_described, n_modes)``."""
    off = [np.abs(modes.frequency / spec.frequency_hz - 1) <= spec.search for spec in stage.modes]
    return np.array(off, dtype=bool).reshape(len(stage.modes), -1)


def _differenced(
    pair: tuple[FloatArray, FloatArray], lag: int, period: float | None
) -> tuple[FloatArray, FloatArray]:
    """Take second differences of both signals, over ``lag`` samples: the response stays the same.

    The slow part of a displacement is larger by orders than what modes add to it, and would leak
    from the ends of each period. The difference reaches over as many samples as the band allows,
    because between neighbours it would raise fast noise so far that this leaks instead.
    """
    first, second = (x[2 * lag :] - 2 * x[lag:-lag] + x[: -2 * lag] for x in pair)
    if period is None:
        return first, second
    # The few samples lost would cost a period; one period later they are the same but for noise.
    there = round(period)
    missing = slice(max(there - 2 * lag, 0), there)
    return np.concatenate([first[missing], first]), np.concatenate([second[missing], second])


def _check_answer(log: Log, frf: Frf) -> None:
    """Insist on a coherence beyond what noise alone shows: 1/n on average."""
    n = frf.n_averages
    mean, least = float(frf.coherence.mean()), 1 / n
    # Neighbouring lines of a Hann window have half of their information in common.
    chance = np.sqrt((n - 1) / (n + 1) / frf.coherence.size * 2) / n
    if mean < least + _ANSWERS * chance:
        raise BadLog(
            log.name,
            "coherence",
            f"{frf.output} does not answer {frf.input}: their mean coherence is {mean:.3f}, that "
            f"of noise {least:.3f}; excite more, or record longer",
        )


def _modes(log: Log, frf: Frf, output: Channel, fit: ResponseFit) -> Modes:
    """Keep the modes that are credible; say why the others are not."""
    m = fit.estimate.size // 2
    why = {i: reason for i in range(m) if (reason := _incredible(frf, fit, i)) is not None}
    kept = np.array([i for i in range(m) if i not in why], dtype=int)
    both = np.concatenate([kept, kept + m])
    refused = [
        Refusal(log.name, reason, detail, output.name, f"{np.exp(fit.estimate[i]):.5g} Hz", "frf")
        for i, (reason, detail) in why.items()
    ]
    if kept.size == 0:
        low, high = frf.frequency[[0, -1]]
        detail = f"no resonance between {low:.4g} and {high:.4g} Hz from {frf.input}"
        refused.append(Refusal(log.name, "not-excited", detail, output.name, source="frf"))
    return Modes(
        names=tuple(f"mode_{k + 1}" for k in range(kept.size)),
        sources=("frf",) * kept.size,
        channels=(output.name,) * kept.size,
        ln_frequency=fit.estimate[kept],
        ln_damping=fit.estimate[kept + m],
        cov=fit.cov[np.ix_(both, both)],
        snr=fit.snr[kept],
        dispersion=np.full(kept.size, np.nan),
        flags=("",) * kept.size,
        shape_channels=(),
        shapes=np.empty((kept.size, 0)),
        lines=_lines(log, output, fit),
        refused=(*log.refused, *refused),
    )


def _incredible(frf: Frf, fit: ResponseFit, i: int) -> tuple[str, str] | None:
    """Say why a pole is no mode that can be reported; None when it is."""
    m = fit.estimate.size // 2
    f, zeta = float(np.exp(fit.estimate[i])), float(np.exp(fit.estimate[m + i]))
    std_f, std_zeta = np.sqrt(np.diag(fit.cov))[[i, m + i]].tolist()
    low, high = frf.frequency[[0, -1]].tolist()
    spacing = fit.ordinates.spacing
    if not low <= f <= high:
        return "outside-band", f"{f:.5g} Hz lies outside {low:.5g} to {high:.5g} Hz"
    if zeta > HEAVY:
        return "overdamped", f"damping {zeta:.2g}, at most {HEAVY:g}: a background, or no mode"
    if 2 * zeta * f < spacing:
        return (
            "line-not-mode",
            f"{2 * zeta * f:.2g} Hz wide, but lines are {spacing:.2g} Hz apart; record longer",
        )
    if fit.over_distortion[i] < _LEAST_OVER_DISTORTION:
        return (
            "distorted",
            f"its power is {fit.over_distortion[i]:.2g} times that of the distortion around it, "
            f"needed {_LEAST_OVER_DISTORTION:g}: a nonlinearity may show as much; excite less",
        )
    if std_f > WORST_STD_LN_F or std_zeta > WORST_STD_LN_ZETA:
        return (
            "too-uncertain",
            f"known to {100 * std_f:.2g} % only, its damping to {100 * std_zeta:.0f} %; record "
            "longer or excite more",
        )
    return None


def _lines(log: Log, output: Channel, fit: ResponseFit) -> tuple[Line, ...]:
    """Name what was left out of the fit as no answer to the input."""
    frequency, amplitude = fit.outliers.T
    if output.kind == "displacement":
        amplitude = amplitude * (2 * np.pi * frequency) ** 2
    pairs = zip(frequency.tolist(), amplitude.tolist(), strict=True)
    seen = [(output.name, f, a) for f, a in pairs]
    return name_lines(seen, log, None, fit.ordinates.spacing)
