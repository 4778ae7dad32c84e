"""Pages for people who decide: one self-contained HTML file per stage, each made alone.

This module prepares numbers, names and pictures; words and markup are in ``templates/``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from lmshealth._files import write_text
from lmshealth.health.results import Health
from lmshealth.io.log import Refusal
from lmshealth.prognosis.maintenance_decision import Service
from lmshealth.prognosis.results import Prognosis
from lmshealth.report import figures as plots
from lmshealth.report.assessment import Assessment
from lmshealth.report.changes import Reported, changes, reported
from lmshealth.report.figures import (
    plot_damping,
    plot_frequencies,
    plot_influence,
    plot_nis,
    plot_waterfall,
)
from lmshealth.report.fleet_page import (
    Summary,
    by_urgency,
    file_names,
    summarise,
    write_index,
)
from lmshealth.report.fleetfacts import taught
from lmshealth.report.healthfacts import (
    first_limit,
    gauges,
    health_now,
    how_sure,
    limit_of,
    lives,
    service_words,
    tone,
    verdict_words,
)
from lmshealth.report.html import render
from lmshealth.report.svg import share_letters
from lmshealth.report.text import covariate, km, law_words, percent, spell
from lmshealth.report.trackfacts import (
    effect_row,
    filter_health,
    fit,
    happened,
    mode_rows,
    mode_use,
    other_effects,
    surprise,
    taken_out,
    untouched,
)
from lmshealth.tracking.covariate_effects import (
    CovariateEffect,
    covariate_shifts,
    find_covariate_effects,
)
from lmshealth.tracking.history import History

_SIZES = {"waterfall": (4.8, 3.6), "influence": (3.8, 2.6)}  # in inches, unlike others


@dataclass(frozen=True, slots=True)
class Page:
    """The page of one stage.

    Attributes
    ----------
    file : str
        Its name.
    text : str
        HTML.
    summary : Summary
        What the front page says of the stage.
    """

    file: str
    text: str
    summary: Summary


def make_page(
    assessment: Assessment,
    file: str,
    *,
    before: Reported | None = None,
    generated: datetime | None = None,
) -> Page:
    """Make the page of one stage; it needs no other one.

    Parameters
    ----------
    assessment : Assessment
        Of the stage.
    file : str
        Name of the page, from `file_names`.
    before : Reported or None
        What the last report on this stage said.
    generated : datetime or None
        Moment to print on the page; nothing is printed for None.
    """
    service = assessment.service()
    content = _first(assessment, service) | _evidence(assessment, service)
    content |= _changes(assessment, service, before)
    text = render("stage.html.j2", generated, **content)
    return Page(file, text, summarise(assessment, service, file))


def write_report(
    folder: Path,
    assessments: Iterable[Assessment],
    refused: Sequence[Refusal],
    *,
    earlier: Mapping[str, Reported] | None = None,
    generated: datetime | None = None,
) -> list[Path]:
    """Write one page per stage, and ``index.html``.

    The same input gives the same bytes, in any order of the assessments.

    Parameters
    ----------
    folder : Path
        Where to write; made if it is not there.
    assessments : iterable of Assessment
        One per stage; only one at a time is held.
    refused : sequence of Refusal
        Logs that belong to no stage.
    earlier : mapping of str to Reported, optional
        By stage, what its last report said.
    generated : datetime or None
        Moment to print on the pages; nothing is printed for None.

    Returns
    -------
    list of Path
        The pages of the stages, worst first, then the index.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for k, assessment in enumerate(assessments):
        before = (earlier or {}).get(assessment.judgement.stage)
        page = make_page(assessment, f"{k}.part", before=before, generated=generated)
        write_text(folder / page.file, page.text)
        rows.append(page.summary)
    names = file_names(row.identity for row in rows)  # known only when all have been seen
    named = [replace(row, file=names[row.identity]) for row in rows]
    for row, final in zip(rows, named, strict=True):
        (folder / row.file).replace(folder / final.file)
    index = write_index(folder, named, refused, generated=generated)
    return [*(folder / row.file for row in by_urgency(named)), index]


def _first(assessment: Assessment, service: Service) -> dict[str, Any]:
    """Collect what the first screen of a page says."""
    return {
        "assessment": assessment,
        "identity": assessment.judgement.stage,
        "verdict": verdict_words(assessment),
        "tone": tone(assessment),
        "probability": how_sure(assessment),
        "gauges": gauges(assessment),
        "lives": lives(assessment.prognosis),
        "service": service_words(service),
        "first_limit": first_limit(assessment.prognosis),
    }


def _changes(assessment: Assessment, service: Service, before: Reported | None) -> dict[str, Any]:
    """Say what is new since the last report."""
    news = () if before is None else changes(before, reported(assessment, service))
    return {"before": before, "news": news}


