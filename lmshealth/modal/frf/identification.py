"""Identification of modes from a frequency response between two channels of a log."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from lmshealth._arrays import FloatArray
from lmshealth.errors import BadLog
from lmshealth.io.log import Channel, Log, Refusal
from lmshealth.modal import constants
from lmshealth.modal.frf.blows import find_hits, from_blows
from lmshealth.modal.frf.measured import MeasuredResponse, from_measured
from lmshealth.modal.frf.periods import find_period
from lmshealth.modal.frf.rational import LEAST_DAMPING, Ordinates
from lmshealth.modal.frf.response_fit import (
    FEWEST_POWERS,
    ResponseFit,
    fit_response,
    without_window,
)
from lmshealth.modal.frf.responses import Frf, Pair, from_periods, from_record
from lmshealth.modal.modes import Modes, Rejection, estimates_only, merge, numbered
from lmshealth.signal.segments import find_phases
from lmshealth.signal.spectral_lines import Line, name_lines

# The second difference of a displacement spans this part of the shortest period.
_LAG_PERIODS = 8.0
# Poles refused for these reasons are no resonance of the response.
_NO_RESONANCE = {"outside-band", "overdamped", "line-not-mode"}


@dataclass(frozen=True, slots=True, eq=False)
class FrfReading:
    """Frequency response of one channel to another, and its modes."""

    frf: Frf  # measured response
    fit: ResponseFit  # rational transfer function fitted to it
    modes: Modes  # credible modes, and why others are refused


def read_frf(
    log: Log,
    input: str,
    output: str,
    *,
    band: tuple[float, float] | None = None,
    period: float | None = None,
    impact: bool | None = None,
) -> FrfReading:
    r"""Measure the frequency response between two channels and identify its modes.

    The longest segment of constant velocity without gaps is used. A periodic input is cut into
    whole periods; the first is left out where it differs from the others by more than their
    scatter. The response to a disturbance added to the servo's current has the modes of the closed
    loop, that to the whole current those of the machine without its servo. Blows of a hammer are
    averaged; double hits and overloads are refused.

    Parameters
    ----------
    log : Log
        Modes do not depend on units: an input in V or a force may be given as a current, an angle
        as a displacement.
    input, output : str
        Channel names.
    band : (float, float), optional
        In Hz; by default where the input is excited.
    period : float, optional
        Of the excitation in s; refined within 1 %. By default it is estimated from the input, if
        that is periodic.
    impact : bool, optional
        Whether the input is the force of blows; by default where that is certain.

    Raises
    ------
    BadLog
        If a channel is missing or constant, the record is too short, nothing is excited in the
        band, or the output does not respond.

    References
    ----------
    Pintelon2012

    Examples
    --------
    A current excites a mode of 126.4 Hz with a damping of 1.5 %:

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
    source, response = _channel(log, input), _channel(log, output)
    if input == output:
        raise BadLog(log.name, "channel", f"{input} is both input and output; needed are two")
    start, stop = _longest_segment(log)
    top = constants.USABLE * log.sample_rate
    low, high = band or (0.0, top)
    if low >= top:
        raise BadLog(
            log.name,
            "sample-rate",
            f"{log.sample_rate:g} Hz shows nothing above {top:.4g} Hz; the band begins at {low:g}",
        )
    pair = _signals(log, (source, response), start, stop)
    if impact or (impact is None and period is None):
        blows = find_hits(pair[0], log.sample_rate, certain=not impact)
        if blows:
            measured = Pair(log, (input, output), pair, 0)
            frf, ordinates, refused = from_blows(measured, blows, (low, min(high, top)))
            return _identify(log.name, frf, ordinates, (*log.refused, *refused))
        if impact:
            raise BadLog(
                log.name,
                "not-excited",
                f"no blow: no pulse of {input} exceeds {constants.TRIGGER_SIGMAS:g} times its "
                "noise; strike harder, or read it without --impact",
            )
    samples = _period(log, pair[0], period)
    band = _excited_band(pair[0], log.sample_rate, (low, min(high, top)), samples)
    lag = 0
    if response.kind == "displacement":
        lag = max(1, int(log.sample_rate / (_LAG_PERIODS * band[1])))
        pair = _differenced(pair, lag, samples)
    measured = Pair(log, (input, output), pair, lag)
    if samples is None:
        frf, ordinates = from_record(measured, band)
    else:
        frf, ordinates = from_periods(measured, band, samples)
    _check_coherence(log.name, frf)
    fit = fit_response(ordinates)
    modes = _modes(log.name, frf, fit, log.refused, _lines(log, response, fit))
    return FrfReading(frf, fit, modes)


