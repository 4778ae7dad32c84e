"""Identification of modes under ambient excitation, with and without a stage description.

Channels of one log share the excitation, so that their errors are dependent: one Whittle
likelihood holds all channels, fitted cluster by cluster (`fit_cluster`). The two drivers differ in
where the start values come from, how modes are named and what happens to modes that are too close.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np

from lmshealth.errors import BadLog
from lmshealth.io.log import Channel, Log, Refusal
from lmshealth.modal import constants
from lmshealth.modal.ambient.cluster_fit import (
    bin_cluster,
    fit_cluster,
    fit_modes,
    locate,
    needed_ordinates,
    shows_more,
)
from lmshealth.modal.ambient.cluster_modes import (
    ClusterFit,
    FittedSpectrum,
    drop_duplicates,
    merge_close_modes,
    refuse_close_modes,
)
from lmshealth.modal.ambient.search import Found, halves, neighbourhood, search, split_groups
from lmshealth.modal.ambient.wandering import near_lines
from lmshealth.modal.modes import Modes, Rejection, merge, numbered
from lmshealth.modal.naming import assign, likeness, name_together
from lmshealth.modal.targets import (
    Target,
    check_band,
    choose_targets,
    clusters,
    limit_channels,
)
from lmshealth.signal.segments import Segment, find_phases, stationary, with_few_lengths
from lmshealth.signal.spectra import (
    ANY_RESONANCE,
    LogSpectra,
    ResonanceRange,
    cross_spectra,
)
from lmshealth.signal.spectral_lines import Line, find_lines, name_lines
from lmshealth.stage.constants import BAND_HALF_WIDTH, LEAST_RESOLUTION
from lmshealth.stage.description import Stage

# Without a description spectra reach up to this multiple of the band: further than flanks do.
_CEILING = 4.0
# Without a description fits reach so many damping ratios from the outer modes: floors of real
# machines are not simple.
_REACH = 6.0
# A band whose ends have a larger ratio than the first is searched in parts up to the second, as no
# simple floors hold over it; each is searched up to the third ratio beyond its ends, and the edges
# are shifted up to the fourth where no mode is.
_WIDE, _PART, _BEYOND, _SHIFT = 30.0, 4.0, 1.15, 1.07
_UNLIKE = (
    "from {:.4g} to {:.4g} Hz no modes in common with the other channels explain it, which are "
    "used without it: check whether it was recorded at the same time, or identify it by itself"
)
# A cluster is fitted below this share of the sample rate.
_TOP = 0.49


@dataclass(frozen=True, slots=True, eq=False)
class AmbientReading:
    """Modes of a log, and what they were identified from."""

    modes: Modes
    spectra: LogSpectra  # without the sinusoids that were subtracted
    fitted: tuple[FittedSpectrum, ...] = ()  # of each cluster, ascending in frequency
    # Everything that was rejected; without a description modes.refused does not list it.
    rejected: tuple[Refusal, ...] = ()
    sought: tuple[Found, ...] = ()  # of the search without a description, parts of the band


def identify(
    log: Log,
    stage: Stage | None = None,
    *,
    channels: Sequence[str] | None = None,
    band: tuple[float, float] | None = None,
) -> Modes:
    r"""Identify the modes of a log under ambient excitation, with their covariance.

    Parameters
    ----------
    log : Log
        Displacement (following error) and acceleration channels are used.
    stage : Stage, optional
        Modes to identify; without it resonances are searched for in the band.
    channels : sequence of str, optional
        Use only these channels.
    band : (float, float), optional
        Use only modes between these frequencies in Hz. Without a stage the default is from twenty
        periods per record to 0.45 of the sample rate.

    Returns
    -------
    Modes
        With the modes that are refused, and why.

    Raises
    ------
    BadLog
        If no channel is left, or the record is too short or its sample rate too low.
    BadStage
        If the stage has no mode in the band.

    Examples
    --------
    A minute of an accelerometer on a mode of 126.4 Hz with a damping of 1.5 % under white noise:

    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> import lmshealth
    >>> rng, rate, frequency, damping = np.random.default_rng(3), 1000, 126.4, 0.015
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
    126.3 ± 0.1 Hz, 1.6% ± 0.1%
    """
    return read_ambient(log, stage, channels=channels, band=band).modes


def read_ambient(
    log: Log,
    stage: Stage | None = None,
    *,
    channels: Sequence[str] | None = None,
    band: tuple[float, float] | None = None,
    progress: Callable[[str, int, int], None] = lambda step, done, total: None,
) -> AmbientReading:
    """Identify modes as `identify` does; return them with the spectra and their fit."""
    check_band(log, band)
    log = limit_channels(log, channels)
    used = log.channels
    targets, short = () if stage is None else choose_targets(stage, band), list[Refusal]()
    while True:
        try:
            stretches, whole = _transform(log, used, targets, band)
            break
        except BadLog as error:
            targets, refusal = _without_narrowest(targets, error)
            short.append(refusal)
    tested: list[tuple[str, float, float]] = []
    sought: tuple[Found, ...] = ()
    if stage is None:
        explore = partial(_explore, log, used, stretches, whole, band, progress)
        sought, tested, fits = explore()
        if suspected := _lines_at_modes(fits):
            sought, tested, fits = explore(suspected)
    else:
        fits, known, more = _fit_described(whole, targets, _TOP * log.sample_rate)
    refused = [*short, *(refusal for fit in fits for refusal in fit.refusals(log.name))]
    left_out = [
        Refusal(log.name, "unlike-others", _UNLIKE.format(*part.band), channel=name)
        for part in sought
        for name in part.left_out
    ]
    rejected, found = refused, [fit.modes for fit in fits if fit.modes is not None]
    fitted = tuple(one.fitted for one in found)
    masked = [line for one in found for line in one.lines]
    seen = [*tested, *whole.removed_lines, *masked]
    lines = name_lines(seen, [s.velocity for s in stretches], stage, 1.5 / whole.duration)
    lines += tuple(
        Line(h.frequency, h.amplitude, "m/s²", "wandering", part.spectra.channels[h.channel])
        for part in sought
        for h in part.harmonics
    )
    if stage is None:
        found = drop_duplicates(found)
        anything = any(one.names for one in found)
        refused = left_out if anything else [*left_out, _nothing_found(log, lines, refused)]
    used_ones = {name for part in sought for name in part.spectra.channels}
    shown = tuple(name for name in whole.channels if stage is not None or name in used_ones)
    modes = merge([one.modes for one in found], lines, (*log.refused, *refused), shown)
    modes = numbered(modes) if stage is None else modes
    reading = AmbientReading(modes, whole, fitted, tuple(rejected), sought)
    widths = [2 * target.damping_ratio * target.frequency for target in targets]
    if stage is None or not more or whole.duration * min(widths) < constants.SEARCHABLE:
        return reading
    return _with_undescribed(log, reading, known, targets)


def _without_narrowest(
    targets: tuple[Target, ...], error: BadLog
) -> tuple[tuple[Target, ...], Refusal]:
    """Refuse the mode for which a log is too short: it must not refuse the others.

    Raises what was raised for the log if no other mode is left, or for another reason.
    """
    if error.reason != "too-short" or len(targets) < 2:
        raise error
    least = min(targets, key=lambda target: target.damping_ratio * target.frequency)
    named = Refusal(error.log, error.reason, error.detail, mode=least.name)
    others = tuple(target for target in targets if target is not least)
    return others, replace(named, frequency=least.frequency)


def _with_undescribed(
    log: Log, described: AmbientReading, known: Sequence[Target], targets: tuple[Target, ...]
) -> AmbientReading:
    """Search for all resonances near described modes, and name them together."""
    bands = [(*target.band(BAND_HALF_WIDTH), target.search) for target in targets]
    low = min(low * (1 - search) for low, _, search in bands)
    high = max(high * (1 + search) for _, high, search in bands)
    try:
        found = read_ambient(log, band=(low, min(high, _TOP * log.sample_rate)))
    except BadLog:  # too short for a search
        return described
    named = name_together(found.modes, described.modes, known, targets, log.name)
    if named is described.modes:
        return described
    return replace(found, modes=named, rejected=named.refused)


def _transform(
    log: Log,
    channels: tuple[Channel, ...],
    targets: tuple[Target, ...],
    band: tuple[float, float] | None,
) -> tuple[tuple[Segment, ...], LogSpectra]:
    """Return the stationary segments, and spectra of those long enough for the targets or band."""
    resonances: Sequence[ResonanceRange] = ANY_RESONANCE
    highest, rate = 0.0, log.sample_rate
    if targets:
        highest = max(target.band(BAND_HALF_WIDTH)[1] for target in targets)
        reach = ceiling = (1 + max(target.search for target in targets)) * highest
        shortest = LEAST_RESOLUTION / min(2 * t.damping_ratio * t.frequency for t in targets)
        # The damping may be half of the described one.
        resonances = [
            ResonanceRange(low * (1 - t.search), high * (1 + t.search), t.damping_ratio / 2)
            for t, (low, high) in ((target, target.band(1.0)) for target in targets)
        ]
    else:
        reach = band[1] if band else np.inf
        ceiling = _CEILING * reach
        shortest = constants.SEGMENT_PERIODS / min(reach, constants.USABLE * rate)
    phases = find_phases(log)
    segments = stationary(phases, round(shortest * rate))
    if highest > rate / 2:
        raise BadLog(
            log.name,
            "sample-rate",
            f"{rate:g} Hz cannot show modes up to {highest:.0f} Hz; "
            f"needed is at least {2 * highest:.0f} Hz",
        )
    if not segments:
        longest = max((b - a for a, b in log.pieces), default=0) / rate
        raise BadLog(
            log.name,
            "too-short",
            f"no segment of constant velocity without gaps lasts {shortest:.3g} s, which the modes "
            f"need; the longest piece without gaps has {longest:.3g} s",
        )
    spectra = LogSpectra(
        tuple(channel.name for channel in channels),
        tuple("delta_e" if c.kind == "displacement" else "acc" for c in channels),
        cross_spectra(
            channels,
            with_few_lengths(segments),
            rate,
            reach,
            ceiling=ceiling,
            resonances=resonances,
        ),
    )
    return stationary(phases, 0), spectra if targets else _resolved(spectra)


def _resolved(spectra: LogSpectra) -> LogSpectra:
    """Leave out of short segments the ordinates of few periods.

    A segment that is long enough for the top of a wide band shows only trend and leakage below.
    """
    least = constants.SEGMENT_PERIODS
    cut = (
        s if s.duration > spectra.duration / 2 else s.band(least / s.duration, np.inf)
        for s in spectra.spectra
    )
    return replace(spectra, spectra=tuple(s for s in cut if s.frequency.size))


def _lines_at_modes(fits: Sequence[ClusterFit]) -> list[float]:
    """Return the lines in Hz that fits masked at a resonance: it may be a harmonic that wanders."""
    suspected: list[float] = []
    for fit in fits:
        if fit.modes is not None and fit.modes.lines:
            lines, modes = [line.frequency for line in fit.modes.lines], fit.modes.modes
            if near_lines(modes.frequency, modes.damping_ratio, lines).any():
                suspected += lines
    return suspected


def _explore(
    log: Log,
    used: tuple[Channel, ...],
    stretches: Sequence[Segment],
    whole: LogSpectra,
    band: tuple[float, float] | None,
    progress: Callable[[str, int, int], None],
    suspected: Sequence[float] = (),
) -> tuple[tuple[Found, ...], list[tuple[str, float, float]], list[ClusterFit]]:
    """Search a band for modes and fit them; return both, and the lines of Thomson's test."""
    sought, tested = _search(log, used, stretches, whole, band, progress, suspected)
    groups: dict[tuple[Target, ...], tuple[Found, tuple[Target, ...]]] = {}
    for part in sought:
        for group in split_groups(part.modes):
            near = neighbourhood(group, part.modes)
            groups[near] = part, (*groups.get(near, (part, ()))[1], *group)
    fits: list[ClusterFit] = []
    for k, (near, (part, group)) in enumerate(groups.items()):
        progress("fitting", k, len(groups))
        fits += _fit_group(part, group, near, _TOP * log.sample_rate)
    progress("fitting", len(groups), len(groups))
    return sought, tested, fits