def _evidence(assessment: Assessment, service: Service) -> dict[str, Any]:
    """Collect what the rest of a stage's page shows."""
    track, prognosis, history = assessment.track, assessment.prognosis, assessment.history
    health, stage = health_now(assessment), assessment.stage
    influences = () if track is None else find_covariate_effects(history, track, stage)
    letters, pictures = share_letters(_pictures(assessment, service, influences))
    drift = np.zeros(1) if track is None else np.abs(np.expm1(track.drift[-1]))
    return {
        "health": health,
        "modes": [] if track is None else list(mode_rows(track)),
        "seen": _seen(history),
        "pairs": [] if health is None else _pairs(health),
        "picture": pictures,
        "letters": letters,
        "taken_out": list(taken_out(influences)),
        "untouched": untouched(history, stage),
        "mode_use": list(mode_use(history, track, stage, assessment.refused)),
        "surprise": None if track is None else surprise(track),
        "happened": [] if track is None else list(happened(track)),
        "filter": None if track is None else filter_health(track),
        "noise_scale": None if track is None else float(track.noise_scale[-1].max()),
        "largest_drift": float(np.nanmax(drift, initial=0.0)),
        "taught": taught(assessment.fleet, stage),
        "laws": [] if prognosis is None else list(_laws(prognosis)),
        "law": prognosis and fit(prognosis.chi_square, prognosis.degrees_of_freedom),
        # Laws that leave nothing to sample, and improbable ones, have no chains to be judged.
        "chained": prognosis is not None and bool(np.isfinite(prognosis.ess)),
        "effects": [] if track is None else [effect_row(effect) for effect in other_effects(track)],
        "reasons": Counter(item.reason for item in assessment.refused).most_common(),
        "hashes": list(zip(history.logs, assessment.digests, strict=False)),
    }


def _laws(prognosis: Prognosis) -> Iterator[tuple[str, str, str, str]]:
    """Say what each parameter may do: its name, the law, since when, and how probably."""
    for law in prognosis.laws:
        since = km(law.begin) if law.begin else ""
        yield spell(law.parameter), law_words(law.kind), since, percent(law.probability)


def _pictures(
    assessment: Assessment, service: Service, influences: Sequence[CovariateEffect]
) -> dict[tuple[str, ...], str]:
    """Draw every picture of a page, by kind and by what it shows."""
    draw = _track_pictures(assessment, influences) | _health_pictures(assessment, service)
    return {key: _inline(one, key[0], f"p{k}") for k, (key, one) in enumerate(draw.items())}


def _track_pictures(
    assessment: Assessment, influences: Sequence[CovariateEffect]
) -> dict[tuple[str, ...], Any]:
    history, track, waterfall = assessment.history, assessment.track, assessment.waterfall
    draw: dict[tuple[str, ...], Any] = {}
    pair = {"frequency": plot_frequencies, "damping": plot_damping}
    for mode in _seen(history):
        for kind, plot in pair.items():
            draw[kind, mode] = partial(plot, history=history, track=track, mode=mode)
    if waterfall is not None and history.has_odometer:
        moved = None if track is None else covariate_shifts(history, track, assessment.stage)
        draw["waterfall", "all"] = partial(
            plot_waterfall, waterfall=waterfall, history=history, track=track, moved=moved
        )
    for one in influences:
        if one.values.size:
            name = covariate(one.covariate)[0]
            draw["influence", name, one.mode] = partial(
                plot_influence, influence=one, history=history
            )
    if track is not None and surprise(track) is not None:
        draw["nis", "all"] = partial(plot_nis, track=track)
    return draw


def _health_pictures(assessment: Assessment, service: Service) -> dict[tuple[str, ...], Any]:
    prognosis, health = assessment.prognosis, health_now(assessment)
    draw: dict[tuple[str, ...], Any] = {}
    if health is not None:
        for names, key, _ in _pairs(health):
            draw["posterior", key] = partial(plots.plot_posterior, health=health, parameters=names)
        limits = {spec.name: limit_of(spec) for spec in assessment.stage.parameters}
        for name in health.parameters:
            draw["health", spell(name)] = partial(
                plots.plot_health, health=health, parameter=name, limit=limits.get(name)
            )
    if prognosis is not None:
        for name in prognosis.parameters[:-1]:
            draw["life", spell(name)] = partial(
                plots.plot_life, prognosis=prognosis, parameter=name, health=health
            )
        draw["survival", "any"] = partial(plots.plot_survival, prognosis=prognosis, service=service)
    return draw


def _inline(draw: Any, kind: str, salt: str) -> str:
    size = _SIZES.get(kind, plots.SIZE)
    # The HTML parser knows these namespaces; without them the page names no address at all.
    return re.sub(r'\sxmlns(:xlink)?="[^"]*"', "", plots.svg(draw, salt=salt, size=size))


def _pairs(health: Health) -> list[tuple[tuple[str, ...], str, float]]:
    """Parameters to draw against each other, their title, and their correlation."""
    names = health.parameters
    if len(names) == 1:
        return [(names, spell(names[0]), 0.0)]
    rho = health.correlation[-1]
    return [
        ((names[i], names[j]), f"{spell(names[i])} against {spell(names[j])}", float(rho[i, j]))
        for i, j in combinations(range(len(names)), 2)
    ]


def _seen(history: History) -> list[str]:
    """Modes that at least one log gave."""
    found = np.isfinite(history.ln_frequency)
    return [mode for mode in history.modes if found[:, history.columns(mode)].any()]