def read_measured(
    response: MeasuredResponse,
    *,
    band: tuple[float, float] | None = None,
    averages: int | None = None,
    window: float | None = None,
) -> FrfReading:
    """Identify the modes of a frequency response that was measured before.

    Parameters
    ----------
    response : MeasuredResponse
    band : (float, float), optional
        In Hz; by default all lines.
    averages : int, optional
        Number of independent averages; with the coherence it gives the noise, which otherwise is
        that of the residual of the fit.
    window : float, optional
        Time constant in s of the exponential window that the analyser applied to the response; the
        damping that it adds, 1/(2πfτ), is removed.

    Raises
    ------
    BadLog
        If there are too few lines, too many, or the output does not respond.
    """
    frf, ordinates = from_measured(response, band or (0.0, np.inf), averages)
    return _identify(response.name, frf, ordinates, window=window)


def _identify(
    log: str,
    frf: Frf,
    ordinates: Ordinates,
    before: tuple[Refusal, ...] = (),
    window: float | None = None,
) -> FrfReading:
    """Identify the modes of blows or of a measured response, whose noise may be unknown."""
    if ordinates.scatter:
        _check_coherence(log, frf)
    fit = fit_response(ordinates)
    if window is not None:
        fit = without_window(fit, window)
    if not ordinates.scatter:
        std = np.sqrt(fit.ordinates.noise) / np.abs(fit.ordinates.given)
        frf = replace(frf, std=np.interp(frf.frequency, fit.ordinates.frequency, std))
    return FrfReading(frf, fit, _modes(log, frf, fit, before))


def _channel(log: Log, name: str) -> Channel:
    for channel in log.channels:
        if channel.name == name:
            return channel
    available = [channel.name for channel in log.channels]
    why = "".join(f"; {name} was refused: {r.detail}" for r in log.refused if r.channel == name)
    raise BadLog(log.name, "channel", f"no usable channel {name!r}; available {available}{why}")


def _longest_segment(log: Log) -> tuple[int, int]:
    """Return the longest segment of constant velocity, or of rest in a log that never moves."""
    phases = find_phases(log)
    rests = all(phase.kind == "idle" for phase in phases)
    usable = [phase for phase in phases if rests or phase.kind in ("constant", "whole")]
    longest = max(usable, key=lambda phase: phase.stop - phase.start, default=None)
    if longest is None or longest.stop - longest.start < constants.FRF_SAMPLES:
        n = 0 if longest is None else longest.stop - longest.start
        raise BadLog(
            log.name,
            "too-short",
            f"the longest segment of constant velocity without gaps has {n} samples, "
            f"{n / log.sample_rate:.3g} s; needed are at least {constants.FRF_SAMPLES}",
        )
    return longest.start, longest.stop


def _signals(
    log: Log, channels: tuple[Channel, Channel], start: int, stop: int
) -> tuple[FloatArray, FloatArray]:
    first, second = (channel.values[start:stop] for channel in channels)
    for channel, values in zip(channels, (first, second), strict=True):
        if values.size and values.max() == values.min():
            raise BadLog(
                log.name, "constant", f"{channel.name} is {values[0]:g} throughout the segment used"
            )
    return first, second


