"""Identification of modes from a frequency response between two channels of a log."""

from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from lmshealth._private.arrays import FloatArray, one_thread
from lmshealth.errors import BadLog
from lmshealth.io.log import Channel, Log, Refusal
from lmshealth.modal import constants
from lmshealth.modal.deterministic.blows import find_hits, from_blows, without_rings
from lmshealth.modal.deterministic.likelihood import least_damping
from lmshealth.modal.deterministic.measured import MeasuredResponse, from_measured
from lmshealth.modal.deterministic.periods import find_period
from lmshealth.modal.deterministic.response_fit import (
    FEWEST_POWERS,
    NO_DAMPING,
    ResponseFit,
    fit_response,
    without_window,
)
from lmshealth.modal.deterministic.responses import Frf, Ordinates, Pair, from_periods, from_record
from lmshealth.modal.modes import Modes, Rejection, estimates_only, merge, numbered
from lmshealth.modal.targets import check_band
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


@one_thread
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
    check_band(log, band)
    pair = _longest_segment(log, (source, response))
    rate, top = log.sample_rate, constants.USABLE * log.sample_rate
    low, high = band or (0.0, top)
    if impact or (impact is None and period is None):
        blows = find_hits(pair[0], rate, certain=not impact)
        if blows:
            measured = Pair(log, (input, output), pair, 0)
            frf, ordinates, refused = from_blows(measured, blows, (low, min(high, top)))
            return _identify(log.name, frf, ordinates, (*log.refused, *refused))
        if impact:
            detail = f"no pulse of {input} exceeds {constants.TRIGGER_SIGMAS:g} times its noise"
            step = "strike harder, or read it without --impact"
            raise BadLog(log.name, "not-excited", f"no blow: {detail}; {step}")
    samples = _period(log, pair[0], period)
    band = _excited_band(pair[0], rate, (low, min(high, top)), samples)
    lag = 0
    if response.kind == "displacement":
        lag = max(1, int(rate / (_LAG_PERIODS * band[1])))
        pair = _differenced(pair, lag, samples)
    measured = Pair(log, (input, output), pair, lag)
    if samples is None:
        frf, ordinates = from_record(measured, band)
    else:
        frf, ordinates = from_periods(measured, band, samples)
    return _identify(log.name, frf, ordinates, log.refused, output=response)


@one_thread
def read_measured(
    response: MeasuredResponse,
    *,
    band: tuple[float, float] | None = None,
    averages: int | None = None,
    window: float | None = None,
) -> FrfReading:
    """Identify the modes of a frequency response that was measured before.

    The band is in Hz, by default all lines. The number of independent averages gives the noise with
    the coherence; otherwise it is that of the residual of the fit. The damping 1/(2πfτ) of an
    exponential window with the time constant ``window`` in s is removed. `BadLog` if there are too
    few lines, too many, or the output does not respond.
    """
    frf, ordinates = from_measured(response, band or (0.0, np.inf), averages)
    return _identify(response.name, frf, ordinates, window=window)


def _identify(
    log: str,
    frf: Frf,
    ordinates: Ordinates,
    before: tuple[Refusal, ...] = (),
    *,
    output: Channel | None = None,
    window: float | None = None,
) -> FrfReading:
    """Identify the modes of a response; outliers of its fit are the lines of an ``output``."""
    _check_coherence(log, frf)
    fit = fit_response(ordinates)
    f, zeta = np.exp(np.split(fit.estimate, 2))
    cleaned = without_rings(ordinates, f, zeta)
    if cleaned is not None:
        fit = fit_response(cleaned)
    if window is not None:
        fit = without_window(fit, window)
    if not (ordinates.scatter or ordinates.transient):
        # The noise of one blow, or of a response without averages, is that of the residual.
        std = np.sqrt(fit.ordinates.noise) / np.abs(fit.ordinates.given)
        frf = replace(frf, std=np.interp(frf.frequency, fit.ordinates.frequency, std))
    lines = () if output is None else _lines(output, fit)
    return FrfReading(frf, fit, _modes(log, frf, fit, before, lines))


def _channel(log: Log, name: str) -> Channel:
    usable = {channel.name: channel for channel in log.channels}
    if name in usable:
        return usable[name]
    why = "".join(f"; {name} was refused: {r.detail}" for r in log.refused if r.channel == name)
    raise BadLog(log.name, "channel", f"no usable channel {name!r}; available {[*usable]}{why}")


def _longest_segment(log: Log, channels: tuple[Channel, Channel]) -> tuple[FloatArray, FloatArray]:
    """Cut out the longest segment of constant velocity, or of rest in a log that never moves."""
    phases = find_phases(log)
    rests = all(phase.kind == "idle" for phase in phases)
    ranges = [(p.start, p.stop) for p in phases if rests or p.kind in ("constant", "whole")]
    start, stop = max(ranges, key=lambda ends: ends[1] - ends[0], default=(0, 0))
    if stop - start < constants.FRF_SAMPLES:
        found = f"has {stop - start} samples, {(stop - start) / log.sample_rate:.3g} s"
        detail = f"the longest segment of constant velocity without gaps {found}"
        needed = f"needed are at least {constants.FRF_SAMPLES}"
        raise BadLog(log.name, "too-short", f"{detail}; {needed}")
    first, second = (channel.values[start:stop] for channel in channels)
    for channel, values in zip(channels, (first, second), strict=True):
        if values.max() == values.min():
            detail = f"{channel.name} is {values[0]:g} throughout the segment used"
            raise BadLog(log.name, "constant", detail)
    return first, second


