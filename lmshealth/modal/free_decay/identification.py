"""Identification of modes from free decays: what a machine does after every stop.

The stretches after the stops of a log share frequencies, dampings and noise; sizes and phases are
each stop's own. Noise is what the sensors add and what still shakes the same modes: the second is
what least squares forget.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import ndimage, stats

from lmshealth._arrays import FloatArray
from lmshealth.errors import BadLog
from lmshealth.io.log import Channel, Log
from lmshealth.modal.free_decay.decay_fit import (
    Estimate,
    Ringing,
    estimate,
    find_ringing,
    stationarity,
)
from lmshealth.modal.free_decay.transient_likelihood import make_block
from lmshealth.modal.modes import Modes
from lmshealth.modal.naming import Band, Pole, is_near, name_modes
from lmshealth.modal.targets import (
    USABLE,
    WORST_STD_LN_F,
    Target,
    choose_channels,
    choose_targets,
)
from lmshealth.signal.segments import Segment, select_segments
from lmshealth.stage.description import Stage

# A band reaches so many Fourier frequencies, and such a share of the frequency, beyond its modes;
# modes closer than that are fitted together, but never more than a few.
_REACH, _SHARE, _MOST_TOGETHER = 20.0, 0.06, 4
# So near to the end of a band, in Fourier frequencies, no mode is believed.
_EDGE = 3.0
# Decays as long as each other within this share are cut to one length.
_SAME_LENGTH = 0.95
# Probability that noise alone makes a peak somewhere, and how many neighbours tell its level.
_FALSE_ALARM, _AROUND = 1e-3, 24
# Periods of the lowest mode that a decay must hold; ordinates that a band must.
_PERIODS, _LEAST_ORDINATES = 4.0, 12
# Shares of a decay that are left out until the rest is one in stationary noise, and the
# probability below which it is said not to be.
_SKIPS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
_NOT_STATIONARY = 1e-3
# What a later beginning may mend in the loudest mode.
_TOO_EARLY = ("too-uncertain", "too-close")
# A damping that is fewer than so many standard deviations off zero may be a line's.
_LEAST_DAMPING = 3.0
_FADED, _HEAVY = 0.6, 0.1
_LINE = "line-not-mode"
# Mean square of a mode's vibration at the stops over that of its ambient response.
_EXCITED = 16.0


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
        Says which modes to look for; without it all that rings in the band is found.
    segments : sequence of Segment, optional
        The decays; by default what follows the moves of the set point.
    channels : sequence of str, optional
        Use only these channels.
    band : (float, float), optional
        Use only modes between these frequencies in Hz. Without a stage the default reaches from
        four periods per decay to 0.45 of the sample rate.

    Returns
    -------
    Modes
        With the modes that were looked for and refused, and why. ``snr`` is the mean ordinate of
        the decays at the resonance over the noise.

    Raises
    ------
    BadLog
        If no channel or decay is left, or nothing rings and no stage says what should.
    BadStage
        If the stage has no mode in the band.

    Examples
    --------
    After each of six moves of a second the stage rings at 85 Hz with a damping of 1 %:

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
    used = choose_channels(log, channels)
    decays = _stops(log, segments)
    targets = () if stage is None else choose_targets(stage, band)
    limits = _limits(log, decays, targets, band)
    found: list[Band] = []
    for source, kind in (("acc", "acceleration"), ("delta_e", "displacement")):
        group = tuple(c for c in used if c.kind == kind)
        if group:
            found += _ringing(log, group, source, decays, limits, targets)
    return name_modes(log, targets, found)


def _stops(log: Log, segments: Sequence[Segment] | None) -> tuple[Segment, ...]:
    """Find the decays; those less than half as long as the longest would only cost."""
    if segments is None:
        segments = select_segments(log, "settling")
    longest = max((s.stop - s.start for s in segments), default=0)
    if longest < 8:
        raise BadLog(log.name, "too-short", f"the longest decay has {longest} samples")
    return tuple(s for s in segments if s.stop - s.start >= longest / 2)


def _limits(
    log: Log,
    decays: tuple[Segment, ...],
    targets: tuple[Target, ...],
    band: tuple[float, float] | None,
) -> tuple[float, float]:
    """Find where modes are looked for, and insist that the decays resolve it."""
    duration = max(s.stop - s.start for s in decays) / log.sample_rate
    least, top = _PERIODS / duration, USABLE * log.sample_rate
    if targets:
        low = min(t.frequency / (1 + t.search) for t in targets)
        high = max(t.frequency * (1 + t.search) for t in targets)
    else:
        low, high = band or (least, top)
    if targets and high > top:
        raise BadLog(
            log.name,
            "sample-rate",
            f"{log.sample_rate:g} Hz cannot show modes up to {high:.0f} Hz; needed is at least "
            f"{high / USABLE:.0f} Hz",
        )
    low, high = max(low, least), min(high, top)
    if high * duration < _PERIODS + _LEAST_ORDINATES:
        raise BadLog(
            log.name,
            "too-short",
            f"decays of {duration:.3g} s hold {max(high * duration, 0):.0f} periods of the highest "
            f"mode; needed are {_PERIODS + _LEAST_ORDINATES:.0f}: record on after the stop",
        )
    return low, high


def _cut(
    log: Log, channels: tuple[Channel, ...], decays: tuple[Segment, ...], skip: float
) -> list[FloatArray]:
    """Cut decays out, those of about one length to one length, the longest first.

    Returns
    -------
    list of ndarray
        Shape ``(n_segments, n_samples, n_channels)``.
    """
    starts = [s.start + round(skip * (s.stop - s.start)) for s in decays]
    sizes = [s.stop - start for s, start in zip(decays, starts, strict=True)]
    groups: list[list[int]] = []
    for i in sorted(range(len(sizes)), key=lambda i: -sizes[i]):
        if groups and sizes[i] >= _SAME_LENGTH * sizes[groups[-1][0]]:
            groups[-1].append(i)
        else:
            groups.append([i])
    return [
        np.array(
            [
                np.stack([c.values[starts[i] : starts[i] + sizes[group[-1]]] for c in channels], -1)
                for i in group
            ]
        )
        for group in groups
    ]


def _ringing(
    log: Log,
    channels: tuple[Channel, ...],
    source: str,
    decays: tuple[Segment, ...],
    limits: tuple[float, float],
    targets: tuple[Target, ...],
) -> list[Band]:
    """Fit, band by band, all that rings where modes are looked for."""
    # Cut anew for every band: six copies of all decays would not fit beside a long log.
    cut = partial(_cut, log, channels, decays)
    longest = cut(0.0)[0]
    duration = longest.shape[1] / log.sample_rate
    peaks = _peaks(longest, log.sample_rate, limits)
    if targets:
        peaks = [f for f in peaks if any(is_near(t, f, slack=1.2) for t in targets)]
    bands = []
    for group, (low, high) in _groups(peaks, duration):
        reach = _reach(duration, group[-1])
        ends = max(group[0] - reach, 1.5 / duration), min(group[-1] + reach, 0.49 * log.sample_rate)
        inside = max(low, limits[0]), min(high, limits[1])
        names = tuple(c.name for c in channels)
        bands += _settled(cut, log.sample_rate, ends, _View(source, names, inside))
    return bands


@dataclass(frozen=True, slots=True)
class _View:
    """Of what kind and name the channels are, and between which Hz modes are asked for."""

    source: str
    channels: tuple[str, ...]
    inside: tuple[float, float]


def _settled(
    cut: Callable[[float], list[FloatArray]],
    sample_rate: float,
    ends: tuple[float, float],
    view: _View,
) -> list[Band]:
    """Begin the decays later until they are sums of distinct modes in stationary noise.

    Right after a stop a machine is still moving and not yet linear. Two poles that a Fourier
    frequency does not part, or a loud one that is not known, are its way of telling so.
    """
    never: Ringing | None = None
    early: Ringing | None = None
    for skip in _SKIPS:
        blocks = tuple(make_block(samples, sample_rate, *ends) for samples in cut(skip))
        found = find_ringing(blocks, displacement=view.source == "delta_e")
        if not found.likelihood.n_modes:
            break
        if stationarity(found) <= _NOT_STATIONARY:
            never = never or found
            continue
        early = early or found
        if (np.diff(np.sort(found.frequency)) > 1 / blocks[0].duration).all():
            band = _judged(found, view)
            if not _too_early(band):
                return [band]
    if early is not None:
        return [_judged(early, view)]
    return [_not_linear(never, view)] if never is not None else []


def _too_early(band: Band) -> bool:
    loudest = max((*band.poles, *band.doubted), key=lambda pole: pole.snr.max(), default=None)
    return loudest is not None and loudest.why is not None and loudest.why[0] in _TOO_EARLY


def _reach(duration: float, f: float) -> float:
    return max(_REACH / duration, _SHARE * f)


def _peaks(samples: FloatArray, sample_rate: float, limits: tuple[float, float]) -> list[float]:
    """Find frequencies at which the sum over decays and channels towers over its neighbours."""
    n_segments, n_samples, n = samples.shape
    reach = (_AROUND + 2) * sample_rate / n_samples
    block = make_block(samples, sample_rate, limits[0] - reach, limits[1] + reach)
    power = np.mean(np.abs(block.ordinates) ** 2, axis=0)
    middle = stats.gamma.median(n_segments) / n_segments
    level = ndimage.median_filter(power, (2 * _AROUND + 1, 1), mode="nearest") / middle
    excess = np.sum(power / np.maximum(level, 1e-300), axis=1) * n_segments
    threshold = stats.gamma.isf(_FALSE_ALARM / excess.size, n_segments * n)
    top = (excess == ndimage.maximum_filter1d(excess, 5)) & (excess > threshold)
    top &= (block.frequency >= limits[0]) & (block.frequency <= limits[1])
    return [float(f) for f in block.frequency[top]]


def _groups(peaks: list[float], duration: float) -> list[tuple[list[float], tuple[float, float]]]:
    """Group peaks whose bands overlap, and share out to them what lies in between.

    A mode on the flank of a louder one is no peak, but the fit of the louder one's band finds it.
    """
    groups: list[list[float]] = []
    for f in peaks:
        close = bool(groups) and f - groups[-1][-1] < _reach(duration, f)
        if close and len(groups[-1]) < _MOST_TOGETHER:
            groups[-1].append(f)
        else:
            groups.append([f])
    shared = []
    for k, group in enumerate(groups):
        most = _reach(duration, group[-1]) - _EDGE / duration
        before = (group[0] - groups[k - 1][-1]) / 2 if k else most
        after = (groups[k + 1][0] - group[-1]) / 2 if k + 1 < len(groups) else most
        shared.append((group, (group[0] - min(most, before), group[-1] + min(most, after))))
    return shared


def _judged(found: Ringing, view: _View) -> Band:
    """Say of every pole of a band inside its limits whether it is believed."""
    kept, lines = _inside(found, view), found.is_line()
    doubted = [
        _pole(found, i, (_LINE, f"{found.frequency[i]:.5g} Hz does not fade"))
        for i in kept
        if lines[i]
    ]
    kept = [i for i in kept if not lines[i]]
    if not kept:
        return Band(view.source, view.channels, (), np.empty(0), np.empty((0, 0)), tuple(doubted))
    result = estimate(found, kept)
    poles = [_pole(found, i, _incredible(found, i, result, k)) for k, i in enumerate(kept)]
    sure = [k for k, pole in enumerate(poles) if pole.why is None]
    doubted += [pole for pole in poles if pole.why is not None]
    own = np.array([*sure, *(len(kept) + k for k in sure)], dtype=int)
    return Band(
        source=view.source,
        channels=view.channels,
        poles=tuple(poles[k] for k in sure),
        mean=result.mean[own],
        cov=result.cov[np.ix_(own, own)],
        doubted=tuple(doubted),
    )


def _not_linear(found: Ringing, view: _View) -> Band:
    """Refuse all that rings in a band."""
    doubted = tuple(
        _pole(
            found,
            i,
            (
                "not-linear",
                f"what rings at {found.frequency[i]:.5g} Hz is no sum of decays in stationary "
                "noise, however late in the decay it is begun",
            ),
        )
        for i in _inside(found, view)
    )
    return Band(view.source, view.channels, (), np.empty(0), np.empty((0, 0)), doubted)


def _inside(found: Ringing, view: _View) -> list[int]:
    low, high = view.inside
    return [i for i, f in enumerate(found.frequency.tolist()) if low <= f <= high]


def _pole(found: Ringing, i: int, why: tuple[str, str] | None) -> Pole:
    f, zeta = float(found.frequency[i]), float(found.damping_ratio[i])
    return Pole(f, zeta, found.snr(i), why)


def _incredible(found: Ringing, i: int, result: Estimate, k: int) -> tuple[str, str] | None:
    """Say why the k-th estimate, of pole i, is not believed to be of a mode; None when it is."""
    n = result.excitation.size
    f, zeta = np.exp(result.mean[[k, n + k]]).tolist()
    std_f, std_zeta = np.sqrt(np.diag(result.cov))[[k, n + k]].tolist()
    duration = found.likelihood.blocks[0].duration
    faded = 1 - np.exp(-2 * np.pi * f * zeta * duration)
    if std_zeta > 1 / _LEAST_DAMPING and faded < _FADED:
        return (
            _LINE,
            f"{f:.5g} Hz fades by {100 * faded:.2g} % in {duration:.3g} s, its damping is known to "
            f"{100 * min(std_zeta, 9.99):.0f} % only: it may be a line; record on after the stop",
        )
    if std_f > WORST_STD_LN_F or std_zeta > 1 / _LEAST_DAMPING or zeta > _HEAVY:
        return (
            "too-uncertain",
            f"{f:.5g} Hz is known to {100 * std_f:.2g} % only, its damping {zeta:.2g} to "
            f"{100 * std_zeta:.0f} %; record more stops or excite more",
        )
    if result.excitation[k] < _EXCITED:
        return (
            "not-excited",
            f"{f:.5g} Hz vibrates after the stop with {np.sqrt(result.excitation[k]):.2g} times "
            f"its ambient response; needed is {np.sqrt(_EXCITED):.2g}: stop harder",
        )
    apart = np.abs(np.log(np.delete(found.frequency, i) / f))
    if apart.size and apart.min() < 2 * std_f:
        return ("too-close", f"{f:.5g} Hz has another pole {apart.min() * f:.2g} Hz from it")
    return None
