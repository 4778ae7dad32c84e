"""Identification of the modes of a log, with and without a stage description.

A log with a measured excitation is identified from its response, any other from its stationary
segments, and one that only moves and stops from its free decays.

Under ambient excitation lines are masked, a search of all channels finds what resonates, groups of
resonances are fitted by one Whittle likelihood of all channels, as channels of one log share the
excitation, and what is credible is published. A description gives hints to the search, and names to
what was found.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, pairwise
from typing import Any

import numpy as np

from lmshealth._private.arrays import one_thread
from lmshealth.errors import BadLog
from lmshealth.io.log import Channel, Log, Refusal
from lmshealth.modal import constants
from lmshealth.modal.ambient.cluster_fit import fit_modes, needed_ordinates
from lmshealth.modal.ambient.cluster_modes import (
    ClusterFit,
    FittedSpectrum,
    drop_duplicates,
    join_surplus,
    separate,
)
from lmshealth.modal.ambient.search import (
    Found,
    halves,
    neighbourhood,
    search,
    similar,
    split_groups,
)
from lmshealth.modal.ambient.wandering import is_random, near_lines
from lmshealth.modal.deterministic.free_decays import identify_decays
from lmshealth.modal.deterministic.frequency_response import read_frf
from lmshealth.modal.modes import Modes, Rejection, merge, numbered
from lmshealth.modal.naming import is_near_light, name_resonances
from lmshealth.modal.targets import (
    Target,
    check_band,
    choose_channels,
    choose_targets,
)
from lmshealth.signal.segments import (
    Segment,
    find_phases,
    select_segments,
    stationary,
    with_few_lengths,
)
from lmshealth.signal.spectra import (
    ANY_RESONANCE,
    CrossSpectrum,
    LogSpectra,
    ResonanceRange,
    cross_spectra,
)
from lmshealth.signal.spectral_lines import Line, find_lines, name_lines
from lmshealth.stage.constants import BAND_HALF_WIDTH, LEAST_RESOLUTION
from lmshealth.stage.description import Stage, expect_stage

# Spectra reach up to this multiple of the band: further than flanks do.
_CEILING = 4.0
# A fit reaches as far from its outer modes as they stand above the noise, in damping ratios within
# these limits: less costs information about floors, bends and static responses, up to half of the
# whole, and further away the floors of real machines are not as simple as the likelihood assumes.
_LEAST_REACH, _MOST_REACH = 6.0, 16.0
# Factor beyond the ends of the band that was searched to which a fit may reach.
_OUTSIDE = 1.25
# A band whose ends have a larger ratio than the first is searched in parts up to the second, as no
# simple floors hold over it; each is searched up to the third ratio beyond its ends, and the edges
# are shifted up to the fourth where no mode is.
_WIDE, _PART, _BEYOND, _SHIFT = 30.0, 4.0, 1.15, 1.07
_UNLIKE = (
    "from {:.4g} to {:.4g} Hz no modes in common with the other channels explain it, which are "
    "used without it: check whether it was recorded at the same time, or identify it by itself"
)
# A range from which no line is subtracted.
_EVERYWHERE = [ResonanceRange(0.0, np.inf, 0.0)]
# A cluster is fitted below this share of the sample rate.
_TOP = 0.49
# Channels of a current whose names begin so hold an excitation: any other is that of the servo,
# which responds to the modes itself.
_EXCITATIONS = ("current_force", "current_excitation")


@dataclass(frozen=True, slots=True, eq=False)
class ModalReading:
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
    r"""Identify the modes of a log by the method for what it carries, with their covariance.

    A channel ``current_force…`` or ``current_excitation…`` holds a measured excitation: blows of a
    hammer, a sweep, a multisine or noise. Then the frequency responses of all channels to it are
    fitted, and each mode is that of the channel that shows it best. Otherwise the segments of
    constant velocity, or all of a log at rest, are identified under ambient excitation; where none
    is long enough, the free decays after the moves of the set point are.

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
        If the stage has no mode in the band, or is no result of `load_stage`.

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
    126.3 ± 0.2 Hz, 1.6% ± 0.1%
    """
    if stage is not None:
        expect_stage(stage)
    return read_modes(log, stage, channels=channels, band=band).modes


@one_thread
def read_modes(
    log: Log,
    stage: Stage | None = None,
    *,
    channels: Sequence[str] | None = None,
    band: tuple[float, float] | None = None,
    progress: Callable[[str, int, int], None] = lambda step, done, total: None,
) -> ModalReading:
    """Identify modes as `identify` does; return them with what they were identified from.

    Where the excitation was measured but cannot be used, the modes are refused for it, and are
    those of ambient excitation. `BadLog` and `BadStage` as `identify`.
    """
    chosen: Any = {"channels": channels, "band": band}
    forces = [c for c in log.channels if c.kind == "current" and c.name.startswith(_EXCITATIONS)]
    for k, source in enumerate(forces):
        detail = f"the response to {source.name} is identified; excite by one at a time"
        others = [
            Refusal(log.name, "surplus", detail, channel=other.name, source="frf")
            for other in forces[k + 1 :]
        ]
        try:
            alone = replace(log, refused=(*log.refused, *others))
            return _read_response(alone, source, stage, **chosen)
        except BadLog as why:
            if why.reason != "coherence":  # of an excitation that was at rest nothing is to be read
                place: Any = {"channel": source.name, "source": "frf"}
                unused = Refusal(log.name, why.reason, why.detail, **place)
                log = replace(log, refused=(*log.refused, unused))
    try:
        return read_ambient(log, stage, **chosen, progress=progress)
    except BadLog as why:
        if why.reason != "too-short":
            raise
        stops: Sequence[Segment] = ()
        with suppress(BadLog):  # stops are found by the set point, which may be missing
            stops = select_segments(log, "settling")
        if not stops:
            raise
        try:
            reading = read_decays(log, stage, **chosen)
            if reading.modes.names:
                return reading
            refused = [row.detail for row in reading.modes.refused if row.mode]
            decays = "; ".join(refused) or "no mode was found"
        except BadLog as error:
            decays = error.detail
        detail = f"{why.detail}; of its decays after stops: {decays}"
        raise BadLog(log.name, why.reason, detail) from None


def read_decays(
    log: Log,
    stage: Stage | None = None,
    *,
    channels: Sequence[str] | None = None,
    band: tuple[float, float] | None = None,
) -> ModalReading:
    """Identify modes as `identify_decays` does; return them with the spectra of the decays."""
    modes = identify_decays(log, stage, channels=channels, band=band)
    used = choose_channels(log, channels)
    segments, top = select_segments(log, "settling"), _TOP * log.sample_rate
    return ModalReading(modes, _spectra(used, segments, log.sample_rate, top, top, _EVERYWHERE))


def _spectra(
    channels: tuple[Channel, ...],
    segments: Sequence[Segment],
    sample_rate: float,
    top: float,
    ceiling: float,
    resonances: Sequence[ResonanceRange],
) -> LogSpectra:
    """Return the spectra of channels; arguments as in `cross_spectra`."""
    return LogSpectra(
        tuple(channel.name for channel in channels),
        tuple("delta_e" if c.kind == "displacement" else "acc" for c in channels),
        cross_spectra(channels, segments, sample_rate, top, ceiling=ceiling, resonances=resonances),
    )


def _read_response(
    log: Log,
    source: Channel,
    stage: Stage | None,
    *,
    channels: Sequence[str] | None,
    band: tuple[float, float] | None,
) -> ModalReading:
    """Identify the modes of the responses of all channels to an excitation.

    `BadLog` if no channel has a response.
    """
    check_band(log, band)
    used = choose_channels(log, channels)
    wanted = () if stage is None else choose_targets(stage, band)
    if wanted:
        spans = _spans(log, np.inf, wanted, None)
        band = spans[0][0], spans[-1][1]
    found: list[Modes] = []
    lost: list[BadLog] = []
    unread: list[Refusal] = []
    for channel in used:
        try:
            found.append(read_frf(log, source.name, channel.name, band=band).modes)
        except BadLog as why:
            lost.append(why)
            unread.append(Refusal(log.name, why.reason, why.detail, channel.name, source="frf"))
    if not found:
        raise lost[0]
    rows = dict.fromkeys(chain(log.refused, unread, *(modes.refused for modes in found)))
    refused = [row for row in rows if row.frequency is None]
    lines = dict.fromkeys(chain.from_iterable(modes.lines for modes in found))
    both = numbered(merge(_clearest(found), [*lines], refused))
    poles = {f"pole_{k}": row for k, row in enumerate(rows) if row.frequency is not None}
    modes = both
    if stage is None and not both.names:
        modes = replace(both, refused=tuple(rows))
    elif stage is not None:
        low, high = band or (0.0, np.inf)
        near = tuple(t for t in choose_targets(stage) if low <= t.frequency <= high)
        named = name_resonances(both, near, log.name)
        # Tracking assigns modes without a name: a sweep may excite one of several alone.
        modes = named.publish(both, wanted, poles, unclear=True)
    segments = with_few_lengths(stationary(find_phases(log), 0))
    top = min(band[1] if band else np.inf, _TOP * log.sample_rate)
    spectra = _spectra(used, segments, log.sample_rate, top, top, _EVERYWHERE)
    return ModalReading(modes, spectra, rejected=tuple(poles.values()))


def _clearest(found: Sequence[Modes]) -> list[Modes]:
    """Keep each mode in the channel that shows it with the least standard deviation.

    ``found`` are the modes of one channel each, from the same blows or periods: as the excitation
    that was not measured is common to all, estimates of one mode are no independent ones.
    """
    order = [
        (std / f, c, i)
        for c, modes in enumerate(found)
        for i, (std, f) in enumerate(zip(modes.frequency_std, modes.frequency, strict=True))
    ]
    kept: list[list[int]] = [[] for _ in found]
    for std, c, i in sorted(order):
        others = [
            abs(float(modes.ln_frequency[k] - found[c].ln_frequency[i]))
            for other, modes in enumerate(found)
            for k in kept[other]
            if other != c
        ]
        apart = max(constants.SAME_SIGMAS * std, found[c].damping_ratio[i] / 2)
        if min(others, default=np.inf) > apart:
            kept[c].append(i)
    best = (modes.select(sorted(own)) for modes, own in zip(found, kept, strict=True))
    # Each channel has numbered its own.
    return [replace(modes, names=("",) * len(modes.names)) for modes in best]


def read_ambient(
    log: Log,
    stage: Stage | None = None,
    *,
    channels: Sequence[str] | None = None,
    band: tuple[float, float] | None = None,
    progress: Callable[[str, int, int], None] = lambda step, done, total: None,
) -> ModalReading:
    """Identify modes under ambient excitation; return them with the spectra and their fit."""
    check_band(log, band)
    log = replace(log, channels=choose_channels(log, channels))
    hints, short = () if stage is None else choose_targets(stage, band), list[Refusal]()
    while True:
        try:
            stretches, whole = _transform(log, log.channels, hints, band)
            break
        except BadLog as error:
            hints, refusal = _without_narrowest(hints, error)
            short.append(refusal)
    spans = _spans(log, whole.duration, hints, band)
    tested = _thomson_lines(log, stretches, spans, hints, whole.longest)
    masked_at = [f for _, f, _ in tested]
    cut = whole.each(lambda spectrum: spectrum.without(masked_at))
    seek = partial(_search, cut, spans, hints, masked_at, progress)
    fit = partial(_fit_groups, top=_TOP * log.sample_rate, progress=progress)
    fits = fit(sought := seek(()))
    # Without a further harmonic the search finds the same again.
    if (suspected := _lines_at_modes(fits)) and _n_harmonics(
        again := seek(suspected)
    ) > _n_harmonics(sought):
        fits = fit(sought := again)
    # Modes of the description outside the band take part where they are searched for.
    every = () if stage is None else choose_targets(stage)
    near = tuple(t for t in every if any(low <= t.frequency <= high for low, high in spans))
    fits = join_surplus(drop_duplicates(fits), len(near))
    resonances = [one.modes for fit in fits if (one := fit.resonances) is not None]
    named = name_resonances(merge(resonances, (), (), whole.channels), near, log.name)
    fits = [separate(fit, named.names) for fit in fits]
    fitted = [fit.modes for fit in fits if fit.modes is not None]
    seen = [*tested, *whole.removed_lines, *(line for one in fitted for line in one.lines)]
    lines = name_lines(seen, [s.velocity for s in stretches], stage, 1.5 / whole.duration)
    lines += _wandering(sought)
    rejected = [
        Refusal(log.name, why.reason, why.detail, mode=name, frequency=why.frequency)
        for fit in fits
        for name, why in fit.rejected.items()
    ]
    credible = [one.modes for fit in fits if (one := fit.credible) is not None]
    refused = (*log.refused, *_unlike_others(log, sought), *short)
    unlike = set.intersection(*({*part.left_out} for part in sought))
    shown = tuple(name for name in whole.channels if name not in unlike)
    modes = merge(credible, lines, refused, shown)
    if stage is not None:
        modes = named.publish(modes, hints, {row.mode: row for row in rejected})
    elif modes.names:
        modes = numbered(modes)
    else:
        nothing = _nothing_found(log, lines, rejected)
        modes = replace(modes, refused=(*modes.refused, nothing))
    return ModalReading(modes, whole, tuple(one.fitted for one in fitted), tuple(rejected), sought)


def _unlike_others(log: Log, sought: Sequence[Found]) -> Iterator[Refusal]:
    """Yield a refusal of each channel that a search has left out."""
    for part in sought:
        for name in part.left_out:
            yield Refusal(log.name, "unlike-others", _UNLIKE.format(*part.band), channel=name)


def _wandering(sought: Sequence[Found]) -> tuple[Line, ...]:
    """Return the harmonics that wander as lines."""
    return tuple(
        Line(h.frequency, h.amplitude, "m/s²", "wandering", part.spectra.channels[h.channel])
        for part in sought
        for h in part.harmonics
    )


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
    spectra = _spectra(channels, with_few_lengths(segments), rate, reach, ceiling, resonances)
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


def _spans(
    log: Log, duration: float, hints: Sequence[Target], band: tuple[float, float] | None
) -> list[tuple[float, float]]:
    """Return the bands in Hz that are searched, ascending: where hints may be, or the whole."""
    usable = constants.USABLE * log.sample_rate
    if hints:
        # Wider than the searches, above all downwards: what resonates beside a mode is fitted, too.
        ends = [(*hint.band(BAND_HALF_WIDTH), hint.search) for hint in hints]
        spans: list[tuple[float, float]] = []
        for low, high in sorted((a * (1 - search), b * (1 + search)) for a, b, search in ends):
            if spans and low <= spans[-1][1]:
                low, high = spans[-1][0], max(spans.pop()[1], high)
            spans.append((low, high))
        return [(low, min(high, _TOP * log.sample_rate)) for low, high in spans]
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
    return [(low, high)]


def _thomson_lines(
    log: Log,
    stretches: Sequence[Segment],
    spans: Sequence[tuple[float, float]],
    hints: Sequence[Target],
    recording: CrossSpectrum,
) -> list[tuple[str, float, float]]:
    """Return channel, frequency in Hz and amplitude of the lines of Thomson's test.

    Those are omitted that may be a light mode, as one is described there or they are random.
    """
    longest = max(stretches, key=lambda s: s.stop - s.start)
    return [
        (channel.name, f, amplitude)
        for channel in log.channels
        for span in spans
        for f, amplitude in find_lines(channel, (longest,), log.sample_rate, span).tolist()
        if not (is_near_light(hints, f) or is_random(recording, f))
    ]


def _n_harmonics(sought: Sequence[Found]) -> int:
    return sum(len(part.harmonics) for part in sought)


def _fit_groups(
    sought: Sequence[Found], *, top: float, progress: Callable[[str, int, int], None]
) -> list[ClusterFit]:
    """Fit the modes that a search found, below ``top`` in Hz."""
    groups: dict[tuple[Target, ...], tuple[Found, tuple[Target, ...]]] = {}
    for part in sought:
        for group in split_groups(part.modes):
            near = neighbourhood(group, similar(group, part.modes))
            groups[near] = part, (*groups.get(near, (part, ()))[1], *group)
    fits: list[ClusterFit] = []
    for k, (near, (part, group)) in enumerate(groups.items()):
        progress("fitting", k, len(groups))
        fits += _fit_group(part, group, near, top)
    progress("fitting", len(groups), len(groups))
    return fits


def _search(
    spectra: LogSpectra,
    spans: Sequence[tuple[float, float]],
    hints: tuple[Target, ...],
    lines: list[float],
    progress: Callable[[str, int, int], None],
    suspected: Sequence[float],
) -> tuple[Found, ...]:
    """Search all bands for modes, a wide one in parts."""
    ends = [
        (pair, span) for span in spans for pair in pairwise(_edges(*span, 20 / spectra.duration))
    ]
    parts: list[Found] = []
    for k, ((first, last), (low, high)) in enumerate(ends):
        progress("searching", k, len(ends))
        reach = max(low, first / _BEYOND), min(high, last * _BEYOND)
        own = tuple(hint for hint in hints if reach[0] <= hint.frequency <= reach[1])
        part = search(spectra, *reach, lines, suspected, own)
        number = 1 + sum(len(one.modes) for one in parts)
        modes = [replace(t, name=f"mode_{i}") for i, t in enumerate(part.modes, number)]
        if first > low:
            first = _between((*parts[-1].modes, *modes), first)
            parts[-1] = replace(parts[-1], band=(parts[-1].band[0], first))
        parts.append(replace(part, band=(first, last), modes=tuple(modes)))
    progress("searching", len(ends), len(ends))
    return tuple(parts)


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


def _fit_group(
    found: Found, group: tuple[Target, ...], near: tuple[Target, ...], top: float
) -> list[ClusterFit]:
    """Fit a group with its neighbours, which are not published.

    Where that does not converge the group is fitted alone, and then in parts.
    """
    targets = similar(group, found.modes)
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
    reach = [
        max(float(np.clip(found.skirt(t), _LEAST_REACH, _MOST_REACH)) * t.bandwidth / 2, least)
        for t in near
    ]
    low = max(low, min(t.frequency - width for t, width in zip(near, reach, strict=True)))
    high = min(high, max(t.frequency + width for t, width in zip(near, reach, strict=True)))
    # Further outside of the band that was searched there may be modes that no model has.
    low, high = max(low, found.band[0] / _OUTSIDE), min(high, found.band[1] * _OUTSIDE)
    noise = found.noise((near[0].frequency * near[-1].frequency) ** 0.5)
    around = found.around(near, low, high)
    fit = fit_modes(
        around, near, (low, high), noise, found.model.static, out_of_phase=found.model.out_of_phase
    )
    if fit.modes is None and len(near) > 1:
        parts = [group] if near != group else halves(group)
        return [fit for part in parts for fit in _fit_group(found, part, part, top)]
    fit = fit.keep(own)
    if fit.modes is None:
        return [fit]
    rejected, modes = dict(fit.rejected), fit.modes.modes
    kept = []
    for name, f, scatter in zip(modes.names, modes.frequency, modes.dispersion, strict=True):
        # A mode may move out of the band, to explain what reaches into it.
        if not found.within(f):
            continue
        kept.append(name)
        if scatter > constants.LOOSE_FIT and any(h.low <= f <= h.high for h in found.harmonics):
            detail = f"{f:.5g} Hz is not as steady as noise, and in the band of a line that wanders"
            rejected.setdefault(name, Rejection("line-not-mode", detail, float(f)))
    # A pole that became a line is rejected, and no mode of the fit.
    lines = fit.rejected.keys() - set(modes.names)
    return [replace(fit, rejected=rejected).keep({*kept, *lines})]


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