def _period(log: Log, values: FloatArray, stated: float | None) -> float | None:
    """Return the period of the excitation in samples; None where it is not periodic."""
    if stated is None:
        return find_period(values)
    duration, samples = values.size / log.sample_rate, stated * log.sample_rate
    if samples < constants.FRF_PERIOD_SAMPLES:
        found = f"has {samples:.3g} samples, needed are at least {constants.FRF_PERIOD_SAMPLES}"
        step = "it is stated in seconds"
    elif stated > duration / 2:
        found = f"does not fit twice into the {duration:.4g} s of constant velocity without gaps"
        step = "record longer"
    else:
        return find_period(values, samples)
    raise BadLog(log.name, "period", f"a period of {stated:g} s {found}; {step}")


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
    # Fewer lines than a fit needs, as of mains in a record of noise, do not set the level.
    few = 0 if period is not None else min(constants.FRF_LINES, amplitude.size - 1)
    level = float(np.partition(amplitude, -1 - few)[-1 - few])
    excited = frequency[amplitude >= max(constants.EXCITED * level, np.finfo(float).tiny)]
    # Half a line more at either end, so that rounding does not lose the last one.
    line = 0.5 * sample_rate / values.size
    return (excited[0] - line, excited[-1] + line) if excited.size else band


def _differenced(
    pair: tuple[FloatArray, FloatArray], lag: int, period: float | None
) -> tuple[FloatArray, FloatArray]:
    """Take second differences of both signals over ``lag`` samples; the response is unchanged."""
    # The slow part of a displacement would leak from the ends of each period; differences over a
    # shorter lag than the band allows would amplify fast noise until this leaks instead.
    first, second = (x[2 * lag :] - 2 * x[lag:-lag] + x[: -2 * lag] for x in pair)
    if period is None:
        return first, second
    # The samples lost at the start are those one period later, but for noise.
    later = round(period)
    missing = slice(max(later - 2 * lag, 0), later)
    return np.concatenate([first[missing], first]), np.concatenate([second[missing], second])


def _check_coherence(name: str, frf: Frf) -> None:
    """Require a coherence above that of noise, 1/n on average; NaN where there is none."""
    n = frf.n_averages
    mean, least = float(frf.coherence.mean()), 1 / n
    # Neighbouring lines of a Hann window share half of their information.
    chance = np.sqrt((n - 1) / (n + 1) / frf.coherence.size * 2) / n
    if mean < least + constants.COHERENT_SIGMAS * chance:
        found = f"mean coherence {mean:.3f}, that of noise {least:.3f}"
        detail = f"{frf.output} does not respond to {frf.input}: {found}"
        raise BadLog(name, "coherence", f"{detail}; excite more, or record longer")


def _modes(
    log: str, frf: Frf, fit: ResponseFit, before: tuple[Refusal, ...], lines: tuple[Line, ...]
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
        Refusal(log, *one[:2], frf.output, f"{f:.5g} Hz", "frf", frequency=f)
        for one, f in ((one, float(np.exp(fit.estimate[i]))) for i, one in why.items())
    ]
    if nothing is not None:
        refused.append(Refusal(log, *nothing[:2], frf.output, source="frf"))
    own = fit.estimate, fit.cov, fit.snr
    found = estimates_only(*own, "frf", [frf.output] * m, fit.credibility)
    kept = found.select([i for i in range(m) if i not in why])
    return numbered(merge([kept], lines, (*before, *refused)))


def _why_missed(frf: Frf, fit: ResponseFit) -> Rejection:
    """Return why no rational response fits: lines too few for what there is, or no linear one."""
    few, n, top = _too_few(frf, fit)
    misses = f"the fit misses {100 * fit.missed:.0f} % of the response, allowed are "
    misses += f"{100 * constants.FRF_MISSED:.0f} %, and periods scatter by "
    misses += f"{100 * _noise_share(fit):.2g} %: "
    if few and not frf.stray > constants.NONLINEAR_OUTPUT:
        return Rejection("too-few-lines", misses + few)
    found = f"a nonlinearity: {n} lines around the peak at {top:.4g} Hz and {100 * frf.stray:.2g} %"
    found += " of the answer at harmonics without input"
    step = "excite less, and if that changes nothing choose a narrower band (at most "
    step += f"{constants.FRF_MOST_MODES} modes are fitted)"
    return Rejection("nonlinear", f"{misses}{found}; {step}")


