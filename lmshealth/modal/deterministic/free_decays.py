"""Identification of modes from the free decays after the stops of a stage.

The decays of a log share frequencies, dampings and noise; sizes and phases differ between stops.
The noise comes from the sensors and from forces that still excite the same modes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.special import gammainccinv, gammaincinv

from lmshealth._private.arrays import FloatArray, one_thread, stack
from lmshealth.errors import BadLog
from lmshealth.io.log import Channel, Log, Refusal
from lmshealth.modal import constants
from lmshealth.modal.deterministic.decay_fit import (
    DecayEstimate,
    estimate,
    fit_decays,
    peak_snr,
    stationarity,
)
from lmshealth.modal.deterministic.likelihood import transform_decays
from lmshealth.modal.deterministic.poles import PoleFit
from lmshealth.modal.modes import Modes, Rejection, estimates_only, merge, numbered
from lmshealth.modal.naming import Named, assign, assurance, is_near, pairing_probability
from lmshealth.modal.targets import (
    Target,
    check_band,
    choose_targets,
    limit_channels,
)
from lmshealth.signal.constants import SETTLING_TIME
from lmshealth.signal.segments import Segment, select_segments
from lmshealth.stage.description import Stage

# Reach of a band beyond its modes, in Fourier frequencies and as a share of the frequency: closer
# modes are fitted together. No mode is accepted this near to the end of a band.
_REACH, _SHARE, _EDGE = 20.0, 0.06, 3.0
# Decays whose lengths differ by less than this share are cut to one length.
_SAME_LENGTH = 0.95
# Neighbours that give the level of a peak.
_AROUND = 24
# Shares of a decay that are skipped until the rest is a sum of modes in stationary noise.
_SKIPS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
# Rejections of the strongest mode that a later start may avoid.
_TOO_EARLY = ("too-uncertain", "too-close")
# Source of the modes of each kind of channels.
_SOURCES = {"acceleration": "acc", "displacement": "delta_e"}

Range = tuple[float, float]
"""Lowest and highest frequency in Hz."""


@one_thread
def identify_decays(
    log: Log,
    stage: Stage | None = None,
    *,
    segments: Sequence[Segment] | None = None,
    channels: Sequence[str] | None = None,
    band: tuple[float, float] | None = None,
) -> Modes:
    r"""Identify the modes of a log from its free decays, with their covariance.

    Parameters
    ----------
    log : Log
        Displacement (following error) and acceleration channels are used.
    stage : Stage, optional
        Modes to identify; without it all that decay in the band.
    segments : sequence of Segment, optional
        The decays; by default the segments after the moves of the set point.
    channels : sequence of str, optional
        Use only these channels.
    band : (float, float), optional
        Use only modes between these frequencies in Hz. Without a stage the default is from four
        periods per decay to 0.45 of the sample rate.

    Returns
    -------
    Modes
        With the modes that are refused, and why. ``snr`` is the mean ordinate of the decays at the
        resonance over the noise.

    Raises
    ------
    BadLog
        If no channel or decay is left, or no mode is found without a stage.
    BadStage
        If the stage has no mode in the band.

    Examples
    --------
    After each of six moves of a second a mode of 85 Hz with a damping of 1 % decays:

    >>> import numpy as np
    >>> import lmshealth
    >>> rng, rate = np.random.default_rng(1), 1000
    >>> move, time = np.zeros(rate), np.arange(rate) / rate
    >>> ring = np.exp(-2 * np.pi * 85 * 0.01 * time) * np.cos(2 * np.pi * 85 * time)
    >>> acceleration = np.tile(np.r_[move, ring], 6) + 0.2 * rng.standard_normal(12 * rate)
    >>> velocity = np.tile(np.r_[move + 100, move], 6)
    >>> head = "# sample_rate_hz: 1000\nacc_pitch_m_s2,reference_velocity_mm_s"
    >>> table = np.column_stack([acceleration, velocity])
    >>> np.savetxt("stops.csv", table, delimiter=",", header=head, comments="")
    >>> modes = lmshealth.identify_decays(lmshealth.read_log("stops.csv"), band=(40, 200))
    >>> print(f"{modes.frequency[0]:.2f} ± {modes.frequency_std[0]:.2f} Hz")
    85.02 ± 0.03 Hz
    >>> print(f"{modes.damping_ratio[0]:.2%} ± {modes.damping_ratio_std[0]:.2%}")
    0.97% ± 0.03%
    """
    check_band(log, band)
    log = limit_channels(log, channels)
    used = log.channels
    segments = select_segments(log, "settling") if segments is None else segments
    longest = max((s.stop - s.start for s in segments), default=0)
    if longest < 8:
        raise BadLog(log.name, "too-short", f"the longest decay has {longest} samples")
    decays = tuple(s for s in segments if s.stop - s.start >= longest / 2)
    targets = () if stage is None else choose_targets(stage, band)
    limits = _limits(log, decays, targets, band)
    found: list[_BandModes] = []
    for kind in _SOURCES:
        group = tuple(c for c in used if c.kind == kind)
        if group:
            found += _fit_bands(log, group, decays, limits, targets)
    modes = numbered(merge(_distinct(found), (), log.refused))
    rejected = sorted((row for band in found for row in band.rejected), key=lambda row: -row.snr)
    if targets:
        return _named(modes, rejected, targets, log.name)
    if not modes.names:
        nothing = ("not-excited", "nothing decays in the band: stop harder, or change the band")
        raise BadLog(log.name, *(rejected[0].why[:2] if rejected else nothing))
    return modes


class _Rejected(NamedTuple):
    """A resonance that is not credible."""

    snr: float
    why: Rejection
    damping_ratio: float = np.nan  # NaN where it is no decay


@dataclass(frozen=True, slots=True, eq=False)
class _BandModes:
    """Modes of a band of one kind of channels, and its other resonances."""

    modes: Modes
    rejected: tuple[_Rejected, ...]

    @property
    def strongest_rejection(self) -> str:
        """Why the strongest resonance is no mode; empty where it is one."""
        nothing = _Rejected(0.0, Rejection("", ""))
        strongest = max(self.rejected, key=lambda row: row.snr, default=nothing)
        return strongest.why.reason if strongest.snr > self.modes.snr.max(initial=0.0) else ""


def _named(
    modes: Modes, rejected: Sequence[_Rejected], targets: tuple[Target, ...], log: str
) -> Modes:
    """Name the resonances of decays, with which stronger ones compete that are refused.

    The machine may be anywhere within the searches. Where they hold more resonances than modes, it
    is as likely at its description: else a map makes all places within a search equally likely.
    """
    refused = {f"pole_{k}": Refusal(log, *row.why[:2], frequency=row.why.frequency)
               for k, row in enumerate(rejected)}  # fmt: skip
    rows = [*zip(modes.frequency.tolist(), modes.damping_ratio.tolist(), modes.names, strict=True)]
    # Weaker poles may be errors of the model of a mode.
    rows += [
        (row.why.frequency, row.damping_ratio, name)
        for name, row in zip(refused, rejected, strict=True)
        if row.why.frequency and row.damping_ratio > 0 and row.snr > modes.snr.max(initial=0.0)
    ]
    rows = [row for row in sorted(rows) if any(is_near(t, row[0]) for t in targets)]
    f, zeta = [row[0] for row in rows], [row[1] for row in rows]
    more = len(rows) > len(targets)
    probability = pairing_probability(f, targets, damping=zeta, standing=more)
    names, ambiguous = assign(f, targets, probability)
    given = {row[2]: name for row, name in zip(rows, names, strict=True) if name}
    return Named(given, frozenset(), ambiguous, frozenset(), log).publish(modes, targets, refused)


def _distinct(bands: Sequence[_BandModes]) -> list[Modes]:
    """Return the modes of all bands; of Δe only those that accelerometers do not show."""
    found = [band.modes for band in bands]
    shown = merge([modes for modes in found if "acc" in modes.sources], (), ())
    seen, std = shown.frequency, shown.frequency_std
    return [
        modes if "acc" in modes.sources else modes.select([
            i for i, f in enumerate(modes.frequency)
            if (np.abs(f - seen) > np.maximum(
                constants.SAME_SIGMAS * np.hypot(std, modes.frequency_std[i]),
                modes.damping_ratio[i] * f,
            )).all()
        ])
        for modes in found
    ]  # fmt: skip


def _limits(
    log: Log, decays: Sequence[Segment], targets: Sequence[Target], band: Range | None
) -> Range:
    """Return the frequencies in Hz between which modes are searched for."""
    duration = max(s.stop - s.start for s in decays) / log.sample_rate
    least, top = constants.DECAY_PERIODS / duration, constants.USABLE * log.sample_rate
    low, high = band or (least, top)
    if targets:
        low = min(t.frequency / (1 + t.search) for t in targets)
        high = max(t.frequency * (1 + t.search) for t in targets)
        if high > top:
            raise BadLog(
                log.name,
                "sample-rate",
                f"{log.sample_rate:g} Hz cannot show modes up to {high:.0f} Hz; needed is at "
                f"least {high / constants.USABLE:.0f} Hz",
            )
    low, high = max(low, least), min(high, top)
    needed = constants.DECAY_PERIODS + constants.DECAY_ORDINATES
    if high * duration < needed:
        # More recording does not help where a decay is as long as any that is used.
        todo = "continue recording after the stop"
        if duration > 0.99 * SETTLING_TIME:
            todo = f"no more than {SETTLING_TIME:g} s after a stop are used, excite it otherwise"
        raise BadLog(
            log.name,
            "too-short",
            f"decays of {duration:.3g} s hold {max(high * duration, 0):.0f} periods of the highest "
            f"mode; needed are {needed:.0f}: {todo}",
        )
    return low, high


def _cut(
    log: Log, channels: Sequence[Channel], decays: Sequence[Segment], skip: float
) -> list[FloatArray]:
    """Cut out decays, those of similar length to one length.

    Arrays have shape ``(n_segments, n_samples, n_channels)``, the longest first.
    """
    starts = [s.start + round(skip * (s.stop - s.start)) for s in decays]
    sizes = [s.stop - start for s, start in zip(decays, starts, strict=True)]
    groups: list[list[int]] = []
    for i in sorted(range(len(sizes)), key=lambda i: -sizes[i]):
        if groups and sizes[i] >= _SAME_LENGTH * sizes[groups[-1][0]]:
            groups[-1].append(i)
        else:
            groups.append([i])

    def samples(i: int, size: int) -> FloatArray:
        return np.stack([c.values[starts[i] : starts[i] + size] for c in channels], axis=-1)

    return [np.array([samples(i, sizes[group[-1]]) for i in group]) for group in groups]


def _fit_bands(
    log: Log,
    channels: Sequence[Channel],
    decays: Sequence[Segment],
    limits: Range,
    targets: Sequence[Target],
) -> list[_BandModes]:
    """Fit the modes of each band with peaks, in the channels that are not constant."""
    channels = [c for c in channels if any(np.ptp(c.values[s.start : s.stop]) for s in decays)]
    if not channels:
        return []
    # Cut again for every band: copies of all decays at every start would exceed the memory.
    cut = partial(_cut, log, channels, decays)
    longest = cut(0.0)[0]
    duration = longest.shape[1] / log.sample_rate
    peaks = _peaks(longest, log.sample_rate, limits)
    if targets:
        peaks = [f for f in peaks if any(is_near(t, f, slack=1.2) for t in targets)]
    bands = []
    for group, (low, high) in _bands(peaks, duration):
        reach = _reach(duration, group[-1])
        ends = max(group[0] - reach, 1.5 / duration), min(group[-1] + reach, 0.49 * log.sample_rate)
        inside = max(low, limits[0]), min(high, limits[1])
        try:
            bands += _fit_band(cut, log.sample_rate, ends, channels, inside)
        except np.linalg.LinAlgError as error:
            found = f"noise from {ends[0]:.4g} to {ends[1]:.4g} Hz is below rounding beside decays"
            needed = "needed are samples as measured, with their noise"
            raise BadLog(log.name, "not-identified", f"{found}; {needed}") from error
    return bands


def _fit_band(
    cut: Callable[[float], list[FloatArray]],
    sample_rate: float,
    ends: Range,
    channels: Sequence[Channel],
    limits: Range,
) -> list[_BandModes]:
    """Start the decays later until they are sums of separate modes in stationary noise.

    Right after a stop the machine still moves and is nonlinear: two poles of like shapes within a
    Fourier frequency, or a strong uncertain one, show it.
    """
    nonstationary: PoleFit | None = None
    stationary: PoleFit | None = None
    for skip in _SKIPS:
        blocks = tuple(transform_decays(samples, sample_rate, *ends) for samples in cut(skip))
        fit = fit_decays(blocks, displacement=channels[0].kind == "displacement")
        if not fit.likelihood.n_modes:
            break
        if stationarity(fit) <= constants.NOT_STATIONARY:
            nonstationary = nonstationary or fit
            continue
        stationary = stationary or fit
        if not _is_split(fit, 1 / blocks[0].duration):
            band = _accept(fit, channels, limits)
            if band.strongest_rejection not in _TOO_EARLY:
                return [band]
    best = stationary or nonstationary
    return [_accept(best, channels, limits, linear=best is stationary)] if best else []


def _is_split(fit: PoleFit, within: float) -> bool:
    """Return whether poles of like shapes are nearer than so many Hz, as of a changing mode."""
    f, shapes = fit.frequency, fit.likelihood.shapes
    alike = ~(assurance(shapes, shapes) <= constants.ALIKE_MAC)  # unknown of one channel
    near = np.abs(f[:, None] - f) <= within
    return bool((alike & near).sum() > f.size)


def _reach(duration: float, f: float) -> float:
    return max(_REACH / duration, _SHARE * f)


def _peaks(samples: FloatArray, sample_rate: float, limits: Range) -> list[float]:
    """Return frequencies of peaks of the sum over decays and channels, relative to its level."""
    n_segments, n_samples, n = samples.shape
    reach = (_AROUND + 2) * sample_rate / n_samples
    block = transform_decays(samples, sample_rate, limits[0] - reach, limits[1] + reach)
    # Without leakage of a drift, which no mode causes and the likelihood has, too.
    basis = np.linalg.qr(block.base)[0]
    rows = stack(np.moveaxis(block.ordinates, 0, -1)).reshape(len(basis), -1)
    squares = (rows - basis @ (basis.T @ rows)) ** 2
    power = squares.reshape(2, -1, n, n_segments).sum(axis=0).mean(axis=2)
    middle = gammaincinv(n_segments, 0.5) / n_segments
    level = ndimage.median_filter(power, (2 * _AROUND + 1, 1), mode="nearest") / middle
    excess = np.sum(power / np.maximum(level, 1e-300), axis=1) * n_segments
    threshold = gammainccinv(n_segments * n, constants.DECAY_FALSE_ALARM / excess.size)
    top = (excess == ndimage.maximum_filter1d(excess, 5)) & (excess > threshold)
    top &= (block.frequency >= limits[0]) & (block.frequency <= limits[1])
    return [float(f) for f in block.frequency[top]]


def _bands(peaks: list[float], duration: float) -> list[tuple[list[float], Range]]:
    """Group peaks whose bands overlap, and divide the frequencies between the groups.

    A mode on the flank of a stronger one is no peak; the fit of its band finds it.
    """
    groups: list[list[float]] = []
    for f in peaks:
        close = bool(groups) and f - groups[-1][-1] < _reach(duration, f)
        if close and len(groups[-1]) < constants.MOST_TOGETHER:
            groups[-1].append(f)
        else:
            groups.append([f])
    bands = []
    for k, group in enumerate(groups):
        most = _reach(duration, group[-1]) - _EDGE / duration
        before = (group[0] - groups[k - 1][-1]) / 2 if k else most
        after = (groups[k + 1][0] - group[-1]) / 2 if k + 1 < len(groups) else most
        bands.append((group, (group[0] - min(most, before), group[-1] + min(most, after))))
    return bands


def _accept(
    fit: PoleFit, channels: Sequence[Channel], limits: Range, *, linear: bool = True
) -> _BandModes:
    """Estimate the poles of a band within its limits; reject those that are not credible."""
    lines, modal, rejected = fit.is_line(), list[int](), list[_Rejected]()
    for i, f in enumerate(fit.frequency.tolist()):
        if not limits[0] <= f <= limits[1]:
            continue
        if linear and not lines[i]:
            modal.append(i)
            continue
        why = Rejection("line-not-mode", f"{f:.5g} Hz does not decay", f)
        if not linear:
            unlike = f"the resonance at {f:.5g} Hz is no sum of decays in stationary noise, however"
            why = Rejection("not-linear", f"{unlike} late the decay is started", f)
        rejected.append(_Rejected(float(peak_snr(fit, i).max()), why))
    if not modal:
        return _BandModes(merge((), (), ()), tuple(rejected))
    result = estimate(fit, modal)
    snr = np.array([peak_snr(fit, i) for i in modal])
    best = [channels[c].name for c in snr.argmax(axis=1)]
    own = result.mean, result.cov, snr.max(axis=1), _SOURCES[channels[0].kind]
    modes = estimates_only(*own, best, result.credibility)
    credible = []
    for k, i in enumerate(modal):
        if (incredible := _incredible(fit, i, result, k)) is None:
            credible.append(k)
        else:
            f, zeta = float(modes.frequency[k]), float(modes.damping_ratio[k])
            why = incredible._replace(frequency=f)
            rejected.append(_Rejected(float(modes.snr[k]), why, zeta))
    return _BandModes(modes.select(credible), tuple(rejected))


def _incredible(fit: PoleFit, i: int, result: DecayEstimate, k: int) -> Rejection | None:
    """Return why the k-th estimate, of pole i, is not credible; None if it is."""
    n = result.excitation.size
    f, zeta = np.exp(result.mean[[k, n + k]]).tolist()
    std_f, std_zeta = np.sqrt(np.diag(result.cov))[[k, n + k]].tolist()
    duration = fit.likelihood.blocks[0].duration
    faded = 1 - np.exp(-2 * np.pi * f * zeta * duration)
    worst_zeta = 1 / constants.DECAY_DAMPING_SIGMAS
    if std_zeta > worst_zeta and faded < constants.LEAST_FADING:
        return Rejection(
            "line-not-mode",
            f"{f:.5g} Hz decays by {100 * faded:.2g} % in {duration:.3g} s, its damping has a "
            f"standard deviation of {100 * min(std_zeta, 9.99):.0f} %: it may be a line; continue "
            "recording after the stop",
        )
    most = constants.DECAY_MOST_DAMPING
    if std_f > constants.WORST_STD_LN_F or std_zeta > worst_zeta or zeta > most:
        return Rejection(
            "too-uncertain",
            f"{f:.5g} Hz has a standard deviation of {100 * std_f:.2g} %, its damping {zeta:.2g} "
            f"of {100 * std_zeta:.0f} %; record more stops or excite more",
        )
    if result.excitation[k] < constants.DECAY_EXCITATION:
        needed = np.sqrt(constants.DECAY_EXCITATION)
        return Rejection(
            "not-excited",
            f"{f:.5g} Hz vibrates after the stop with {np.sqrt(result.excitation[k]):.2g} times "
            f"its ambient response; needed is {needed:.2g}: stop harder",
        )
    apart = np.abs(np.log(np.delete(fit.frequency, i) / f))
    if apart.size and apart.min() < 2 * std_f:
        return Rejection(
            "too-close", f"{f:.5g} Hz has another pole {apart.min() * f:.2g} Hz from it"
        )
    return None