def _search(
    log: Log,
    channels: tuple[Channel, ...],
    stretches: Sequence[Segment],
    spectra: LogSpectra,
    band: tuple[float, float] | None,
    progress: Callable[[str, int, int], None],
    suspected: Sequence[float],
) -> tuple[tuple[Found, ...], list[tuple[str, float, float]]]:
    """Search the parts of the band for modes, and the band for the lines of Thomson's test."""
    duration, usable = spectra.duration, constants.USABLE * log.sample_rate
    low, high = band or (20 / duration, usable)
    low, high = max(low, 2 / duration), min(high, usable)
    n = max(0.0, (high - low) * duration)
    if n < constants.LEAST_FREQUENCIES:
        raise BadLog(
            log.name,
            "too-short",
            f"{duration:.3g} s at {log.sample_rate:g} Hz hold {n:.0f} Fourier frequencies from "
            f"{low:.4g} to {high:.4g} Hz; needed are at least {constants.LEAST_FREQUENCIES}",
        )
    longest = max(stretches, key=lambda s: s.stop - s.start)
    tested = [
        (channel.name, *line)
        for channel in channels
        for line in find_lines(channel, (longest,), log.sample_rate, (low, high)).tolist()
    ]
    frequencies = [frequency for _, frequency, _ in tested]
    cut = spectra.each(lambda spectrum: spectrum.without(frequencies))
    edges = _edges(low, high, 20 / duration)
    parts: list[Found] = []
    for k, (first, last) in enumerate(pairwise(edges)):
        progress("searching", k, len(edges) - 1)
        ends = max(low, first / _BEYOND), min(high, last * _BEYOND)
        part = search(cut, *ends, frequencies, suspected)
        number = 1 + sum(len(one.modes) for one in parts)
        modes = [replace(t, name=f"mode_{i}") for i, t in enumerate(part.modes, number)]
        if parts:
            first = _between((*parts[-1].modes, *modes), first)
            parts[-1] = replace(parts[-1], band=(parts[-1].band[0], first))
        parts.append(replace(part, band=(first, last), modes=tuple(modes)))
    progress("searching", len(edges) - 1, len(edges) - 1)
    return tuple(parts), tested


