"""Page of one machine, and fleet page ``index.html``: self-contained HTML files.

This module collects results and figures; wording and markup are in ``templates/``.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import date, timedelta
from functools import partial
from itertools import chain, combinations
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.special import chdtrc

from lmshealth._private.files import free_name, write_text
from lmshealth.io.log import Refusal, utc_day
from lmshealth.life.constants import LONE_NAMED, MIN_FIT
from lmshealth.life.fleet_prior import LawPrior, Pace
from lmshealth.life.health import Health
from lmshealth.life.posterior.likelihood import expected_scatter, scatter_prior
from lmshealth.life.verdict import OUTSIDE_MAP
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.constants import LEVELS, RUL_LEVELS
from lmshealth.machine.service import Service
from lmshealth.machine.status import Status, chi_square_band, coming_states, notices
from lmshealth.machine.summary import Summary, first_limit, limit_of
from lmshealth.report import constants, figures, text
from lmshealth.report.language import mark, tr, tr_month
from lmshealth.report.log_figures import plot_shapes, plot_spectra, shapes_size, spectra_size
from lmshealth.report.rendering import read, render
from lmshealth.report.tables import track_rows
from lmshealth.report.text import GAP, spell
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from lmshealth.tracking.track import (
    Effect,
    Track,
    covariate_shifts,
    find_covariate_effects,
)

Item = TypeVar("Item")

_MARK = "<!--day-->"  # no other comment is in a page: everything else is escaped
_SIZES = {"waterfall": (4.5, 3.6), "influence": (3.8, 2.6)}  # in inches; others: figures.SIZE


def make_page(assessment: Assessment, summary: Summary, *, before: Summary | None = None) -> str:
    """Make the page of one machine (HTML), with marks that `date_page` replaces.

    Parameters
    ----------
    assessment, summary : Assessment, Summary
        Results of the machine, and what `summarise` makes of them.
    before : Summary, optional
        Summary of the machine in its previous report.
    """
    prognosis, fleet = assessment.limits_left or assessment.prognosis, assessment.fleet
    highest = max((one.high for one in summary.health), default=1.0)
    priors = (scatter_prior(assessment.stage), fleet.scatter) if fleet else ()
    content = _track_content(assessment) | {
        "assessment": assessment,
        "notices": notices(assessment),
        "summary": summary,
        "bar": float(np.clip(np.ceil(10 * highest + 0.5) / 10, 1.2, 2.0)),
        "first_limit": first_limit(prognosis),
        "prognosis": prognosis,
        "before": before,
        "mark": _MARK,
        "pairs": list(_pairs(assessment.latest_health)),
        # Expected random walk, factor and deviation, each by the description and by the fleet.
        "scatter": list(zip(*map(expected_scatter, priors), strict=True)),
        "pace": _pace,
        "fit": prognosis and chi_square_side(prognosis.chi_square, prognosis.degrees_of_freedom),
    }
    pictures: dict[tuple[str, ...], str] = {}
    for key, draw in _plots(assessment, summary.service, content):
        size = _SIZES.get(key[0], figures.SIZE)
        pictures[key] = figures.svg(draw, salt=f"p{len(pictures)}", size=size)
    for name, whole, size in _log_pictures(assessment):
        pictures[name, "all"] = figures.inline(whole, salt=name, size=size)
    # An HTML parser needs no namespaces; without them the page names no address at all.
    content["picture"] = {
        key: re.sub(r'\sxmlns(:xlink)?="[^"]*"', "", svg) for key, svg in pictures.items()
    }
    return render("stage.html.j2", **content)


def date_page(page: str, summary: Summary, status: Status) -> str:
    """Complete what `make_page` returns by what depends on the day.

    A page is drawn once and completed every day. ``summary`` is that of `on_day`, ``status`` that
    of the same day.
    """
    assert summary.today is not None  # of a summary of a day
    states = coming_states(status, summary.today)
    parts = render("day.html.j2", mark=_MARK, summary=summary, status=status, states=states)
    pieces = page.split(_MARK)[1:]  # the page begins with a mark
    return "".join(part + piece for part, piece in zip(parts.split(_MARK), pieces, strict=True))


def latest_modes(track: Track, stage: Stage, mac: Mapping[str, float]) -> list[dict[str, Any]]:
    """Return rows of ``track.csv`` of the last epoch, with the frequency at the baseline.

    Untracked modes are last; a mode without an estimate yet is left out.
    """
    declared = {mode.name: mode.frequency_hz for mode in stage.modes}
    return [
        row
        | {
            "baseline_hz": row["frequency_hz"] * np.exp(-row["drift"]),
            "declared_hz": declared.get(row["mode"]),
            "mac": mac.get(row["mode"]),
        }
        for row in track_rows(track)[-len(track.modes) :]
        if np.isfinite([row["frequency_hz"], row["drift"]]).all()
    ]


def chi_square_side(value: float, dof: float) -> dict[str, Any] | None:
    """Compare χ² with its 95 % interval; None without degrees of freedom."""
    if dof <= 0:
        return None
    low, high = chi_square_band(np.array(dof, dtype=float)).tolist()
    side = "above" if value > high else "below" if value < low else "inside"
    found = {"value": value, "dof": dof, "low": low, "high": high, "side": side}
    return found | {"is_refuted": bool(chdtrc(dof, value) < MIN_FIT)}


def _outside_map(assessment: Assessment, mac: Mapping[str, float]) -> Iterator[dict[str, Any]]:
    """Yield the modes that moved alone: change, MAC, and since which log half of it is there."""
    health, track = assessment.health, assessment.track
    # The most probable one, unless a parameter that is above its baseline is the cause.
    is_verdict = assessment.judgement.verdict == OUTSIDE_MAP and not assessment.risen
    for n, lone in enumerate(health.lone_modes if health and track else ()):
        assert track is not None
        if lone.probability < LONE_NAMED and not (is_verdict and n == 0):
            continue
        moved = track.drift[:, track.modes.index(lone.mode)] / lone.size >= 0.5
        before = np.flatnonzero(~moved)
        since = before[-1] + 1 if before.size else 0
        when = track.recorded_at[since] if since < len(track.logs) else None
        yield {"lone": lone, "since": when, "mac": mac.get(lone.mode)}


def _track_content(assessment: Assessment) -> dict[str, Any]:
    """Collect what the page shows of modes, events, covariates and data quality."""
    track, history, stage = assessment.track, assessment.history, assessment.stage
    refused = (*assessment.lost, *assessment.refused)
    content: dict[str, Any] = {"mac": (mac := _mac(assessment)), "largest_drift": 0.0}
    content |= {"modes": [], "events": [], "effects": [], "corrected": {}, "nis": None}
    if track is not None:
        corrected = (e for e in find_covariate_effects(history, track, stage) if e.values.size)
        content |= {
            "modes": latest_modes(track, stage, mac),
            "events": _grouped(track.events, attrgetter("kind", "epoch", "source")).values(),
            "effects": [effect for effect in track.effects if _is_shown(effect)],
            "corrected": _grouped(corrected, attrgetter("covariate")),
            "nis": _nis(track),
            "largest_drift": float(np.nanmax(np.abs(np.expm1(track.drift[-1])), initial=0.0)),
        }
    found = np.isfinite(history.ln_frequency)
    return content | {
        "seen": [mode for mode in history.modes if found[:, history.columns(mode)].any()],
        "uncorrected": list(_uncorrected(history, stage)),
        "outside": list(_outside_map(assessment, mac)),
        "mode_use": list(_mode_use(history, track, stage, assessment.refused)),
        "reasons": Counter(item.reason for item in refused).most_common(),
        "refused": refused,
        "hashes": list(zip(history.logs, assessment.digests, strict=False)),
    }


def _grouped(items: Iterable[Item], key: Callable[[Item], Any]) -> dict[Any, list[Item]]:
    groups: dict[Any, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def _is_shown(effect: Effect) -> bool:
    """Return whether it is one of source, tuning or sensor, or a scale that differs from one."""
    kind, colon, _ = effect.covariate.partition(":")
    scale = abs(effect.coefficient - 1)
    return bool(colon) and (kind != "scale" or scale > constants.SCALE_SHOWN)


def _nis(track: Track) -> dict[str, Any] | None:
    """Count the epochs whose NIS lies in its 95 % interval, and compare their sum with χ²."""
    seen = (track.nis_dof > 0) & np.isfinite(track.nis)
    nis, dof = track.nis[seen], track.nis_dof[seen]
    total = chi_square_side(float(nis.sum()), float(dof.sum()))
    low, high = chi_square_band(dof)
    inside = int(np.sum((nis >= low) & (nis <= high)))
    return total and {"inside": inside, "epochs": nis.size, "side": total["side"]}


def _uncorrected(history: History, stage: Stage) -> Iterator[dict[str, Any]]:
    """Yield covariates without correction: missing, constant, or not described."""
    described = {one.name: one.reference for one in stage.description.covariate}
    for column in dict.fromkeys([*described, *history.covariates]):
        values = history.covariates.get(column, np.empty(0))
        values = values[np.isfinite(values)]
        reference = described.get(column)
        if reference is not None and not values.size:
            yield {"column": column, "why": "missing"}
        elif reference is not None and (values == reference).all():
            yield {"column": column, "why": "constant", "low": reference}
        elif reference is None and values.size and np.ptp(values) > 0:
            ends = {"low": values.min(), "high": values.max()}
            yield {"column": column, "why": "not described", **ends}


def _mode_use(
    history: History, track: Track | None, stage: Stage, refused: Sequence[Refusal]
) -> Iterator[dict[str, Any]]:
    """Yield, per mode, the logs with an estimate, rejected estimates and reasons of refusal."""
    outliers = Counter(mode for _, mode in (() if track is None else track.outliers))
    tracked = [mode.name for mode in stage.modes if mode.tracked]
    for mode in dict.fromkeys([*history.modes, *tracked]):
        found = np.isfinite(history.ln_frequency[:, history.columns(mode)]).any(axis=1)
        reasons = Counter(r.reason for r in refused if r.mode == mode and r.reason != "jump")
        used = {"mode": mode, "found": int(found.sum()), "rejected": outliers[mode]}
        yield used | {"reasons": reasons.most_common()}


def _pace(law: LawPrior, pace: Pace) -> str:
    """Format the prior of the life of a law, or of its rate: median and 90 % interval."""
    low, middle, high = (float(q) for q in pace.quantile(np.array(LEVELS)))
    if law.field == "life_km":
        spread = text.ends(text.coarse(low), text.coarse(high))
        return tr("life {distance} ({interval})", distance=text.km(1e3 * middle), interval=spread)
    low, middle, high = (1e5 * rate for rate in (low, middle, high))  # % per 1,000 km
    spread = text.ends(text.coarse(low), f"{text.coarse(high)}{GAP}%")
    own = {"rate": f"{text.coarse(middle)}{GAP}%", "distance": text.km(1e6), "interval": spread}
    return tr("{rate} per {distance} ({interval})", **own)


def _mac(assessment: Assessment) -> dict[str, float]:
    """Return the MAC of each mode of the last log with that of the baseline."""
    latest, before = assessment.latest, assessment.compared
    if not (latest and latest.shapes and before and before.shapes):
        return {}
    found = latest.shapes.mac_with(before.shapes)
    return {name: one for name, one in zip(latest.shapes.names, found, strict=True) if one >= 0}


def _plots(
    assessment: Assessment, service: Service, content: Mapping[str, Any]
) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield what draws each picture of the machine's life, after its key on the page."""
    history, track, waterfall = assessment.history, assessment.track, assessment.waterfall
    specs = {spec.name: spec for spec in assessment.stage.parameters}
    lives: dict[str, Any] = {"history": history, "track": track}
    for mode in content["seen"]:
        yield ("frequency", mode), partial(figures.plot_frequencies, mode=mode, **lives)
        yield ("damping", mode), partial(figures.plot_damping, mode=mode, **lives)
    if waterfall is not None and history.has_odometer:
        lives["moved"] = track and covariate_shifts(history, track, assessment.stage)
        yield ("waterfall", "all"), partial(figures.plot_waterfall, waterfall=waterfall, **lives)
    for one in chain.from_iterable(content["corrected"].values()):
        plot = partial(figures.plot_influence, influence=one, history=history)
        yield ("influence", one.covariate, one.mode), plot
    if track and content["nis"]:
        yield ("nis", "all"), partial(figures.plot_nis, track=track)
    if (health := assessment.latest_health) is not None:
        for names, title, _ in content["pairs"]:
            plot = partial(figures.plot_posterior, health=health, parameters=names)
            yield ("posterior", title), plot
        for name in health.parameters:
            plot = partial(figures.plot_health, health=health, limit=limit_of(specs[name]))
            yield ("health", name), partial(plot, parameter=name)
    if (prognosis := content["prognosis"]) is not None:
        for name in prognosis.parameters[:-1]:
            plot = partial(figures.plot_life, prognosis=prognosis, baseline=specs[name].baseline)
            yield ("life", name), partial(plot, parameter=name)
        plot = partial(figures.plot_survival, prognosis=prognosis, service=service)
        yield ("survival", "any"), plot


