"""Identification of modes: the Whittle likelihood fitted cluster by cluster, channel by channel.

A mode's estimate comes from the one channel that shows it most clearly: channels of one log
share the excitation, so that their errors are not independent and may not be averaged as if.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.special import softmax

from lmshealth.bandfit import BAND, BandFit, fit_band
from lmshealth.errors import BadLog, BadStage
from lmshealth.lines import find_lines, name_lines
from lmshealth.logs import Channel, Log, Refusal
from lmshealth.peaks import find_excess, find_peaks
from lmshealth.results import Line, Modes
from lmshealth.segments import find_segments
from lmshealth.spectra import View, average_spectra
from lmshealth.stage import Stage
from lmshealth.starts import Coarse, Target, coarsen, locate, shift_cost

# Modes whose bands touch are fitted together, but never more than this many.
_MOST_TOGETHER = 4
# Probability from which on a found mode is given its name.
_CLEAR_NAME = 0.8
# Without a description, so many times what a fit leaves over is searched for further modes.
_MOST_ROUNDS = 3
# Shortest useful segment: half-power bandwidth times duration; without a description, periods of
# the top of the band.
_LEAST_RESOLUTION, _LEAST_PERIODS = 2.0, 10.0
_BEYOND = 4.0  # times the top of the band: more than any found mode's flanks reach
_TOP = 0.45  # of the sample rate: anti-alias filters reach below Nyquist


def identify(
    log: Log,
    stage: Stage | None = None,
    *,
    channels: Sequence[str] | None = None,
    band: tuple[float, float] | None = None,
) -> Modes:
    """Identify the modes of a log with their covariance.

    Parameters
    ----------
    log : Log
        Displacement (following error) and acceleration channels are used.
    stage : Stage, optional
        Says which modes to look for; without it resonances are searched for in the band.
    channels : sequence of str, optional
        Use only these channels.
    band : (float, float), optional
        Use only modes between these frequencies in Hz. Without a stage the default reaches from
        twenty periods per record to 0.45 of the sample rate.

    Returns
    -------
    Modes
        With the modes that were looked for and refused, and why.

    Raises
    ------
    BadLog
        If no channel is left, or the record is too short or too slow for the modes.
    """
    used = _choose_channels(log, channels)
    seen: list[tuple[str, float, float]] = []
    if stage is not None:
        targets = _stage_targets(stage, band)
        views = _transform(log, used, targets, band)
    else:
        views = _transform(log, used, (), band)
        targets, seen = _search(log, used, views, band)
        lines = tuple(sorted(frequency for _, frequency, _ in seen))
        views = tuple(replace(view, lines=lines) for view in views)
    best: list[BandFit] = []
    refused: list[Refusal] = []
    for cluster in _clusters(targets):
        if stage is not None:
            found = _fit_channels(log, views, cluster, targets, known=True)
        else:
            own = _territory(cluster, targets)
            found = _fit_further(log, tuple(v.band(*own) for v in views), cluster, targets)
        seen += [(fit.view.channel, *line) for fit in found.fits for line in fit.lines.tolist()]
        chosen, why = _choose(found, known=stage is not None)
        best += chosen
        refused += [Refusal(log.name, *reason, mode=name) for name, reason in why.items()]
    resolution = 1.5 / max(s.duration for view in views for s in view.spectra)
    named = name_lines(seen, log, stage, resolution)
    if stage is not None:
        return _collect(best, named, (*log.refused, *refused))
    return _renumber(_collect(_distinct(best), named, log.refused))


def _choose_channels(log: Log, names: Sequence[str] | None) -> tuple[Channel, ...]:
    usable = tuple(c for c in log.channels if c.kind in ("displacement", "acceleration"))
    if names is not None:
        unknown = set(names) - {channel.name for channel in usable}
        if unknown:
            raise BadLog(
                log.name,
                "channel",
                f"no usable channel {sorted(unknown)}; there are "
                f"{[channel.name for channel in usable]}",
            )
        usable = tuple(channel for channel in usable if channel.name in names)
    if not usable:
        raise BadLog(log.name, "no-signal", "no delta_e or acc channel is left to analyse")
    return usable


def _stage_targets(stage: Stage, band: tuple[float, float] | None) -> tuple[Target, ...]:
    low, high = band or (0.0, np.inf)
    targets = tuple(
        Target(mode.name, mode.frequency_hz, mode.damping_ratio, mode.search)
        for mode in sorted(stage.modes, key=lambda mode: mode.frequency_hz)
        if low <= mode.frequency_hz <= high
    )
    if not targets:
        raise BadStage(f"{stage.name}: no [[mode]] lies between {low:g} and {high:g} Hz")
    return targets


def _transform(
    log: Log,
    channels: tuple[Channel, ...],
    targets: tuple[Target, ...],
    band: tuple[float, float] | None,
) -> tuple[View, ...]:
    """Transform every channel, as far up as anything is looked for."""
    top = max((target.band(BAND)[1] for target in targets), default=0.0)
    if top > log.sample_rate / 2:
        raise BadLog(
            log.name,
            "sample-rate",
            f"{log.sample_rate:g} Hz cannot show modes up to {top:.0f} Hz; "
            f"needed is at least {2 * top:.0f} Hz",
        )
    widest = max((target.search for target in targets), default=0.0)
    reach = (1 + widest) * top if targets else (band or (0.0, np.inf))[1]
    # What is found without a description is fitted beyond the band as well.
    ceiling = reach if targets else _BEYOND * reach
    needed = _LEAST_PERIODS / min(reach, _TOP * log.sample_rate)
    if targets:
        needed = _LEAST_RESOLUTION / min(2 * t.damping_ratio * t.frequency for t in targets)
    segments = find_segments(log, needed)
    if not segments:
        longest = max((b - a for a, b in log.pieces), default=0) / log.sample_rate
        raise BadLog(
            log.name,
            "too-short",
            f"no stretch of constant velocity without gaps lasts {needed:.3g} s, which is needed "
            f"for what is looked for; the longest piece without gaps has {longest:.3g} s",
        )
    return tuple(
        View(
            channel.name,
            "delta_e" if channel.kind == "displacement" else "acc",
            average_spectra(channel, segments, log.sample_rate, reach, ceiling=ceiling),
        )
        for channel in channels
    )


def _search(
    log: Log,
    channels: tuple[Channel, ...],
    views: tuple[View, ...],
    band: tuple[float, float] | None,
) -> tuple[tuple[Target, ...], list[tuple[str, float, float]]]:
    """Find candidate modes, and lines in the longest segment, in the band."""
    longest = max(s.duration for view in views for s in view.spectra)
    low, high = band or (20 / longest, _TOP * log.sample_rate)
    low, high = max(low, 2 / longest), min(high, _TOP * log.sample_rate)
    held = max(0.0, (high - low) * longest)
    if held < 50:
        raise BadLog(
            log.name,
            "too-short",
            f"{longest:.3g} s at {log.sample_rate:g} Hz hold {held:.0f} Fourier frequencies from "
            f"{low:.4g} to {high:.4g} Hz; needed are at least 50",
        )
    segment = max(find_segments(log, 0.0), key=lambda s: s.stop - s.start)
    lines = [
        (channel.name, *line)
        for channel in channels
        for line in find_lines(channel, segment, log.sample_rate, (low, high)).tolist()
    ]
    frequencies = [frequency for _, frequency, _ in lines]
    return find_peaks(tuple(view.spectra for view in views), low, high, frequencies), lines


def _clusters(targets: tuple[Target, ...]) -> list[tuple[Target, ...]]:
    """Group targets whose fitting bands overlap."""
    groups: list[list[Target]] = []
    for target in targets:
        close = bool(groups) and target.band(BAND)[0] < groups[-1][-1].band(BAND)[1]
        if close and len(groups[-1]) < _MOST_TOGETHER:
            groups[-1].append(target)
        else:
            groups.append([target])
    return [tuple(group) for group in groups]


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """What the channels show of a cluster."""

    cluster: tuple[Target, ...]
    views: tuple[View, ...]
    coarse: tuple[Coarse, ...]  # of every channel
    fits: list[BandFit]  # of every channel that shows some of it
    reasons: dict[str, tuple[str, str]]  # for which a mode is missing in a channel


def _fit_channels(
    log: Log,
    views: tuple[View, ...],
    cluster: tuple[Target, ...],
    targets: tuple[Target, ...],
    *,
    known: bool,
) -> _Found:
    """Fit a cluster in every channel."""
    reach = [target.search if known else 0.0 for target in cluster]
    low = min(t.band(BAND)[0] * (1 - r) for t, r in zip(cluster, reach, strict=True))
    high = max(t.band(BAND)[1] * (1 + r) for t, r in zip(cluster, reach, strict=True))
    width = 0.5 * min(t.damping_ratio * t.frequency for t in cluster)
    high = min(high, 0.49 * log.sample_rate)
    beside = tuple(t for t in targets if t not in cluster and low / 1.3 < t.frequency < 1.3 * high)
    coarse = tuple(
        replace(coarsen(view.spectra, low, high, width), neighbours=beside) for view in views
    )
    placed = cluster
    if known:
        placed, coarse = locate(coarse, cluster)
    fits: list[BandFit] = []
    reasons: dict[str, tuple[str, str]] = {}
    for view, binned in zip(views, coarse, strict=True):
        fit, missing = fit_band(view, binned, placed)
        # The most telling reason is that of the first channel that got as far as a fit.
        for name, why in missing.items():
            if name not in reasons or reasons[name][0] == "not-excited":
                reasons[name] = why
        if fit is not None:
            fits.append(fit)
    return _Found(cluster, views, coarse, fits, reasons)


def _territory(cluster: tuple[Target, ...], targets: tuple[Target, ...]) -> tuple[float, float]:
    """Frequencies that are nearer to a cluster than to the modes beside it."""
    first, last = cluster[0].frequency, cluster[-1].frequency
    below = [t.frequency for t in targets if t.frequency < first]
    above = [t.frequency for t in targets if t.frequency > last]
    low = np.sqrt(max(below) * first) if below else 0.0
    return float(low), float(np.sqrt(last * min(above))) if above else np.inf


def _fit_further(
    log: Log, views: tuple[View, ...], cluster: tuple[Target, ...], targets: tuple[Target, ...]
) -> _Found:
    """Fit a cluster that was found, with what stands out of what its fits leave over."""
    found = _fit_channels(log, views, cluster, targets, known=False)
    for _ in range(_MOST_ROUNDS):
        more = _unexplained(found.fits, cluster)
        if len(more) == len(cluster):
            break
        cluster = more
        found = _fit_channels(log, views, cluster, targets, known=False)
    return found


def _choose(found: _Found, *, known: bool) -> tuple[list[BandFit], dict[str, tuple[str, str]]]:
    """Keep each mode from the channel that knows it best; say why the others are missing."""
    best = _best_channels(found.fits, [target.name for target in found.cluster])
    best = [_in_company(fit, best, found) for fit in best]
    reasons = found.reasons
    if known:
        best, unclear = _named(best, found.cluster)
        reasons = reasons | unclear
    seen = {target.name for fit in best for target in fit.targets}
    return best, {name: why for name, why in reasons.items() if name not in seen}


def _named(
    best: list[BandFit], cluster: tuple[Target, ...]
) -> tuple[list[BandFit], dict[str, tuple[str, str]]]:
    """Give the modes that were found the names that their frequencies speak for.

    Where fewer were found than sought, one may stand where another began. Every assignment that
    keeps the order is weighed by the prior of shifts; a mode whose name is not clear is refused.
    """
    found = sorted(
        (float(fit.estimate[i]), target.name)
        for fit in best
        for i, target in enumerate(fit.targets)
    )
    if not found or len(found) == len(cluster):
        return best, {}
    ln_f = np.array([f for f, _ in found])
    choices = list(combinations(cluster, len(found)))
    search = np.array([[target.search for target in choice] for choice in choices])
    home = np.log([[target.frequency for target in choice] for choice in choices])
    shifts = ln_f - home
    cost = np.array(
        [shift_cost(s[None], w, len(found))[0] for s, w in zip(shifts, search, strict=True)]
    )
    cost[(np.abs(shifts) > np.log1p(search)).any(axis=1)] = np.inf
    if not np.isfinite(cost).any():
        return best, {}
    weight = softmax(-cost)
    names: dict[str, str] = {}
    unclear: dict[str, tuple[str, str]] = {}
    for i, (f, name) in enumerate(found):
        chance: dict[str, float] = {}
        for choice, w in zip(choices, weight.tolist(), strict=True):
            chance[choice[i].name] = chance.get(choice[i].name, 0.0) + w
        likely = max(chance, key=lambda n: chance[n])
        if chance[likely] >= _CLEAR_NAME:
            names[name] = likely
            continue
        told = ", ".join(f"{n} {100 * p:.0f} %" for n, p in chance.items() if p > 0.01)
        detail = f"the resonance at {np.exp(f):.5g} Hz may be {told}; its neighbours were not found"
        unclear |= {n: ("ambiguous", detail) for n in chance if chance[n] > 0.01}
    kept = [fit.only([t.name for t in fit.targets if t.name in names]) for fit in best]
    renamed = [
        replace(fit, targets=tuple(replace(t, name=names[t.name]) for t in fit.targets))
        for fit in kept
    ]
    return renamed, {n: why for n, why in unclear.items() if n not in names.values()}


def _in_company(fit: BandFit, best: list[BandFit], found: _Found) -> BandFit:
    """Fit a channel again together with the modes that only other channels show.

    A mode too weak to be seen here still interferes with the ones that are, and would bias them;
    where and how damped it is, the other channels know.
    """
    own = fit.settled()
    others = [t for other in best if other is not fit for t in other.settled()]
    if not others:
        return fit
    free = tuple(replace(target, settled=None) for target in own)
    company = tuple(sorted((*free, *others), key=lambda target: target.frequency))
    binned = next(c for v, c in zip(found.views, found.coarse, strict=True) if v is fit.view)
    again, _ = fit_band(fit.view, binned, company)
    names = [target.name for target in own]
    if again is None or not set(names) <= {target.name for target in again.targets}:
        return fit
    return again.only(names)


def _best_channels(fits: list[BandFit], names: list[str]) -> list[BandFit]:
    """Keep each mode in one fit only: accelerometers before Δe, then the clearest channel."""
    choice: dict[str, int] = {}
    for name in names:
        ranked = [
            (fit.view.source != "acc", -float(fit.clarity[i]), k)
            for k, fit in enumerate(fits)
            for i, target in enumerate(fit.targets)
            if target.name == name
        ]
        if ranked:
            choice[name] = min(ranked)[2]
    return [
        fit.only(chosen)
        for k, fit in enumerate(fits)
        if (chosen := [n for n in names if choice.get(n) == k])
    ]


def _unexplained(fits: list[BandFit], cluster: tuple[Target, ...]) -> tuple[Target, ...]:
    """Add to a cluster what stands out of what its fits leave over."""
    more = list(cluster)
    # What is narrower than that would have stood out by itself, unless it is a line.
    narrowest = 0.5 * min(target.damping_ratio for target in cluster)
    for fit in fits:
        candidate = find_excess(fit.residual, narrowest)
        if candidate is None or len(more) > _MOST_TOGETHER:
            continue
        near = (abs(candidate.frequency / t.frequency - 1) < t.damping_ratio for t in more)
        if not any(near):
            more.append(replace(candidate, name=f"{more[0].name}_and_{len(more)}"))
    return tuple(sorted(more, key=lambda target: target.frequency))


def _distinct(fits: list[BandFit]) -> list[BandFit]:
    """Drop a found mode that another channel has found more clearly at the same place."""
    rows = [
        (float(fit.clarity[i]), float(fit.estimate[i]), float(np.exp(fit.estimate[m + i])), name)
        for fit in fits
        for m in [len(fit.targets)]
        for i, name in enumerate(target.name for target in fit.targets)
    ]
    kept: list[tuple[float, float, float, str]] = []
    for row in sorted(rows, reverse=True):
        # Within half a half-power bandwidth of each other no two modes can be told apart.
        if all(abs(row[1] - other[1]) > 0.5 * (row[2] + other[2]) for other in kept):
            kept.append(row)
    names = {row[3] for row in kept}
    return [fit.only([t.name for t in fit.targets if t.name in names]) for fit in fits]


def _collect(fits: list[BandFit], lines: tuple[Line, ...], refused: tuple[Refusal, ...]) -> Modes:
    sizes = [len(fit.targets) for fit in fits]
    n = sum(sizes)
    cov = np.zeros((2 * n, 2 * n))
    estimate = np.zeros(2 * n)
    at = 0
    for fit, size in zip(fits, sizes, strict=True):
        index = np.concatenate([np.arange(at, at + size), np.arange(n + at, n + at + size)])
        cov[np.ix_(index, index)] = fit.cov
        estimate[index] = fit.estimate
        at += size
    order = np.argsort(estimate[:n], kind="stable")
    both = np.concatenate([order, order + n])
    names = [target.name for fit in fits for target in fit.targets]
    views = [fit.view for fit in fits for _ in fit.targets]
    snr = np.concatenate([fit.snr for fit in fits]) if fits else np.empty(0)
    return Modes(
        names=tuple(names[i] for i in order),
        sources=tuple(views[i].source for i in order),
        channels=tuple(views[i].channel for i in order),
        ln_frequency=estimate[order],
        ln_damping=estimate[n + order],
        cov=cov[np.ix_(both, both)],
        snr=snr[order],
        lines=lines,
        refused=refused,
    )


def _renumber(modes: Modes) -> Modes:
    """Name found modes in ascending order.

    Candidates that turned out to be no modes leave no gap and no refusal: they were our own idea,
    not the user's question.
    """
    return replace(modes, names=tuple(f"mode_{n}" for n in range(1, len(modes.names) + 1)))