def _edges(low: float, high: float, least: float) -> list[float]:
    """Return the edges of the parts in which a band is searched."""
    if high <= _WIDE * low:
        return [low, high]
    start = min(max(low, least), high / _PART)
    inner = np.geomspace(start, high, int(np.ceil(np.log(high / start) / np.log(_PART))) + 1)
    return [low, *inner[1:].tolist()]


def _between(modes: Sequence[Target], edge: float) -> float:
    """Return a frequency near an edge between parts, as far as possible from the modes of both."""
    near = np.geomspace(edge / _SHIFT, edge * _SHIFT, 41)
    f = np.array([mode.frequency for mode in modes])
    distance = np.abs(np.log(f / near[:, None])).min(axis=1, initial=_BEYOND)
    return float(near[distance.argmax()]) if f.size else edge


def _fit_described(
    spectra: LogSpectra, targets: tuple[Target, ...], top: float
) -> tuple[list[ClusterFit], list[Target], bool]:
    """Locate, fit and name described modes.

    Returns the fits, their resonances, and whether the spectra show more near the targets, or one
    resonance is so wide that it may stand for two.
    """
    searched, fits, known, wide = [], [], [], False
    damping = {target.name: target.damping_ratio for target in targets}
    for cluster in clusters(targets):
        binned = bin_cluster(spectra, cluster, targets, top, searched=True)
        around, located = locate(binned, cluster)
        fit = fit_cluster(spectra, around, located)
        searched.append(binned)
        fits.append(_named(fit, cluster))
        if fit.modes is not None:
            modes = fit.modes.modes
            values = np.stack([modes.frequency, modes.damping_ratio], axis=1).tolist()
            known += [Target("", f, zeta, 0.0) for f, zeta in values]
            ratio = modes.damping_ratio / [damping[name] for name in modes.names]
            wide |= bool((ratio > constants.WIDE).any())
    return fits, known, wide or any(shows_more(binned, known, targets) for binned in searched)


