"""Impact tests: blows of a hammer, found in the force, and the response averaged over them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import fft
from scipy.special import fdtrc

from lmshealth._private.arrays import ComplexArray, FloatArray, stack
from lmshealth.errors import BadLog
from lmshealth.io.log import Refusal
from lmshealth.modal import constants
from lmshealth.modal.deterministic.likelihood import BandSpectra, pole_columns
from lmshealth.modal.deterministic.response_fit import TRANSIENT_POWERS
from lmshealth.modal.deterministic.responses import (
    Frf,
    Ordinates,
    Pair,
    average_noise,
    check_lines,
    estimates,
)

# Pulses that the filter of the force channel makes of one are no further apart, in samples.
_RINGING = 4
_LEAST_PRE = 2  # samples before a blow, and half a pulse
# An overload: samples that equal the largest, and their share of those above 0.9 of it. A sine in
# steps of 1 % of its amplitude spends 0.31 of these in its outermost step.
_STUCK, _FLAT, _FINE = 3, 0.4, 0.01
# A side that reaches less than this share of the largest value is no overload: a force at rest has
# few levels there, and looks flat.
_SIDE = 0.5
# Rings are fitted so many times, weighted by the noise that the fit before has left. After eight
# the noise near a resonance is unbiased, after three it is a quarter too large.
_PASSES = 8
_LEFT = 0.01  # least share of the degrees of freedom of a line that counts as left
# A mode that has faded to this share at the next blow does not ring: no sensor resolves it.
_FADED = 1e-5


class Hit(NamedTuple):
    """A pulse of the force: half-open range of samples above the trigger level, and its peak."""

    start: int
    stop: int
    peak: float


def find_hits(force: FloatArray, rate: float, *, certain: bool) -> list[list[Hit]]:
    """Find the pulses of a force; those that follow each other as double hits do are one blow.

    With ``certain`` there are none unless the signal is at rest between short pulses that do not
    repeat exactly: a train of equal pulses is a periodic excitation.
    """
    x = force - np.median(force)
    x *= np.sign(x[np.argmax(np.abs(x))])
    noise, peak = 1.4826 * float(np.median(np.abs(x))), float(x.max())
    level = max(constants.TRIGGER * peak, constants.TRIGGER_SIGMAS * noise)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], x > level, [0]])))
    hits: list[Hit] = []
    for start, stop in edges.reshape(-1, 2).tolist():
        last = hits[-1] if hits else None
        if last is not None and start - last.stop < max(_RINGING, last.stop - last.start):
            start = hits.pop().start
        hits.append(Hit(start, stop, float(x[start:stop].max())))
    if certain:
        pulses = sum(float(np.sum(x[hit.start : hit.stop] ** 2)) for hit in hits)
        rests = np.mean(np.abs(x) > 0.1 * peak) < constants.BLOW_DUTY
        if not rests or pulses < constants.BLOW_ENERGY * float(np.sum(x**2)):
            return []
    blows: list[list[Hit]] = []
    for hit in hits:
        if blows and hit.start - blows[-1][0].start < constants.DOUBLE_WITHIN * rate:
            blows[-1].append(hit)
        else:
            blows.append([hit])
    apart = np.diff([blow[0].start for blow in blows])
    if certain and apart.size >= constants.BLOW_REPEATS and np.ptp(apart) <= 2:
        return []
    return blows


def from_blows(
    pair: Pair, blows: Sequence[Sequence[Hit]], band: tuple[float, float]
) -> tuple[Frf, Ordinates, list[Refusal]]:
    """Average usable blows; the others are refused by number and time.

    H1 and the scatter around it contain all that the likelihood needs where each blow begins at
    rest; otherwise see `without_rings`. One blow has the noise of the residual of the fit. `BadLog`
    if no blow can be used, or they excite too few lines of the band.
    """
    rate = pair.log.sample_rate
    used, refused = _usable(pair, blows)
    width = max(hit.stop - hit.start for hit, _ in used)
    before = min(_LEAST_PRE + width // 2, min(hit.start for hit, _ in used))
    n = min(stop - hit.start for hit, stop in used)
    high = min(band[1], constants.USABLE * rate)
    most = int(constants.BLOW_LINES * rate / max(high - band[0], rate / n))
    size = fft.prev_fast_len(min(n, max(most, constants.FRF_SAMPLES)), real=True)
    cut = np.array([[x[h.start - before :][:size] for h, _ in used] for x in pair.signals])
    at = np.arange(size)
    for force, (hit, _) in zip(cut[0], used, strict=True):
        force -= np.median(force)
        force[at >= 2 * before + hit.stop - hit.start] = 0.0
    spectra = np.asarray(fft.rfft(cut, axis=2)[:, :, 1:] / rate, dtype=np.complex128)
    frequency = np.arange(1, spectra.shape[2] + 1) * (rate / size)
    inside = (frequency >= band[0]) & (frequency <= high)
    given = np.sqrt(np.sum(np.abs(spectra[0]) ** 2, axis=0))
    inside &= given >= constants.EXCITED * given[inside].max(initial=0.0)
    n_blows = len(used)
    known = n_blows > 1
    fewest = constants.FRF_LINES if known else constants.FRF_LINES_OF_RECORD
    check_lines(pair, int(inside.sum()), band, fewest)
    frequency, given, spectra = frequency[inside], given[inside], spectra[:, :, inside]
    cross = np.sum(spectra[1] * spectra[0].conj(), axis=0)
    answer, total = cross / given, np.sum(np.abs(spectra[1]) ** 2, axis=0)
    noise, freedom = constants.UNKNOWN_NOISE * total, 0.0
    if known:
        scatter = np.maximum(total - np.abs(answer) ** 2, 0.0) / (n_blows - 1)
        noise, freedom = average_noise(scatter, answer / given, n_blows - 1)
    h1, h2, hv, coherence = estimates(given**2 / n_blows, total / n_blows, cross / n_blows)
    coherence = coherence if known else np.full(frequency.size, np.nan)
    std = np.sqrt(noise) / given
    note = f"{n_blows} of {len(blows)} blows, {size / rate:.4g} s of each."
    frf = Frf(*pair.names, frequency, h1, std, h1, h2, hv, coherence, n_blows, method="blows",
              note=note)  # fmt: skip
    ordinates = Ordinates(frequency, given + 0j, answer, noise, freedom, known, at_rest=True,
                          blows=spectra if known else None)  # fmt: skip
    return frf, ordinates, refused


def without_rings(ordinates: Ordinates, f: FloatArray, zeta: FloatArray) -> Ordinates | None:
    """Remove the rings of earlier blows from the scatter of blows, given poles of a first fit.

    Natural frequencies in Hz and damping ratios have shape ``(n_modes,)``. None where blows do not
    differ in the shape of these poles by more than chance, or have no scatter.
    """
    if ordinates.blows is None:
        return None
    (forces, answers), noise = ordinates.blows, ordinates.noise
    columns = _rings(ordinates, f, zeta)
    further = len(forces) - 1
    first = stack(_average(forces, answers)[1].T)
    error = first
    for _ in range(_PASSES):
        scale = np.tile(np.sqrt(noise), 2)[:, None]
        basis = np.linalg.qr(columns / scale)[0]
        real, imag = np.split(scale * (basis @ (basis.T @ (error / scale))), 2)
        answers = answers - (real + 1j * imag).T
        response, rest = _average(forces, answers)
        # Rings take a share of the degrees of freedom, most of it at resonances.
        left = np.maximum(1 - np.sum(basis**2, axis=1).reshape(2, -1).mean(axis=0), _LEFT)
        scatter = np.sum(np.abs(rest) ** 2, axis=0) / (further * left)
        noise, freedom = average_noise(scatter, response, further)
        error = stack(rest.T)
    n, n_columns = columns.shape
    explained = float(np.sum((basis.T @ (first / scale)) ** 2))
    chance = float(np.sum((first / scale) ** 2)) - explained
    ratio = explained / chance * (n - n_columns) / n_columns
    by_chance = fdtrc(n_columns * further, (n - n_columns) * further, ratio)
    if by_chance > constants.TRANSIENT:
        return None
    return replace(ordinates, answer=response * ordinates.given, noise=noise, freedom=freedom)


def _rings(ordinates: Ordinates, f: FloatArray, zeta: FloatArray) -> FloatArray:
    """Return columns of the rings of modes, and of smooth ones of modes outside the band."""
    frequency, duration = ordinates.frequency, 1 / ordinates.spacing
    s = 1j * frequency / np.sqrt(frequency[0] * frequency[-1])
    smooth = stack(s[:, None] ** np.array(TRANSIENT_POWERS))
    block = BandSpectra(frequency, ordinates.answer[None, :, None], duration, np.inf, smooth)
    ring = np.exp(-2 * np.pi * zeta * f * duration) > _FADED
    return np.concatenate([smooth, *pole_columns(block, f[ring], zeta[ring])[0]], axis=1)


def _average(forces: ComplexArray, answers: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return H1 over blows, ``(n_lines,)``, and the error of each, ``(n_blows, n_lines)``."""
    response = np.sum(answers * forces.conj(), axis=0) / np.sum(np.abs(forces) ** 2, axis=0)
    return response, answers - response * forces


