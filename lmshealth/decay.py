"""Identification of modes from free decays: what a machine does after every stop.

The stretches after the stops of a log share frequencies, dampings and noise; sizes and phases are
each stop's own. Noise is what the sensors add and what still shakes the same modes: the second is
what least squares forget.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, stats

from lmshealth.arrays import FloatArray
from lmshealth.errors import BadLog, BadStage
from lmshealth.logs import Channel, Log, Refusal
from lmshealth.naming import DAMPING_SPAN, assign
from lmshealth.results import Modes
from lmshealth.ringing import Estimate, Ringing, estimate, find_ringing, stationarity
from lmshealth.segments import Segment, select_segments
from lmshealth.stage import Stage
from lmshealth.starts import Target
from lmshealth.transient import make_block

# A band reaches so many Fourier frequencies, and so many half-power half widths, beyond its modes;
# modes closer than that are fitted together, but never more than a few.
_REACH, _WIDTHS, _MOST_TOGETHER = 14.0, 6.0, 4
# Decays as long as each other within this share are cut to one length.
_SAME_LENGTH = 0.95
# Probability that noise alone makes a peak somewhere, and how many neighbours tell its level.
_FALSE_ALARM, _AROUND = 1e-3, 24
# Periods of the lowest mode that a decay must hold; ordinates that a band must.
_PERIODS, _LEAST_ORDINATES = 4.0, 12
_TOP = 0.45  # of the sample rate: anti-alias filters reach below Nyquist
# Shares of a decay that are left out until the rest is one in stationary noise, and the
# probability below which it is said not to be.
_SKIPS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
_NOT_STATIONARY = 1e-3
# What a later beginning may mend in the loudest mode.
_TOO_EARLY = ("too-uncertain", "too-close")
_WORST_STD_LN_F = 0.03
# A damping that is fewer than so many standard deviations off zero may be a line's.
_LEAST_DAMPING = 3.0
_FADED, _HEAVY = 0.6, 0.1
# Mean square of a mode's vibration at the stops over that of its ambient response.
_EXCITED = 16.0


@dataclass(frozen=True, slots=True, eq=False)
class _Pole:
    """A mode of a band before it has a name."""

    frequency: float
    damping: float
    snr: FloatArray  # per channel
    why: tuple[str, str] | None  # it is refused


@dataclass(frozen=True, slots=True, eq=False)
class _Band:
    """What a band of one kind of channels shows."""

    source: str
    channels: tuple[str, ...]
    poles: tuple[_Pole, ...]
    mean: FloatArray
    cov: FloatArray


def identify_decays(
    log: Log,
    stage: Stage | None = None,
    *,
    segments: Sequence[Segment] | None = None,
    channels: Sequence[str] | None = None,
    band: tuple[float, float] | None = None,
) -> Modes:
    """Identify the modes of a log from its free decays, with their covariance.

    Parameters
    ----------
    log : Log
        Displacement (following error) and acceleration channels are used.
    stage : Stage, optional
        Says which modes to look for; without it all that rings in the band is found.
    segments : sequence of Segment, optional
        The decays. By default those that follow the moves of the set point; of a log without set
        point each gap-free piece is one.
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
    """
    usable = [c for c in log.channels if c.kind != "current"]
    used = [c for c in usable if channels is None or c.name in channels]
    if not used:
        there = ", ".join(c.name for c in usable) or "none"
        raise BadLog(
            log.name, "no-signal", f"no delta_e or acc channel to analyse; usable: {there}"
        )
    decays = _stops(log, segments)
    targets = _targets(stage, band)
    limits = _limits(log, decays, targets, band)
    found: list[_Band] = []
    for source, kind in (("acc", "acceleration"), ("delta_e", "displacement")):
        group = tuple(c for c in used if c.kind == kind)
        if group:
            found += _ringing(log, group, source, decays, limits, targets)
    return _collect(log, stage, targets, found)


def _stops(log: Log, segments: Sequence[Segment] | None) -> tuple[Segment, ...]:
    """Find the decays; those less than half as long as the longest would only cost."""
    if segments is None and log.reference_velocity is not None:
        segments = select_segments(log, "settling")
    elif segments is None:
        segments = [Segment(start, stop, float("nan")) for start, stop in log.pieces]
    longest = max((s.stop - s.start for s in segments), default=0)
    if longest < 8:
        raise BadLog(log.name, "too-short", f"the longest decay has {longest} samples")
    return tuple(s for s in segments if s.stop - s.start >= longest / 2)


def _targets(stage: Stage | None, band: tuple[float, float] | None) -> tuple[Target, ...]:
    if stage is None:
        return ()
    low, high = band or (0.0, np.inf)
    targets = tuple(
        Target(mode.name, mode.frequency_hz, mode.damping_ratio, mode.search)
        for mode in sorted(stage.modes, key=lambda mode: mode.frequency_hz)
        if low <= mode.frequency_hz <= high
    )
    if not targets:
        raise BadStage(f"{stage.name}: no [[mode]] lies between {low:g} and {high:g} Hz")
    return targets


def _limits(
    log: Log,
    decays: tuple[Segment, ...],
    targets: tuple[Target, ...],
    band: tuple[float, float] | None,
) -> tuple[float, float]:
    """Find where modes are looked for, and insist that the decays resolve it."""
    duration = max(s.stop - s.start for s in decays) / log.sample_rate
    least, top = _PERIODS / duration, _TOP * log.sample_rate
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
            f"{high / _TOP:.0f} Hz",
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
) -> list[_Band]:
    """Fit, band by band, all that rings where modes are looked for."""
    cuts = [_cut(log, channels, decays, skip) for skip in _SKIPS]
    duration = cuts[0][0].shape[1] / log.sample_rate
    peaks = _peaks(cuts[0][0], log.sample_rate, limits)
    if targets:
        peaks = [f for f in peaks if any(_sought(t, f, 1.2) for t in targets)]
    bands = []
    for group, (low, high) in _groups(peaks, duration):
        reach = _reach(duration, group[-1])
        ends = max(low - reach, 1.5 / duration), min(high + reach, 0.49 * log.sample_rate)
        inside = max(low, limits[0]), min(high, limits[1])
        names = tuple(c.name for c in channels)
        bands += _settled(cuts, log.sample_rate, ends, _View(source, names, inside))
    return bands


@dataclass(frozen=True, slots=True)
class _View:
    """Of what kind and name the channels are, and between which Hz modes are asked for."""

    source: str
    channels: tuple[str, ...]
    inside: tuple[float, float]


def _settled(
    cuts: list[list[FloatArray]], sample_rate: float, ends: tuple[float, float], view: _View
) -> list[_Band]:
    """Begin the decays later until they are sums of distinct modes in stationary noise.

    Right after a stop a machine is still moving and not yet linear. Two poles that a Fourier
    frequency does not part, or a loud one that is not known, are its way of telling so.
    """
    fallen: list[tuple[Ringing, bool]] = []
    for cut in cuts:
        blocks = tuple(make_block(samples, sample_rate, *ends) for samples in cut)
        found = find_ringing(blocks, displacement=view.source == "delta_e")
        if not found.likelihood.n_modes:
            break
        stationary = stationarity(found) > _NOT_STATIONARY
        if stationary and (np.diff(np.sort(found.frequency)) > 1 / blocks[0].duration).all():
            band = _judged(found, stationary, view)
            loudest = max(band.poles, key=lambda pole: pole.snr.max(), default=None)
            if loudest is None or loudest.why is None or loudest.why[0] not in _TOO_EARLY:
                return [band]
        fallen.append((found, stationary))
    if not fallen:
        return []
    return [_judged(*next((fit for fit in fallen if fit[1]), fallen[0]), view)]


def _sought(target: Target, f: float, slack: float = 1.0) -> bool:
    return bool(abs(np.log(f / target.frequency)) <= slack * np.log1p(target.search))


def _reach(duration: float, f: float) -> float:
    return max(_REACH / duration, _WIDTHS * 0.01 * f)


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
    """Group peaks whose bands overlap, and share what lies between the groups out to them."""
    groups: list[list[float]] = []
    for f in peaks:
        close = bool(groups) and f - groups[-1][-1] < _reach(duration, f)
        if close and len(groups[-1]) < _MOST_TOGETHER:
            groups[-1].append(f)
        else:
            groups.append([f])
    shared = []
    for k, group in enumerate(groups):
        half = _reach(duration, group[-1]) / 2
        before = (group[0] - groups[k - 1][-1]) / 2 if k else half
        after = (groups[k + 1][0] - group[-1]) / 2 if k + 1 < len(groups) else half
        shared.append((group, (group[0] - min(half, before), group[-1] + min(half, after))))
    return shared


def _judged(found: Ringing, stationary: bool, view: _View) -> _Band:
    """Say of every pole of a band inside its limits whether it is believed."""
    result = estimate(found)
    m = found.likelihood.n_modes
    f, zeta = np.exp(result.mean[:m]), np.exp(result.mean[m:])
    kept = [i for i in range(m) if view.inside[0] <= f[i] <= view.inside[1]]
    poles = []
    for i in kept:
        why = _incredible(found, result, i)
        if not stationary:
            why = (
                "not-linear",
                f"what rings at {f[i]:.5g} Hz is no sum of decays in stationary noise, however "
                "late in the decay it is begun",
            )
        poles.append(_Pole(float(f[i]), float(zeta[i]), found.snr(i), why))
    both = np.array([*kept, *(m + i for i in kept)], dtype=int)
    return _Band(
        view.source, view.channels, tuple(poles), result.mean[both], result.cov[np.ix_(both, both)]
    )


def _incredible(found: Ringing, result: Estimate, i: int) -> tuple[str, str] | None:
    """Say why a pole is not believed to be a mode with that estimate; None when it is."""
    m = found.likelihood.n_modes
    f, zeta = float(np.exp(result.mean[i])), float(np.exp(result.mean[m + i]))
    std_f, std_zeta = np.sqrt(np.diag(result.cov))[[i, m + i]].tolist()
    duration = found.likelihood.blocks[0].duration
    faded = 1 - np.exp(-2 * np.pi * f * zeta * duration)
    if std_zeta > 1 / _LEAST_DAMPING and faded < _FADED:
        return (
            "line-not-mode",
            f"{f:.5g} Hz fades by {100 * faded:.2g} % in {duration:.3g} s, its damping is known to "
            f"{100 * min(std_zeta, 9.99):.0f} % only: it may be a line; record on after the stop",
        )
    if std_f > _WORST_STD_LN_F or std_zeta > 1 / _LEAST_DAMPING or zeta > _HEAVY:
        return (
            "too-uncertain",
            f"{f:.5g} Hz is known to {100 * std_f:.2g} % only, its damping {zeta:.2g} to "
            f"{100 * std_zeta:.0f} %; record more stops or excite more",
        )
    if result.excitation[i] < _EXCITED:
        return (
            "not-excited",
            f"{f:.5g} Hz vibrates after the stop with {np.sqrt(result.excitation[i]):.2g} times "
            f"its ambient response; needed is {np.sqrt(_EXCITED):.2g}: stop harder",
        )
    apart = np.abs(np.delete(result.mean[:m] - result.mean[i], i))
    if apart.size and apart.min() < 2 * std_f:
        return ("too-close", f"{f:.5g} Hz has another pole {apart.min() * f:.2g} Hz from it")
    return None


def _collect(
    log: Log, stage: Stage | None, targets: tuple[Target, ...], bands: list[_Band]
) -> Modes:
    """Name what was found and join it into one result."""
    chosen, refused = _named(log, targets, bands) if stage is not None else _numbered(log, bands)
    rows = sorted(chosen, key=lambda row: row[2].poles[row[1]].frequency)
    n = len(rows)
    mean, cov = np.empty(2 * n), np.zeros((2 * n, 2 * n))
    for a, (_, i, band) in enumerate(rows):
        m = len(band.poles)
        mean[[a, n + a]] = band.mean[[i, m + i]]
        for b, (_, j, other) in enumerate(rows):
            if other is band:
                cov[np.ix_([a, n + a], [b, n + b])] = band.cov[np.ix_([i, m + i], [j, m + j])]
    best = [int(np.argmax(band.poles[i].snr)) for _, i, band in rows]
    return Modes(
        names=tuple(name for name, _, _ in rows),
        sources=tuple(band.source for _, _, band in rows),
        channels=tuple(band.channels[c] for c, (_, _, band) in zip(best, rows, strict=True)),
        ln_frequency=mean[:n],
        ln_damping=mean[n:],
        cov=cov,
        snr=np.array([band.poles[i].snr.max() for _, i, band in rows]),
        lines=(),
        refused=(*log.refused, *refused),
    )


_Row = tuple[str, int, _Band]


def _numbered(log: Log, bands: list[_Band]) -> tuple[list[_Row], list[Refusal]]:
    """Give numbers to what rings; Δe is not asked about what accelerometers show."""
    rows: list[_Row] = []
    reasons: list[tuple[float, tuple[str, str]]] = []
    for band in bands:
        for i, pole in enumerate(band.poles):
            known = any(
                abs(pole.frequency / row[2].poles[row[1]].frequency - 1) < 2 * pole.damping
                for row in rows
                if row[2].source != band.source
            )
            if pole.why is not None:
                reasons.append((float(pole.snr.max()), pole.why))
            elif not known:
                rows.append(("", i, band))
    if not rows:
        nothing = ("not-excited", "nothing rings in the band: stop harder, or look elsewhere")
        reason, detail = max(reasons)[1] if reasons else nothing
        raise BadLog(log.name, reason, detail)
    rows.sort(key=lambda row: row[2].poles[row[1]].frequency)
    return [(f"mode_{k}", i, band) for k, (_, i, band) in enumerate(rows, 1)], []


def _named(
    log: Log, targets: tuple[Target, ...], bands: list[_Band]
) -> tuple[list[_Row], list[Refusal]]:
    """Give names by frequency: accelerometers first, then Δe for what they do not show."""
    rows: list[_Row] = []
    refused: list[Refusal] = []
    reasons: dict[str, tuple[str, str]] = {}
    for source in ("acc", "delta_e"):
        missing = tuple(t for t in targets if t.name not in {name for name, _, _ in rows})
        there = [
            (i, band)
            for band in bands
            if band.source == source
            for i, pole in enumerate(band.poles)
            if pole.why is None
        ]
        there.sort(key=lambda item: item[1].poles[item[0]].frequency)
        seen = [(band.poles[i].frequency, band.poles[i].damping) for i, band in there]
        names, unclear = assign(seen, missing)
        rows += [(n, i, band) for n, (i, band) in zip(names, there, strict=True) if n]
        reasons |= {name: ("ambiguous", detail) for name, detail in unclear.items()}
    named = {name for name, _, _ in rows}
    for target in targets:
        if target.name not in named:
            why = reasons.get(target.name) or _why_not(target, bands)
            refused.append(Refusal(log.name, why[0], why[1], mode=target.name))
    return rows, refused


def _why_not(target: Target, bands: list[_Band]) -> tuple[str, str]:
    """Say why a mode was not found: what was seen where it should be, or that nothing was."""
    near = [p for band in bands for p in band.poles if _sought(target, p.frequency)]
    if near:
        loudest = max(near, key=lambda pole: pole.snr.max())
        return loudest.why or (
            "outside-search",
            f"what rings at {loudest.frequency:.5g} Hz with damping {loudest.damping:.2g} is not "
            f"within a factor of {DAMPING_SPAN:g} of the damping {target.damping_ratio:.2g}",
        )
    return (
        "not-excited",
        f"nothing rings within {100 * target.search:.0f} % of {target.frequency:.4g} Hz; excite "
        "it more, or look for it while the stage moves",
    )