def _named(fit: ClusterFit, cluster: tuple[Target, ...]) -> ClusterFit:
    """Name the resonances of a cluster, and reject close modes."""
    found = fit.modes
    if found is not None and found.names:
        # A mode may have started at the frequency of another.
        ln_f = found.modes.ln_frequency
        order = sorted(range(ln_f.size), key=lambda i: (ln_f[i], found.names[i]))
        shapes = likeness(found.modes.select(order), cluster)
        in_order = np.exp(ln_f[order]).tolist()
        assigned, ambiguous = assign(in_order, cluster, shapes=shapes, complete=True)
        names = {found.names[i]: name for i, name in zip(order, assigned, strict=True) if name}
        # Without either no assignment keeps the order within the searches.
        if names or ambiguous:
            fit = ClusterFit(found.rename(names), fit.rejected | ambiguous)
    return refuse_close_modes(fit)


def _fit_group(
    found: Found, group: tuple[Target, ...], near: tuple[Target, ...], top: float
) -> list[ClusterFit]:
    """Fit a group with its neighbours, which are not published.

    Where that does not converge the group is fitted alone, and then in parts.
    """
    targets = found.modes
    own = {t.name for t in group if found.within(t.frequency)}
    if not own:  # nothing to publish: they explain what reaches into the band, or left the spectra
        return []
    first, last = targets.index(near[0]), targets.index(near[-1])
    low, high = 0.0, top
    if first:
        low = (targets[first - 1].frequency * near[0].frequency) ** 0.5
    if last + 1 < len(targets):
        high = (targets[last + 1].frequency * near[-1].frequency) ** 0.5
    # At least twice the ordinates that the fit needs.
    least = needed_ordinates(len(near)) / found.spectra.duration
    reach = [max(_REACH * t.damping_ratio * t.frequency, least) for t in near]
    low = max(low, min(t.frequency - width for t, width in zip(near, reach, strict=True)))
    high = min(high, max(t.frequency + width for t, width in zip(near, reach, strict=True)))
    binned = bin_cluster(found.spectra, near, targets, top, searched=False)
    fit = fit_modes(found.around(near, low, high), binned, near, (low, high))
    if fit.modes is None and len(near) > 1:
        parts = [group] if near != group else halves(group)
        return [fit for part in parts for fit in _fit_group(found, part, part, top)]
    rejected = {name: why for name, why in fit.rejected.items() if name in own}
    if fit.modes is None:
        return [ClusterFit(None, rejected)]
    modes = merge_close_modes(fit.modes)
    published = []
    rows = zip(modes.names, modes.modes.frequency.tolist(), modes.modes.dispersion, strict=True)
    for name, f, dispersion in rows:
        # A mode may move out of the band, to explain what reaches into it.
        if name not in own or not found.within(f):
            continue
        harmonic = any(h.low <= f <= h.high for h in found.harmonics)
        if harmonic and dispersion > constants.LOOSE_FIT:
            detail = f"{f:.5g} Hz is not as steady as noise, and in the band of a line that wanders"
            rejected[name] = Rejection("line-not-mode", detail, f)
        else:
            published.append(name)
    return [ClusterFit(modes.keep(published), rejected)]


def _nothing_found(log: Log, lines: tuple[Line, ...], rejected: list[Refusal]) -> Refusal:
    """Return the refusal of a log without modes."""
    if rejected:
        places = "1 peak" if len(rejected) == 1 else f"{len(rejected)} peaks"
        detail = f"{places} above the noise, of which none is a mode: {rejected[0].detail}"
        return Refusal(log.name, rejected[0].reason, detail)
    shown = f"{len(lines)} lines, which are no modes" if lines else "no line either"
    return Refusal(
        log.name,
        "not-excited",
        f"no resonance above the noise in any channel; {shown}: excite the machine, record "
        "longer, or choose another band",
    )