def _log_pictures(assessment: Assessment) -> Iterator[tuple[str, Any, tuple[float, float]]]:
    """Yield what draws the last log beside the one at the baseline, and the size in inches."""
    latest, before, stage = assessment.latest, assessment.compared, assessment.stage
    if latest and latest.spectra:
        plot: Any = partial(plot_spectra, modes=latest.modes, stage=stage, before=before)
        size = spectra_size(latest.spectra, latest.modes)
        yield "latest", partial(plot, summary=latest.spectra), size
    if latest and latest.shapes and (size := shapes_size(latest.shapes, stage))[1]:
        plot = partial(plot_shapes, shapes=latest.shapes, stage=stage)
        yield "shapes", partial(plot, before=before and before.shapes), size


def _pairs(health: Health | None) -> Iterator[tuple[tuple[str, ...], str, float]]:
    """Yield parameters to draw against each other, the title and their correlation."""
    names = health.parameters if health else ()
    if len(names) == 1:
        yield names, spell(names[0]), 0.0
    for i, j in combinations(range(len(names)), 2):
        assert health is not None
        title = tr("{one} against {other}", one=spell(names[i]), other=spell(names[j]))
        yield (names[i], names[j]), title, float(health.correlation[-1, i, j])


# Fleet page

# Names of devices on Windows, with any file name extension.
_DEVICES = re.compile(r"con|prn|aux|nul|(com|lpt)[0-9\u00b9\u00b2\u00b3]", re.IGNORECASE)
_NAME_LENGTH = 60
# Parts of the script that are words.
_WORDS = (
    mark('Collator("en"'),
    mark("`by ${names[heads.indexOf(sorted)].toLowerCase()}, ${sorted.ariaSort}`"),
    mark('"most urgent first"'),
    mark('`${shown} of ${rows.length} stage${rows.length === 1 ? "" : "s"}, ${way}`'),
    mark('"Most urgent first"'),
)


