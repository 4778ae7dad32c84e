"""Notices: what was noticed about a machine that its reader must take into account."""

from collections.abc import Iterator

import numpy as np

from lmshealth.io.log import WARNINGS, Notice, Refusal
from lmshealth.prognosis.constants import CALIBRATED_RISK, SURPRISE
from lmshealth.prognosis.results import ModeError
from lmshealth.report import constants, figures
from lmshealth.report.assessment import Assessment, disagreements
from lmshealth.report.text import quantiles, signed, spell

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
        what = f"The last log has the flag {flag} at {names}."
        yield Notice(
            flag, "caution", names, what, "Its meaning is in the column flags of modes.csv."
        )
    track = assessment.track
    if track is not None and not track.consistency().holds:
        p = f"{min(track.consistency().p_value, track.consistency().autocorrelation_p_value):.1g}"
        widened = track.widening[-1]
        what = f"The logs do not vary as the filter of the modes expects (p = {p})"
        what += f"; its intervals are {widened:.1f} times as wide." if widened > 1 else "."
        to_do = "Look for a cause that the logs do not contain: payload, temperature, tuning."
        yield Notice("filter-inconsistent", "caution", "", what, to_do)


def _of_health(assessment: Assessment) -> Iterator[Notice]:
    """Yield notices about the posterior of the last epoch."""
    health = assessment.latest_health
    if health is None:
        return
    if not health.converged[-1]:
        what = "The sampler of health did not converge, so no value is published."
        yield Notice("not-converged", "serious", "", what, "Record further logs.")
    if not health.explained:
        what = f"No state on the map explains the drifts of the modes (p = {health.fit[-1]:.1g})."
        to_do = "Check what else moved the modes, and the map."
        yield Notice("unexplained-drifts", "serious", "", what, to_do)
    for name, edge in zip(health.parameters, health.at_edge[-1], strict=True):
        if edge:
            what = f"The interval of {spell(name)} ends at an end of the map, which bounds it."
            yield Notice("end-of-map", "caution", name, what, "Extend the map.")


def _of_channels(assessment: Assessment) -> Iterator[Notice]:
    """Yield notices about channels whose samples are faulty, repaired or left out."""
    found: dict[tuple[str, str], list[Refusal]] = {}
    for row in assessment.refused:
        if row.reason in WARNINGS and row.channel:
            found.setdefault((row.reason, row.channel), []).append(row)
    for (reason, channel), rows in found.items():
        logs = len({row.log for row in rows})
        what = f"{channel}: {rows[-1].detail} (in {rows[-1].log}; {logs} such logs)."
        repaired = not WARNINGS[reason]
        to_do = "refused.csv lists all."
        yield Notice(reason, "note" if repaired else "caution", channel, what, to_do)


def _of_laws(assessment: Assessment) -> Iterator[Notice]:
    """Yield notices about the laws: their fit, and whether they agree with the last epoch."""
    prognosis = assessment.prognosis
    if prognosis is None:
        return
    for name in prognosis.unidentifiable:
        what = f"The limit of {spell(name)} is left out of the life: the modes do not show it."
        yield Notice("limit-not-included", "caution", name, what)
    if prognosis.modes_off:
        yield _of_map(prognosis.modes_off)
    dof = prognosis.degrees_of_freedom
    if dof > 0 and prognosis.chi_square > figures.chi_square_band(np.array(float(dof)))[1]:
        what = f"No law of degradation fits the logs (χ² {prognosis.chi_square:.0f} of {dof})."
        to_do = (
            "Do not rely on the remaining life; use the last epoch, and record further logs soon."
        )
        yield Notice("laws-do-not-fit", "serious", "", what, to_do)
    fleet = assessment.calibration
    if fleet is not None and fleet.p_value < SURPRISE:
        what = f"{fleet.early} of the {fleet.n_lives} ended lives of this fleet ended before the "
        what += f"travel predicted for {CALIBRATED_RISK:.0%} of them (p = {fleet.p_value:.1g})."
        to_do = "Plan by the calibrated travel instead of the service date; add a law that fits."
        yield Notice("fleet-ends-early", "serious", "", what, to_do)
    for name, by_epoch, by_laws in disagreements(assessment):
        (least, _, most), (low, _, high) = quantiles(by_epoch), quantiles(by_laws)
        what = f"{spell(name).capitalize()} is {100 * least:.0f} to {100 * most:.0f} % by the last "
        what += f"epoch alone, and {100 * low:.0f} to {100 * high:.0f} % by the laws of all logs."
        to_do = "Gauges and verdict pool both; allow for the lower, and record a log soon."
        yield Notice("methods-disagree", "serious", name, what, to_do)


def _of_map(errors: tuple[ModeError, ...]) -> Notice:
    """Return the notice about the modes of which one disagrees with the map."""
    upto = np.cumsum([one.probability for one in errors])
    likely = errors[: int(np.searchsorted(upto, constants.NAMED)) + 1]
    texts = [
        f"{spell(one.mode)} drifts by {signed(100 * one.size, 0)} ± {100 * one.std:.0f} % of what "
        f"the map predicts from the other modes (probability {one.probability:.0%})"
        for one in likely
    ]
    what = " or ".join(texts)
    to_do = (
        "Check the name and the sensitivities of the mode; correct the map, or declare its error "
        "(model_std). The intervals allow for three times the declared one."
    )
    where = " or ".join(one.mode for one in likely)
    return Notice("mode-off-map", "caution", where, f"{what[0].upper()}{what[1:]}.", to_do)
