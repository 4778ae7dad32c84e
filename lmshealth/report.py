"""Pages for people who decide: one self-contained HTML file per stage, and an index of the fleet.

This module prepares numbers, names and pictures; words and markup are in ``templates/``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from importlib import metadata
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from lmshealth import plots
from lmshealth.changes import Reported, changes, reported
from lmshealth.decision import Service, remaining_days
from lmshealth.influences import Influence, covariate_shifts, find_influences
from lmshealth.logs import Refusal
from lmshealth.results import Health, Prognosis
from lmshealth.stage import ParameterSpec
from lmshealth.summary import Assessment
from lmshealth.trackfacts import (
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
from lmshealth.trackplots import (
    plot_damping,
    plot_frequencies,
    plot_influence,
    plot_nis,
    plot_waterfall,
)
from lmshealth.tracks import History
from lmshealth.wording import (
    GAP,
    LEVELS,
    chance,
    covariate,
    day_count,
    km,
    law_words,
    left,
    moment,
    percent,
    quantiles,
    spell,
    whole_km,
)

_SIZES = {"waterfall": (4.8, 3.6), "influence": (3.8, 2.6)}  # in inches, unlike others
_FLEET_TOP = 1.5  # length of all gauges of the index, as a fraction of baseline


@dataclass(frozen=True, slots=True)
class Gauge:
    """A health parameter now, as text; ``places`` are % of the gauge's length."""

    name: str
    told: bool
    converged: bool
    share: str
    value: str
    interval: str
    below: str
    limit: str
    unit: str
    places: dict[str, float]


@dataclass(frozen=True, slots=True)
class Life:
    """Remaining life of one limit, as text: 5, 50, 95 %; ``now`` is health by the law."""

    name: str
    limit: str
    km: tuple[str, ...]
    days: tuple[str, ...]
    past: str
    beyond: str
    now: str