def file_names(identities: Iterable[str]) -> dict[str, str]:
    """Name the pages of machines: valid on every file system and unique regardless of case.

    A machine whose identity is such a name has that, unless it is the name of another page, or
    differs from it by case only.
    """
    taken = {"index", "how-to-read"}
    stems = {}
    for identity in identities:
        stem = re.sub(r"[^\w.-]+", "-", identity).strip("-._")[:_NAME_LENGTH] or "stage"
        is_device = _DEVICES.fullmatch(stem.split(".")[0])
        stems[identity] = f"stage-{stem}" if is_device else stem
    # What must be numbered is last: it takes no name that is the identity of another machine.
    own = [identity.casefold() for identity, stem in stems.items() if identity == stem]
    claims = Counter([*taken, *own])

    def order(identity: str) -> tuple[bool, bool, str]:
        stem = stems[identity]
        return stem != identity, claims[stem.casefold()] > 1, identity

    in_order = sorted(stems, key=order)
    return {identity: f"{free_name(stems[identity], taken)}.html" for identity in in_order}


def by_urgency(summaries: Iterable[Summary]) -> list[Summary]:
    """Sort machines, most urgent first."""
    return sorted(summaries, key=lambda one: one.urgency)


def write_index(
    folder: Path,
    summaries: Iterable[Summary],
    refused: Sequence[Refusal],
    *,
    today: date | None = None,
    gone: Sequence[Status] = (),
) -> Path:
    """Write ``index.html`` and ``how-to-read.html``; the order of the summaries is of no effect.

    ``refused`` are logs that were not analysed; ``today`` is the day of the page, by default
    that of the newest log; ``gone`` are the last statuses of machines without a usable log now.
    """
    ranked = by_urgency(summaries)
    script = read("index.js") if len(ranked) > constants.MANY_MACHINES else ""
    for words in _WORDS:
        script = script.replace(words, tr(words))
    newest = max((utc_day(one.recorded_at) for one in ranked), default=date.min)
    today = today or newest
    by_reason = [
        (reason, count, [one for one in refused if one.reason == reason][: constants.REFUSED_SHOWN])
        for reason, count in Counter(one.reason for one in refused).most_common()
    ]
    content = render(
        "index.html.j2",
        rows=ranked,
        today=today,
        parameters=list(dict.fromkeys(own.name for one in ranked for own in one.health)),
        states=Counter(one.state for one in ranked),
        kinds=Counter(one.service.kind for one in ranked),
        months=_months(ranked, today) if script else [],
        lives=_lives(ranked) if script else [],
        newest=newest,
        refused=by_reason,
        gone=[(one, (folder / one.page).exists()) for one in gone],
        script=script,
    )
    path = folder / "index.html"
    write_text(path, content)
    write_text(folder / "how-to-read.html", render("how_to_read.html.j2"))
    return path


