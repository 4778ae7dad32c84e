"""Identification of modes: the Whittle likelihood of all channels, fitted cluster by cluster.

Channels of one log share the excitation, so that their errors are not independent: they come from
one likelihood and are not averaged as if they were.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.special import softmax

from lmshealth._arrays import FloatArray
from lmshealth.errors import BadLog
from lmshealth.io.log import Channel, Log, Refusal
from lmshealth.modal.ambient.close_modes import keep_separate
from lmshealth.modal.ambient.cluster_fit import BandFit, Missing, View, fit_band
from lmshealth.modal.ambient.initial_values import (
    coarsen,
    locate,
    shift_cost,
)
from lmshealth.modal.ambient.peak_picking import find_excess, find_peaks
from lmshealth.modal.modes import Modes
from lmshealth.modal.targets import USABLE, Target, choose_channels, choose_targets
from lmshealth.signal.segments import find_segments
from lmshealth.signal.spectra import ANY_RESONANCE, ResonanceRange, cross_spectra
from lmshealth.signal.spectral_lines import Line, find_lines, name_lines
from lmshealth.stage.constants import BAND, LEAST_RESOLUTION
from lmshealth.stage.description import Stage

# Modes whose bands touch are fitted together, but never more than this many.
_MOST_TOGETHER = 4
# Factor between the bandwidths of modes that are fitted together.
_ALIKE = 8.0
# Probability from which on a found mode is given its name.
_CLEAR_NAME = 0.8
# Without a description, so many times what a fit leaves over is searched for further modes.
_MOST_ROUNDS = 3
# Shortest useful segment: half-power bandwidth times duration; without a description, periods of
# the top of the band.
_LEAST_PERIODS = 10.0
_BEYOND = 4.0  # times the top of the band: more than any found mode's flanks reach


def identify(
    log: Log,
    stage: Stage | None = None,
    *,
    channels: Sequence[str] | None = None,
    band: tuple[float, float] | None = None,
) -> Modes:
    r"""Identify the modes of a log with their covariance.

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

    Examples
    --------
    A minute of an accelerometer on something that rings at 126.4 Hz with a damping of 1.5 % while
    white noise shakes it:

    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> import lmshealth
    >>> rng, rate, frequency, damping = np.random.default_rng(1), 1000, 126.4, 0.015
    >>> pole = np.exp(2 * np.pi * frequency / rate * (-damping + 1j * np.sqrt(1 - damping**2)))
    >>> force, noise = rng.standard_normal((2, 60 * rate))
    >>> shaken = lfilter([1, -2, 1], np.poly([pole, pole.conj()]), force) + 0.5 * noise
    >>> head = "# sample_rate_hz: 1000\nacc_roll_m_s2"
    >>> np.savetxt("log.csv", shaken, header=head, comments="")
    >>> modes = lmshealth.identify(lmshealth.read_log("log.csv"), band=(100, 160))
    >>> for f, f_std, zeta, zeta_std in zip(
    ...     modes.frequency, modes.frequency_std, modes.damping_ratio, modes.damping_ratio_std
    ... ):
    ...     print(f"{f:.1f} ± {f_std:.1f} Hz, {zeta:.1%} ± {zeta_std:.1%}")
    126.4 ± 0.1 Hz, 1.5% ± 0.1%
    """
    used = choose_channels(log, channels)
    seen: list[tuple[str, float, float]] = []
    if stage is not None:
        targets = choose_targets(stage, band)
        view = _transform(log, used, targets, band)
    else:
        view = _transform(log, used, (), band)
        targets, seen = _search(log, used, view, band)
        known = [frequency for _, frequency, _ in seen]
        view = replace(view, spectra=tuple(s.without(known) for s in view.spectra))
    seen += [(view.channels[c], f, a) for s in view.spectra for c, f, a in s.lines]
    fits: list[BandFit] = []
    refused: list[Refusal] = []
    for cluster in _clusters(targets):
        if stage is not None:
            found = _fit_cluster(log, view, cluster, targets, known=True)
        else:
            own = _territory(cluster, targets)
            found = _fit_further(log, view.band(*own), cluster, targets)
        if found.fit is not None:
            seen += [(s.channel, s.frequency, s.amplitude) for s in found.fit.lines]
            fits.append(found.fit)
        refused += found.refused
    resolution = 1.5 / max(s.duration for s in view.spectra)
    lines = name_lines(seen, log, stage, resolution)
    if stage is not None:
        return _collect(fits, view.channels, lines, (*log.refused, *refused))
    modes = _renumber(_collect(_distinct(fits), view.channels, lines, log.refused))
    if modes.names:
        return modes
    return replace(modes, refused=(*log.refused, _nothing(log, lines, refused)))


def _nothing(log: Log, lines: tuple[Line, ...], refused: list[Refusal]) -> Refusal:
    """Say that nothing was found where nothing was sought by name."""
    if refused:
        first = refused[0]
        places = "1 place" if len(refused) == 1 else f"{len(refused)} places"
        told = f"what stands out of the noise at {places} makes no mode"
        return Refusal(log.name, first.reason, f"{told}: {first.detail}")
    told = f"{len(lines)} lines, which are no modes" if lines else "no line either"
    return Refusal(
        log.name,
        "not-excited",
        f"no resonance stands out of the noise in any channel; {told}: excite the machine, record "
        "longer, or look in another band",
    )


def _transform(
    log: Log,
    channels: tuple[Channel, ...],
    targets: tuple[Target, ...],
    band: tuple[float, float] | None,
) -> View:
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
    needed = _LEAST_PERIODS / min(reach, USABLE * log.sample_rate)
    if targets:
        needed = LEAST_RESOLUTION / min(2 * t.damping_ratio * t.frequency for t in targets)
    segments = find_segments(log, needed)
    if not segments:
        longest = max((b - a for a, b in log.pieces), default=0) / log.sample_rate
        raise BadLog(
            log.name,
            "too-short",
            f"no stretch of constant velocity without gaps lasts {needed:.3g} s, which is needed "
            f"for what is looked for; the longest piece without gaps has {longest:.3g} s",
        )
    return View(
        tuple(channel.name for channel in channels),
        tuple("delta_e" if c.kind == "displacement" else "acc" for c in channels),
        cross_spectra(
            channels,
            segments,
            log.sample_rate,
            reach,
            ceiling=ceiling,
            resonances=tuple(_expected(target) for target in targets) or ANY_RESONANCE,
        ),
    )


def _expected(target: Target) -> ResonanceRange:
    """Say where a mode may stand; its damping may be half of what is known of it."""
    low, high = target.band(1.0)
    low, high = low * (1 - target.search), high * (1 + target.search)
    return ResonanceRange(low, high, target.damping_ratio / 2)


def _search(
    log: Log,
    channels: tuple[Channel, ...],
    view: View,
    band: tuple[float, float] | None,
) -> tuple[tuple[Target, ...], list[tuple[str, float, float]]]:
    """Find candidate modes, and lines in the longest segment, in the band."""
    longest = max(s.duration for s in view.spectra)
    low, high = band or (20 / longest, USABLE * log.sample_rate)
    low, high = max(low, 2 / longest), min(high, USABLE * log.sample_rate)
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
    spectra = tuple(view.single(c) for c in range(len(channels)))
    return find_peaks(spectra, low, high, [frequency for _, frequency, _ in lines]), lines


def _clusters(targets: tuple[Target, ...]) -> list[tuple[Target, ...]]:
    """Group neighbouring targets that belong together."""
    groups: list[list[Target]] = []
    for target in targets:
        last = groups[-1] if groups else []
        if last and len(last) < _MOST_TOGETHER and _belong_together(last[-1], target):
            last.append(target)
        else:
            groups.append([target])
    return [tuple(group) for group in groups]


def _belong_together(lower: Target, upper: Target) -> bool:
    """Tell whether the bands of two targets overlap and their bandwidths are alike."""
    # Beside a broad resonance a narrow one is a line's business: it would ask for the finest
    # resolution over all of the band.
    ratio = (upper.frequency * upper.damping_ratio) / (lower.frequency * lower.damping_ratio)
    return upper.band(BAND)[0] < lower.band(BAND)[1] and 1 / _ALIKE < ratio < _ALIKE


@dataclass(frozen=True, slots=True, eq=False)
class _ClusterResult:
    fit: BandFit | None
    refused: list[Refusal]


def _fit_cluster(
    log: Log,
    view: View,
    cluster: tuple[Target, ...],
    targets: tuple[Target, ...],
    *,
    known: bool,
) -> _ClusterResult:
    """Fit a cluster to all channels together."""
    reach = [target.search if known else 0.0 for target in cluster]
    low = min(t.band(BAND)[0] * (1 - r) for t, r in zip(cluster, reach, strict=True))
    high = max(t.band(BAND)[1] * (1 + r) for t, r in zip(cluster, reach, strict=True))
    width = 0.5 * min(t.damping_ratio * t.frequency for t in cluster)
    high = min(high, 0.49 * log.sample_rate)
    beside = tuple(t for t in targets if t not in cluster and low / 1.3 < t.frequency < 1.3 * high)
    coarse = tuple(
        replace(coarsen(view.single(c), low, high, width), neighbours=beside)
        for c in range(len(view.channels))
    )
    placed = cluster
    if known:
        placed, coarse = locate(coarse, cluster)
    fit, reasons = fit_band(view, coarse, placed)
    if known and fit is not None:
        fit, unclear = _named(fit, cluster)
        reasons = reasons | unclear
    if fit is not None:
        fit, close = keep_separate(fit, known=known)
        reasons = reasons | close
    seen = set() if fit is None else {target.name for target in fit.targets}
    refused = [
        Refusal(log=log.name, mode=name, reason=reason, detail=detail)
        for name, (reason, detail) in reasons.items()
        if name not in seen
    ]
    return _ClusterResult(fit, refused)


def _territory(cluster: tuple[Target, ...], targets: tuple[Target, ...]) -> tuple[float, float]:
    """Frequencies that are nearer to a cluster than to the modes beside it."""
    first, last = cluster[0].frequency, cluster[-1].frequency
    below = [t.frequency for t in targets if t.frequency < first]
    above = [t.frequency for t in targets if t.frequency > last]
    low = np.sqrt(max(below) * first) if below else 0.0
    return float(low), float(np.sqrt(last * min(above))) if above else np.inf


def _fit_further(
    log: Log, view: View, cluster: tuple[Target, ...], targets: tuple[Target, ...]
) -> _ClusterResult:
    """Fit a cluster that was found, with what stands out of what its fit leaves over."""
    found = _fit_cluster(log, view, cluster, targets, known=False)
    for _ in range(_MOST_ROUNDS):
        more = cluster if found.fit is None else _unexplained(found.fit, cluster)
        if len(more) == len(cluster):
            break
        cluster = more
        found = _fit_cluster(log, view, cluster, targets, known=False)
    return found


def _named(fit: BandFit, cluster: tuple[Target, ...]) -> tuple[BandFit, Missing]:
    """Give the modes that were found the names that their frequencies speak for.

    Where fewer were found than sought, one may stand where another began. Every assignment that
    keeps the order is weighed by the prior of shifts; a mode whose name is not clear is refused.
    """
    found = sorted((float(fit.estimate[i]), t.name) for i, t in enumerate(fit.targets))
    if not found:
        return fit, {}
    if len(found) == len(cluster):
        # All are there, and in order: at which target each began does not matter.
        names = {name: t.name for (_, name), t in zip(found, cluster, strict=True)}
        return _renamed(fit, names), {}
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
        return fit, {}
    weight = softmax(-cost)
    names = {}
    unclear: Missing = {}
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
    kept = fit.only([t.name for t in fit.targets if t.name in names])
    return _renamed(kept, names), {n: w for n, w in unclear.items() if n not in names.values()}


def _renamed(fit: BandFit, names: dict[str, str]) -> BandFit:
    return replace(fit, targets=tuple(replace(t, name=names[t.name]) for t in fit.targets))


def _unexplained(fit: BandFit, cluster: tuple[Target, ...]) -> tuple[Target, ...]:
    """Add to a cluster what stands out of what its fit leaves over."""
    # What is narrower than that would have stood out by itself, unless it is a line.
    narrowest = 0.5 * min(target.damping_ratio for target in cluster)
    candidate = find_excess(fit.residual, narrowest)
    if candidate is None or len(cluster) > _MOST_TOGETHER:
        return cluster
    if any(abs(candidate.frequency / t.frequency - 1) < t.damping_ratio for t in cluster):
        return cluster
    more = replace(candidate, name=f"{cluster[0].name}_and_{len(cluster)}")
    return tuple(sorted((*cluster, more), key=lambda target: target.frequency))


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


def _collect(
    fits: list[BandFit],
    channels: tuple[str, ...],
    lines: tuple[Line, ...],
    refused: tuple[Refusal, ...],
) -> Modes:
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
    sources = [fit.view.source for fit in fits for _ in fit.targets]
    best = [name for fit in fits for name in fit.best]
    snr, dispersion = (
        np.concatenate([np.empty(0), *(getattr(fit, name) for fit in fits)])
        for name in ("snr", "dispersion")
    )
    flags = [flag for fit in fits for flag in fit.flags]
    nothing = np.empty((0, len(channels)))
    shapes = np.concatenate([nothing, *(_shapes(fit, channels) for fit in fits)])
    return Modes(
        names=tuple(names[i] for i in order),
        sources=tuple(sources[i] for i in order),
        channels=tuple(best[i] for i in order),
        ln_frequency=estimate[order],
        ln_damping=estimate[n + order],
        cov=cov[np.ix_(both, both)],
        snr=snr[order],
        dispersion=dispersion[order],
        flags=tuple(flags[i] for i in order),
        shape_channels=channels,
        shapes=shapes[order],
        lines=lines,
        refused=refused,
    )


def _shapes(fit: BandFit, channels: tuple[str, ...]) -> FloatArray:
    """Give shapes in units of acceleration, NaN in the channels that the fit left out."""
    own = (fit.unit[:, None] * fit.shapes).T
    own = own / np.linalg.norm(own, axis=1, keepdims=True)
    largest = np.take_along_axis(own, np.abs(own).argmax(axis=1, keepdims=True), axis=1)
    shapes = np.full((len(own), len(channels)), np.nan)
    shapes[:, [channels.index(name) for name in fit.view.channels]] = own * np.sign(largest)
    return shapes


def _renumber(modes: Modes) -> Modes:
    """Name found modes in ascending order.

    Candidates that turned out to be no modes leave no gap and no refusal: they were our own idea,
    not the user's question.
    """
    return replace(modes, names=tuple(f"mode_{n}" for n in range(1, len(modes.names) + 1)))