def _usable(
    pair: Pair, blows: Sequence[Sequence[Hit]]
) -> tuple[list[tuple[Hit, int]], list[Refusal]]:
    """Return usable blows with the sample at which the next begins, and the others."""
    log, rate, (force, output) = pair.log, pair.log.sample_rate, pair.signals
    ends = [blow[0].start for blow in blows[1:]] + [force.size]
    margin = _LEAST_PRE + max(hit.stop - hit.start for blow in blows for hit in blow)
    strongest = max(hit.peak for blow in blows for hit in blow)
    length = np.median([end - blow[0].start for blow, end in zip(blows, ends, strict=True)])
    used: list[tuple[Hit, int]] = []
    refused: list[Refusal] = []
    for number, (blow, end) in enumerate(zip(blows, ends, strict=True), start=1):
        main, stop = max(blow, key=lambda hit: hit.peak), end - (margin if end < force.size else 0)
        others = [h for h in blow if h != main and h.peak >= constants.SECOND_HIT * main.peak]
        if others:
            share, apart = others[0].peak / main.peak, abs(others[0].start - main.start) / rate
            reason, step = "double-hit", "strike again"
            found = f"a second hit of {100 * share:.0f} %, {1e3 * apart:.3g} ms apart"
        elif main.peak < constants.WEAK_BLOW * strongest:
            reason, step = "weak-blow", "strike harder"
            found = f"{100 * main.peak / strongest:.2g} % of the strongest, needed "
            found += f"{100 * constants.WEAK_BLOW:.0f} %"
        elif any(_overloaded(x[main.start : stop]) for x in (force, output)):
            reason, step = "overload", "raise the range"
            found = "force or output stays at its largest value"
        elif stop - main.start < min(length, force.size) / 2:
            reason, step = "too-short", "wait longer"
            found = f"{(stop - main.start) / rate:.3g} s until the next blow or the end, half the "
            found += f"others have {length / rate:.3g} s"
        else:
            used.append((main, stop))
            continue
        detail = f"blow {number} at {main.start / rate:.4g} s: {found}; {step}"
        refused.append(Refusal(log.name, reason, detail, pair.names[0], source="frf"))
    if not used:
        detail = "; ".join(one.detail for one in refused)
        none = f"none of {len(blows)} blows can be used: {detail}"
        raise BadLog(log.name, refused[0].reason, none)
    return used, refused


def _overloaded(values: FloatArray) -> bool:
    """Return whether the top or the bottom of a signal is flat."""
    x = values - np.median(values)
    least = _SIDE * float(np.abs(x).max())
    return any(_is_flat(side) for side in (x, -x) if side.max() >= least)


def _is_flat(x: FloatArray) -> bool:
    """Return whether the top of a signal is flat."""
    top = float(x.max())
    near = np.unique(x[x >= 0.9 * top])
    if near.size > 1 and np.diff(near).min() > _FINE * top:
        return False
    n_stuck = np.count_nonzero(x == top)
    return bool(n_stuck >= _STUCK and n_stuck > _FLAT * np.count_nonzero(x >= 0.9 * top))