def _lives(summaries: Sequence[Summary]) -> list[tuple[str, int]]:
    """Count machines by their median remaining travel; the last bin is beyond the horizon."""
    median = len(RUL_LEVELS) // 2
    left = [one.life.any.travel[median] / 1000 for one in summaries if one.life]
    edges = [0.0, *constants.LIFE_EDGES, np.inf]
    inner = [tr("to {distance}", distance=text.number(edge)) for edge in edges[1:-1]]
    labels = [tr("passed"), *inner, tr("more"), tr("beyond")]
    places = Counter(int(np.searchsorted(edges, km)) + (km == np.inf) for km in left)
    return [(label, places[k]) for k, label in enumerate(labels)] if left else []


def _months(summaries: Sequence[Summary], today: date) -> list[dict[str, Any]]:
    """Count the services due now and in each month of a year, ``before`` a day; empty without."""
    due = [one.service.by for one in summaries if one.service.by is not None]
    today = min(today, date.max - timedelta(days=31 * (constants.CALENDAR_MONTHS + 1)))
    # Due now: everything due on or before this day.
    counts = Counter(day.replace(day=1) for day in due if day > today)
    now = sum(day <= today for day in due)
    months = [{"label": tr("now"), "year": "", "before": today + timedelta(days=1), "count": now}]
    begin = today.replace(day=1)
    for k in range(constants.CALENDAR_MONTHS):
        year = f"{begin:%Y}" if k == 0 or begin.month == 1 else ""
        after = (begin + timedelta(days=31)).replace(day=1)
        month = {"label": tr_month(begin), "year": year, "before": after, "count": counts[begin]}
        months.append(month)
        begin = after
    return months if any(month["count"] for month in months) else []