def _too_few(frf: Frf, fit: ResponseFit) -> tuple[str, int, float]:
    """Return why lines are too few, or nothing; and how many show the highest peak, in Hz."""
    gain, frequency = np.abs(frf.response), frf.frequency
    top = int(np.argmax(gain))
    # A resonance falls to 1/√10 over three half-power bandwidths.
    outside = np.flatnonzero(gain**2 < gain[top] ** 2 / 10)
    low = outside[outside < top].max(initial=-1)
    n = int(outside[outside > top].min(initial=gain.size) - low - 1)
    needed = 4 * constants.FRF_MOST_MODES + 2 * FEWEST_POWERS + 2
    spacing = fit.ordinates.spacing
    if n >= constants.LINES_OF_MODE and gain.size >= needed:
        return "", n, float(frequency[top])
    few = f"{n} excited lines within three half-power bandwidths of the peak at "
    few += f"{frequency[top]:.4g} Hz, needed {constants.LINES_OF_MODE}, and {gain.size} in all, "
    few += f"needed {needed} for {constants.FRF_MOST_MODES} modes; excite lines closer than "
    few += f"the {spacing:.3g} Hz of now, with a period longer than {1 / spacing:.2g} s"
    return few, n, float(frequency[top])


def _why_none(frf: Frf, fit: ResponseFit) -> Rejection:
    """Return why no mode is found in a response that the fit does not miss."""
    low, high = frf.frequency[[0, -1]]
    share, most = _noise_share(fit), constants.FRF_MISSED
    more = share / most
    none = f"no resonance between {low:.4g} and {high:.4g} Hz from {frf.input}"
    if share <= most:
        return Rejection("not-excited", none)
    few, n, _ = _too_few(frf, fit)
    if n < constants.LINES_OF_MODE and not fit.ordinates.scatter:
        return Rejection("too-few-lines", f"{none}: {few}")
    found = f"noise is {100 * share:.0f} % of the response and hides modes above {100 * most:.0f} %"
    step = f"record {more**2:.1f} times as long, or excite {more:.1f} times as much"
    return Rejection("noise", f"{none}: {found}; {step}")


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
    if zeta < NO_DAMPING:
        detail = "all of its damping is that of the exponential window; choose a longer window"
        return Rejection("too-uncertain", detail)
    if unresolved := _unresolved(frf, fit.ordinates, f, zeta):
        return unresolved
    if fit.over_distortion[i] < constants.OVER_DISTORTION:
        found = f"its power is {fit.over_distortion[i]:.2g} times that of the distortion around it"
        step = "a nonlinearity may look the same; excite less"
        detail = f"{found}, needed {constants.OVER_DISTORTION:g}: {step}"
        return Rejection("distorted", detail)
    if std_f > constants.WORST_STD_LN_F or std_zeta > constants.WORST_STD_LN_ZETA:
        found = f"standard deviation {100 * std_f:.2g} %, damping {100 * std_zeta:.0f} %"
        return Rejection("too-uncertain", f"{found}; record longer or excite more")
    return None


def _unresolved(frf: Frf, ordinates: Ordinates, f: float, zeta: float) -> Rejection | None:
    """Return why lines do not show a mode, or why it may be a line of the spectrum itself."""
    spacing = ordinates.spacing
    if frf.method == "blows":
        fades = 1 - float(np.exp(-2 * np.pi * f * zeta / spacing))
        # Over several blows the phase of a line is random.
        if ordinates.scatter or fades >= constants.LEAST_FADING:
            return None
        found = f"it fades by {100 * fades:.0f} % in {1 / spacing:.3g} s after the blow"
        detail = f"{found}, needed {100 * constants.LEAST_FADING:.0f} %"
        return Rejection("line-not-mode", f"{detail}: strike several times, or record longer")
    if ordinates.periodic:
        reach = constants.BANDWIDTHS_OF_LINES * zeta * f
        n = int(np.count_nonzero(np.abs(ordinates.frequency - f) <= reach))
        least = least_damping(np.array(f), 1 / spacing)
        if n < constants.LINES_OF_MODE and zeta < 2 * least:
            detail = f"damping {zeta:.1g}, the least of the fit: it may be a line, as of mains"
            step = "choose a period of the excitation that is no multiple of that of the line"
            return Rejection("line-not-mode", f"{detail}; {step}")
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
        detail = f"{2 * zeta * f:.2g} Hz wide, but lines are {spacing:.2g} Hz apart; record longer"
        return Rejection("line-not-mode", detail)
    return None


def _lines(output: Channel, fit: ResponseFit) -> tuple[Line, ...]:
    """Classify the outliers of the fit, which are no response to the input."""
    frequency, amplitude = fit.outliers.T
    if output.kind == "displacement":
        amplitude = amplitude * (2 * np.pi * frequency) ** 2
    seen = [(output.name, f, a) for f, a in np.column_stack([frequency, amplitude]).tolist()]
    # A strong sine leaks into the fourth ordinate from it.
    return name_lines(seen, (), None, 1.5 * fit.ordinates.spacing)