def _period(log: Log, values: FloatArray, stated: float | None) -> float | None:
    """Return the period of the excitation in samples; None where it is not periodic."""
    duration = values.size / log.sample_rate
    if stated is not None and stated * log.sample_rate < constants.FRF_PERIOD_SAMPLES:
        raise BadLog(
            log.name,
            "period",
            f"a period of {stated:g} s has {stated * log.sample_rate:.3g} samples, needed are at "
            f"least {constants.FRF_PERIOD_SAMPLES}; it is stated in seconds",
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
    """Reduce a band to where the input is excited."""
    if period is not None:
        # In whole periods every excited line is a harmonic.
        values = values[values.size - round(int(values.size / period) * period) :]
    amplitude = np.abs(fft.rfft(values - values.mean()))
    frequency = np.arange(amplitude.size) * sample_rate / values.size
    amplitude[(frequency < band[0]) | (frequency > band[1])] = 0.0
    excited = frequency[amplitude >= max(constants.EXCITED * amplitude.max(), np.finfo(float).tiny)]
    # Half a line more at either end, so that rounding does not lose the last one.
    line = 0.5 * sample_rate / values.size
    return (excited[0] - line, excited[-1] + line) if excited.size else band


def _differenced(
    pair: tuple[FloatArray, FloatArray], lag: int, period: float | None
) -> tuple[FloatArray, FloatArray]:
    """Take second differences of both signals over ``lag`` samples; the response is unchanged.

    The slow part of a displacement exceeds that of the modes by orders of magnitude and would leak
    from the ends of each period. The lag is as long as the band allows: differences of neighbours
    would amplify fast noise until this leaks instead.
    """
    first, second = (x[2 * lag :] - 2 * x[lag:-lag] + x[: -2 * lag] for x in pair)
    if period is None:
        return first, second
    # The samples lost at the start are those one period later, but for noise.
    later = round(period)
    missing = slice(max(later - 2 * lag, 0), later)
    return np.concatenate([first[missing], first]), np.concatenate([second[missing], second])


def _check_coherence(name: str, frf: Frf) -> None:
    """Require a coherence above that of noise, 1/n on average."""
    n = frf.n_averages
    mean, least = float(frf.coherence.mean()), 1 / n
    # Neighbouring lines of a Hann window share half of their information.
    chance = np.sqrt((n - 1) / (n + 1) / frf.coherence.size * 2) / n
    if mean < least + constants.COHERENT_SIGMAS * chance:
        raise BadLog(
            name,
            "coherence",
            f"{frf.output} does not respond to {frf.input}: mean coherence {mean:.3f}, that "
            f"of noise {least:.3f}; excite more, or record longer",
        )


def _modes(
    log: str,
    frf: Frf,
    fit: ResponseFit,
    before: tuple[Refusal, ...] = (),
    lines: tuple[Line, ...] = (),
) -> Modes:
    """Return the credible modes; the others are refused."""
    m = fit.estimate.size // 2
    why = {i: reason for i in range(m) if (reason := _incredible(frf, fit, i)) is not None}
    nothing: Rejection | None = None
    if fit.ordinates.scatter and fit.missed > constants.FRF_MISSED:
        nothing = _why_missed(frf, fit)
        why = dict.fromkeys(range(m), nothing)
    elif len(why) == m and {one.reason for one in why.values()} <= _NO_RESONANCE:
        nothing = _why_none(frf, fit)
    refused = [
        Refusal(log, *one[:2], frf.output, f"{np.exp(fit.estimate[i]):.5g} Hz", "frf")
        for i, one in why.items()
    ]
    if nothing is not None:
        refused.append(Refusal(log, *nothing[:2], frf.output, source="frf"))
    found = estimates_only(fit.estimate, fit.cov, fit.snr, "frf", [frf.output] * m)
    kept = found.select([i for i in range(m) if i not in why])
    return numbered(merge([kept], lines, (*before, *refused)))


def _why_missed(frf: Frf, fit: ResponseFit) -> Rejection:
    """Return why no rational response fits: lines too few for what there is, or no linear one."""
    misses = (
        f"the fit misses {100 * fit.missed:.0f} % of the response, allowed are "
        f"{100 * constants.FRF_MISSED:.0f} %, and periods scatter by "
        f"{100 * _noise_share(fit):.2g} %: "
    )
    few, n, top = _too_few(frf, fit)
    if few and not frf.stray > constants.NONLINEAR_OUTPUT:
        return Rejection("too-few-lines", misses + few)
    return Rejection(
        "nonlinear",
        f"{misses}a nonlinearity: {n} lines around the peak at {top:.4g} Hz and "
        f"{100 * frf.stray:.2g} % of the answer at harmonics without input; excite less, and if "
        f"that changes nothing choose a narrower band (at most {constants.FRF_MOST_MODES} modes "
        "are fitted)",
    )


def _too_few(frf: Frf, fit: ResponseFit) -> tuple[str, int, float]:
    """Return why lines are too few, or nothing; and how many show the highest peak, in Hz."""
    gain, frequency = np.abs(frf.response), frf.frequency
    top = int(np.argmax(gain))
    # A resonance falls to 1/√10 over three half-power bandwidths.
    low = np.flatnonzero(gain[:top] ** 2 < gain[top] ** 2 / 10).max(initial=-1)
    high = top + np.flatnonzero(gain[top:] ** 2 < gain[top] ** 2 / 10).min(initial=gain.size - top)
    n = int(high - low - 1)
    needed = 4 * constants.FRF_MOST_MODES + 2 * FEWEST_POWERS + 2
    spacing = fit.ordinates.spacing
    few = (
        f"{n} excited lines within three half-power bandwidths of the peak at "
        f"{frequency[top]:.4g} Hz, needed {constants.LINES_OF_MODE}, and {gain.size} in all, "
        f"needed {needed} for {constants.FRF_MOST_MODES} modes; excite lines closer than "
        f"the {spacing:.3g} Hz of now, with a period longer than {1 / spacing:.2g} s"
    )
    enough = n >= constants.LINES_OF_MODE and gain.size >= needed
    return "" if enough else few, n, float(frequency[top])


def _why_none(frf: Frf, fit: ResponseFit) -> Rejection:
    """Return why no mode is found in a response that the fit does not miss."""
    low, high = frf.frequency[[0, -1]]
    share, most = _noise_share(fit), constants.FRF_MISSED
    none = f"no resonance between {low:.4g} and {high:.4g} Hz from {frf.input}"
    if share <= most:
        return Rejection("not-excited", none)
    few, n, _ = _too_few(frf, fit)
    if n < constants.LINES_OF_MODE and not fit.ordinates.scatter:
        return Rejection("too-few-lines", f"{none}: {few}")
    return Rejection(
        "noise",
        f"{none}: noise is {100 * share:.0f} % of the response and hides modes above "
        f"{100 * most:.0f} %; record "
        f"{(share / most) ** 2:.1f} times as long, or excite {share / most:.1f} times as much",
    )


def _noise_share(fit: ResponseFit) -> float:
    """Return the noise as a share of the amplitude of the answer, at most 1."""
    o = fit.ordinates
    return min(1.0, float(np.sqrt(np.sum(o.noise) / np.sum(np.abs(o.answer) ** 2))))


def _incredible(frf: Frf, fit: ResponseFit, i: int) -> Rejection | None:
    """Return why a pole is not credible as a mode; None if it is."""
    m = fit.estimate.size // 2
    f, zeta = float(np.exp(fit.estimate[i])), float(np.exp(fit.estimate[m + i]))
    std_f, std_zeta = np.sqrt(np.diag(fit.cov))[[i, m + i]].tolist()
    low, high = frf.frequency[[0, -1]].tolist()
    if not low <= f <= high:
        return Rejection("outside-band", f"{f:.5g} Hz lies outside {low:.5g} to {high:.5g} Hz")
    if zeta > constants.FRF_MOST_DAMPING:
        most = constants.FRF_MOST_DAMPING
        return Rejection("overdamped", f"damping {zeta:.2g}, at most {most:g}: background, no mode")
    if zeta < LEAST_DAMPING:
        return Rejection(
            "too-uncertain",
            "all of its damping is that of the exponential window; choose a longer window",
        )
    if unresolved := _unresolved(frf, fit.ordinates, f, zeta):
        return unresolved
    if fit.over_distortion[i] < constants.OVER_DISTORTION:
        return Rejection(
            "distorted",
            f"its power is {fit.over_distortion[i]:.2g} times that of the distortion around it, "
            f"needed {constants.OVER_DISTORTION:g}: a nonlinearity may look the same; excite less",
        )
    if std_f > constants.WORST_STD_LN_F or std_zeta > constants.WORST_STD_LN_ZETA:
        return Rejection(
            "too-uncertain",
            f"standard deviation {100 * std_f:.2g} %, damping {100 * std_zeta:.0f} %; record "
            "longer or excite more",
        )
    return None


def _unresolved(frf: Frf, ordinates: Ordinates, f: float, zeta: float) -> Rejection | None:
    """Return why lines do not show a mode, or why it may be a line of the spectrum itself."""
    spacing = ordinates.spacing
    if frf.method == "blows":
        fades = 1 - float(np.exp(-2 * np.pi * f * zeta / spacing))
        # Over several blows the phase of a line is random.
        if ordinates.scatter or fades >= constants.LEAST_FADING:
            return None
        return Rejection(
            "line-not-mode",
            f"it fades by {100 * fades:.0f} % in {1 / spacing:.3g} s after the blow, needed "
            f"{100 * constants.LEAST_FADING:.0f} %: strike several times, or record longer",
        )
    if ordinates.periodic:
        reach = constants.BANDWIDTHS_OF_LINES * zeta * f
        n = int(np.count_nonzero(np.abs(ordinates.frequency - f) <= reach))
        if n < constants.LINES_OF_MODE:
            most = 2 * reach / constants.LINES_OF_MODE
            return Rejection(
                "too-few-lines",
                f"{n} excited lines in {2 * reach:.3g} Hz, {constants.BANDWIDTHS_OF_LINES} "
                f"half-power bandwidths (damping {zeta:.2g}); needed {constants.LINES_OF_MODE}: "
                f"excite lines at most {most:.2g} Hz apart (now {spacing:.3g} Hz), with a period "
                f"of at least {1 / most:.2g} s",
            )
    elif 2 * zeta * f < spacing:
        return Rejection(
            "line-not-mode",
            f"{2 * zeta * f:.2g} Hz wide, but lines are {spacing:.2g} Hz apart; record longer",
        )
    return None


def _lines(log: Log, output: Channel, fit: ResponseFit) -> tuple[Line, ...]:
    """Classify the outliers of the fit, which are no response to the input."""
    frequency, amplitude = fit.outliers.T
    if output.kind == "displacement":
        amplitude = amplitude * (2 * np.pi * frequency) ** 2
    seen = [(output.name, f, a) for f, a in np.column_stack([frequency, amplitude]).tolist()]
    return name_lines(seen, (), None, fit.ordinates.spacing)