def write_report(
    folder: Path,
    assessments: Sequence[Assessment],
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
    assessments : sequence of Assessment
        One per stage.
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
    ranked = sorted(assessments, key=Assessment.urgency)
    names = _file_names(ranked)
    pages = _environment()
    common = {"generated": generated, "version": metadata.version("lmshealth")}
    rows = []
    for assessment, name in zip(ranked, names, strict=True):
        row = _summary(assessment, None) | common
        row |= _changes(assessment, (earlier or {}).get(assessment.judgement.stage))
        text = pages.get_template("stage.html.j2").render(row | _evidence(assessment))
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
        rows.append(_summary(assessment, _FLEET_TOP) | {"file": name})
    parameters = list(dict.fromkeys(gauge.name for row in rows for gauge in row["gauges"]))
    tones = Counter(row["tone"] for row in rows)
    context = {"rows": rows, "parameters": parameters, "tones": tones, "refused": refused}
    text = pages.get_template("index.html.j2").render(context | common)
    (folder / "index.html").write_text(text, encoding="utf-8", newline="\n")
    return [folder / name for name in (*names, "index.html")]


def _environment() -> Any:
    """Set up the templates: everything is escaped, and a misspelt name is an error."""
    import jinja2

    pages = jinja2.Environment(
        loader=jinja2.PackageLoader("lmshealth", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    pages.filters |= {"spell": spell, "moment": moment, "km": km, "whole_km": whole_km}
    return pages


def _file_names(assessments: Sequence[Assessment]) -> list[str]:
    """Name the pages after their stages: safe on every file system, never twice the same."""
    taken = {"index"}
    names = {}
    # In the order of identity, so that a page keeps its name when risks change places.
    for k in sorted(range(len(assessments)), key=lambda k: assessments[k].judgement.stage):
        stem = re.sub(r"[^\w.-]+", "-", assessments[k].judgement.stage).strip("-._")[:60] or "stage"
        name, count = stem, 1
        while name.casefold() in taken:
            count += 1
            name = f"{stem}-{count}"
        taken.add(name.casefold())
        names[k] = f"{name}.html"
    return [names[k] for k in range(len(assessments))]


def _summary(assessment: Assessment, top: float | None) -> dict[str, Any]:
    """Collect what both the first screen of a page and a row of the index say."""
    judgement, prognosis = assessment.judgement, assessment.prognosis
    specs = assessment.stage.parameters
    words = {"preload": ("preload",), "mount": ("mount",), "both": ("preload", "mount")}
    lost = [spell(s.name) for s in specs if s.word in words.get(judgement.verdict, ())]
    lives = [] if prognosis is None else [_life(prognosis, k) for k in range(len(prognosis.limits))]
    return {
        "assessment": assessment,
        "identity": judgement.stage,
        "lost": " and ".join(lost) or judgement.verdict,
        "tone": {"healthy": "good", "not-enough-data": "open"}.get(judgement.verdict, "bad"),
        "probability": percent(judgement.probability) if judgement.probability >= 0 else "",
        "gauges": list(_gauges(assessment, top)),
        "lives": lives,
        "service": _service(assessment.service()),
    }


def _changes(assessment: Assessment, before: Reported | None) -> dict[str, Any]:
    """Say what is new since the last report."""
    news = () if before is None else changes(before, reported(assessment))
    return {"before": before, "news": news}


def _evidence(assessment: Assessment) -> dict[str, Any]:
    """Collect what the rest of a stage's page shows."""
    track, prognosis, history = assessment.track, assessment.prognosis, assessment.history
    health, stage = _health(assessment), assessment.stage
    influences = () if track is None else find_influences(history, track, stage)
    drift = np.zeros(1) if track is None else np.abs(np.expm1(track.drift[-1]))
    return {
        "health": health,
        "modes": [] if track is None else list(mode_rows(track)),
        "seen": _seen(history),
        "pairs": [] if health is None else _pairs(health),
        "picture": _pictures(assessment, influences),
        "taken_out": list(taken_out(influences)),
        "untouched": untouched(history, stage),
        "mode_use": list(mode_use(history, track, stage, assessment.refused)),
        "surprise": None if track is None else surprise(track),
        "happened": [] if track is None else list(happened(track)),
        "filter": None if track is None else filter_health(track),
        "noise_scale": None if track is None else float(track.noise_scale[-1].max()),
        "largest_drift": float(np.nanmax(drift, initial=0.0)),
        "laws": [] if prognosis is None else list(_laws(prognosis)),
        "law": prognosis and fit(prognosis.chi_square, prognosis.degrees_of_freedom),
        # Laws that leave nothing to sample, and improbable ones, have no chains to be judged.
        "chained": prognosis is not None and bool(np.isfinite(prognosis.ess)),
        "effects": [] if track is None else [effect_row(effect) for effect in other_effects(track)],
        "reasons": Counter(item.reason for item in assessment.refused).most_common(),
        "hashes": list(zip(history.logs, assessment.digests, strict=False)),
    }


def _gauges(assessment: Assessment, top: float | None) -> Iterator[Gauge]:
    health = _health(assessment)
    if health is None:
        return
    if top is None:  # one length for all gauges of a page, so that bars can be compared
        highest = health.latest(0.95).max()
        top = float(np.clip(np.ceil(10 * highest + 0.5) / 10, 1.2, 2.0))
    for k, name in enumerate(health.parameters):
        spec = next((spec for spec in assessment.stage.parameters if spec.name == name), None)
        yield _gauge(spec, health, k, top)


def _gauge(spec: ParameterSpec | None, health: Health, column: int, top: float) -> Gauge:
    low, middle, high = health.latest(LEVELS)[:, column]
    limit = _limit(spec)
    places = {"low": low, "median": middle, "high": high, "baseline": 1.0, "limit": limit or 0.0}
    below = "" if limit is None else percent(np.mean(health.samples[-1, :, column] < limit))
    return Gauge(
        name=spell(health.parameters[column]),
        told=bool(health.told()[column]),
        converged=bool(health.converged[-1]),
        share=percent(float(health.informed[-1, column])),
        value=f"{100 * middle:.0f}{GAP}%",
        interval=f"{100 * low:.0f} to {100 * high:.0f}{GAP}%",
        below=below,
        limit="" if limit is None else f"{100 * limit:.3g}{GAP}%",
        unit=f"{spec.baseline:g}{GAP}{spec.unit}" if spec and spec.unit else "",
        places={key: round(100 * min(float(v) / top, 1.0), 2) for key, v in places.items()},
    )


def _service(service: Service) -> dict[str, Any]:
    """Put in words when to service, and by what that was chosen."""
    ratio = service.cost_ratio
    return {
        "kind": service.kind,
        "by": service.by,
        "accepted": service.max_risk and f"{100 * service.max_risk:.3g}{GAP}%",
        "times": ratio and f"{ratio:.3g}",
        "risk": percent(service.risk),
        "planned": service.planned,
        "planned_risk": chance(*service.planned_risk),
    }


def _life(prognosis: Prognosis, column: int) -> Life:
    name, limit = prognosis.parameters[column], float(prognosis.limits[column])
    distance = quantiles(prognosis.claimed()[:, column])
    days = quantiles(remaining_days(prognosis)[:, column])
    low, middle, high = quantiles(
        100 * prognosis.health[:, min(column, prognosis.health.shape[1] - 1)]
    )
    return Life(
        name="any limit" if name == "any" else spell(name),
        limit="" if np.isnan(limit) else f"{100 * limit:.3g}{GAP}%",
        km=tuple(left(v, f"beyond {km(prognosis.horizon)}", km(v)) for v in distance),
        days=tuple(left(v, "beyond", day_count(v)) for v in days),
        past=percent(float(prognosis.already_past()[column])),
        beyond=percent(float(prognosis.beyond_horizon()[column])),
        now="" if name == "any" else f"{middle:.0f}{GAP}% ({low:.0f} to {high:.0f}{GAP}%)",
    )


def _laws(prognosis: Prognosis) -> Iterator[tuple[str, str, str, str]]:
    """Say what each parameter may do: its name, the law, since when, and how probably."""
    for law in prognosis.laws:
        since = km(law.begin) if law.begin else ""
        yield spell(law.parameter), law_words(law.kind), since, percent(law.probability)


def _pictures(
    assessment: Assessment, influences: Sequence[Influence]
) -> dict[tuple[str, ...], str]:
    """Draw every picture of a page, by kind and by what it shows."""
    draw = _track_pictures(assessment, influences) | _health_pictures(assessment)
    return {key: _inline(one, key[0], f"p{k}") for k, (key, one) in enumerate(draw.items())}


def _track_pictures(
    assessment: Assessment, influences: Sequence[Influence]
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


def _health_pictures(assessment: Assessment) -> dict[tuple[str, ...], Any]:
    prognosis, health = assessment.prognosis, _health(assessment)
    draw: dict[tuple[str, ...], Any] = {}
    if health is not None:
        for names, key, _ in _pairs(health):
            draw["posterior", key] = partial(plots.plot_posterior, health=health, parameters=names)
        limits = {spec.name: _limit(spec) for spec in assessment.stage.parameters}
        for name in health.parameters:
            draw["health", spell(name)] = partial(
                plots.plot_health, health=health, parameter=name, limit=limits.get(name)
            )
    if prognosis is not None:
        for name in prognosis.parameters[:-1]:
            draw["life", spell(name)] = partial(
                plots.plot_life, prognosis=prognosis, parameter=name, health=health
            )
        service = assessment.service()
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


def _health(assessment: Assessment) -> Health | None:
    health = assessment.health
    return health if health is not None and health.recorded_at and health.parameters else None


def _limit(spec: ParameterSpec | None) -> float | None:
    """Limit as a fraction of the baseline."""
    return None if spec is None or spec.limit is None else spec.limit.below / spec.baseline
