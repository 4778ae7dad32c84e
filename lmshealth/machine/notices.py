"""Notices: what was noticed about a machine that its reader must take into account."""

from collections.abc import Iterator
from typing import Literal

import numpy as np
from scipy.special import gammaincinv

from lmshealth._private.arrays import FloatArray
from lmshealth._private.tables import fact, spell
from lmshealth.io.log import WARNINGS, Notice, Refusal
from lmshealth.life.constants import CALIBRATED_RISK, LONE_NAMED, SURPRISE
from lmshealth.life.verdict import lone_sentence
from lmshealth.machine.assessment import Assessment

_SEVERITIES = "serious", "caution", "note"


def notices(assessment: Assessment) -> tuple[Notice, ...]:
    """Return the notices about a machine, the serious ones first: rows of ``warnings.csv``."""
    found = [*assessment.notices, *_of_track(assessment), *_of_health(assessment)]
    found += [*_of_laws(assessment), *_of_channels(assessment)]
    return tuple(sorted(found, key=lambda one: _SEVERITIES.index(one.severity)))


def _of_track(assessment: Assessment) -> Iterator[Notice]:
    """Yield notices about names of modes, flags of their estimates, and the filter."""
    if assessment.doubt:
        yield Notice("names-in-doubt", "serious", "", assessment.doubt)
    latest = assessment.latest
    flags = () if latest is None else zip(latest.modes.names, latest.modes.flags, strict=True)
    by_flag: dict[str, list[str]] = {}
    for mode, own in flags:
        for flag in (one for one in own.split() if one not in WARNINGS.values()):
            by_flag.setdefault(flag, []).append(mode)
    for flag, modes in by_flag.items():
        names = " and ".join(map(spell, dict.fromkeys(modes)))
        what = fact("The last log has the flag {flag} at {names}.", flag=flag, names=names)
        to_do = fact("Its meaning is in the column flags of modes.csv.")
        yield Notice(flag, "caution", names, what, to_do)
    track = assessment.track
    for mode, (size, n_std) in assessment.drifted.items():
        n_logs = len(assessment.history.logs) - assessment.history.baseline
        moved = f"{100 * np.expm1(size):+.2f}".replace("-", "−")
        what = fact(
            "{mode} has moved by {size} % in {n} logs, {n_std:.0f} standard deviations: no scatter "
            "explains it.",
            mode=spell(mode).capitalize(),
            size=moved,
            n=n_logs,
            n_std=n_std,
        )
        to_do = fact(
            "Record a log at once; check work, payload, sensor and servo tuning since then."
        )
        yield Notice("large-drift", "serious", mode, what, to_do)
    for mode, n in _left_out(assessment).items():
        one = fact(
            "The last log is far from those before it at {mode}, and left out.", mode=spell(mode)
        )
        more = fact(
            "The last {n} logs are far from those before them at {mode}, and left out: health is "
            "that of then.",
            n=n,
            mode=spell(mode),
        )
        to_do = fact("Record a log now, and enter work since then in maintenance.csv.")
        severity: Literal["serious", "caution"] = "serious" if n > 1 else "caution"
        yield Notice("last-logs-left-out", severity, mode, more if n > 1 else one, to_do)
    if track is not None and not track.consistency().holds:
        p = f"{min(track.consistency().p_value, track.consistency().autocorrelation_p_value):.1g}"
        widened = track.widening[-1]
        narrow = fact("The logs do not vary as the filter of the modes expects (p = {p}).", p=p)
        wide = fact(
            "The logs do not vary as the filter of the modes expects (p = {p}); its intervals are "
            "{factor:.1f} times as wide.",
            p=p,
            factor=widened,
        )
        what = wide if widened > 1 else narrow
        to_do = fact("Look for a cause that the logs do not contain: payload, temperature, tuning.")
        yield Notice("filter-inconsistent", "caution", "", what, to_do)


def _left_out(assessment: Assessment) -> dict[str, int]:
    """Return the modes whose last logs are outliers of the track, and how many of these."""
    track, left = assessment.track, dict[str, int]()
    if track is None:
        return left
    for epoch, mode in sorted(track.outliers, reverse=True):
        if epoch == len(track.logs) - 1 - left.get(mode, 0) and mode not in assessment.drifted:
            left[mode] = left.get(mode, 0) + 1
    return left


def _of_health(assessment: Assessment) -> Iterator[Notice]:
    """Yield notices about health now."""
    health = assessment.latest_health
    if health is None:
        return
    if not health.explained:
        what = fact("No life of the parameters explains the modes (p = {p:.1g}).", p=health.fit[-1])
        to_do = fact("Check what else moved the modes, and the map.")
        yield Notice("unexplained-drifts", "serious", "", what, to_do)
    for name, edge in zip(health.parameters, health.at_edge[-1], strict=True):
        if edge:
            what = fact(
                "The interval of {name} ends at an end of the map, which bounds it.",
                name=spell(name),
            )
            yield Notice("end-of-map", "caution", name, what, fact("Extend the map."))


def _of_channels(assessment: Assessment) -> Iterator[Notice]:
    """Yield notices about channels whose samples are faulty, repaired or left out."""
    found: dict[tuple[str, str], list[Refusal]] = {}
    for row in assessment.refused:
        if row.reason in WARNINGS and row.channel:
            found.setdefault((row.reason, row.channel), []).append(row)
    for (reason, channel), rows in found.items():
        logs = len({row.log for row in rows})
        own = {"channel": channel, "detail": rows[-1].detail, "log": rows[-1].log, "n": logs}
        what = fact("{channel}: {detail} (in {log}; {n} such logs).", **own)
        repaired = not WARNINGS[reason]
        to_do = fact("refused.csv lists all.")
        yield Notice(reason, "note" if repaired else "caution", channel, what, to_do)


def _of_laws(assessment: Assessment) -> Iterator[Notice]:
    """Yield notices about the laws, their fit, and modes that moved alone."""
    prognosis = assessment.prognosis
    if prognosis is None:
        return
    for name in prognosis.unidentifiable:
        what = fact(
            "The limit of {name} is left out of the life: the modes do not show it.",
            name=spell(name),
        )
        yield Notice("limit-not-included", "caution", name, what)
    for lone in prognosis.modes_off:
        if lone.probability >= LONE_NAMED:
            what = lone_sentence(lone, assessment.stage)
            yield Notice("mode-off-map", "caution", lone.mode, what)
    dof = prognosis.degrees_of_freedom
    if dof > 0 and prognosis.chi_square > chi_square_band(np.array(dof))[1]:
        what = fact(
            "No law of degradation fits the logs (χ² {value:.0f} of {dof:.0f}).",
            value=prognosis.chi_square,
            dof=dof,
        )
        to_do = fact("Do not rely on the remaining life, and record further logs soon.")
        yield Notice("laws-do-not-fit", "serious", "", what, to_do)
    fleet = assessment.calibration
    if fleet is not None and fleet.p_value < SURPRISE:
        what = fact(
            "{early} of the {n} ended lives of this fleet ended before the travel predicted for "
            "{share:.0%} of them (p = {p:.1g}).",
            early=fleet.early,
            n=fleet.n_lives,
            share=CALIBRATED_RISK,
            p=fleet.p_value,
        )
        to_do = fact(
            "Plan by the calibrated travel instead of the service date; add a law that fits."
        )
        yield Notice("fleet-ends-early", "serious", "", what, to_do)


def chi_square_band(dof: FloatArray) -> FloatArray:
    """Return the 95 % interval of chi-square variables, shape ``(2, ...)``."""
    return np.stack([2 * gammaincinv(dof / 2, level) for level in (0.025, 0.975)])
