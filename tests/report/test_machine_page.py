"""Pages of healthy, worn, unknown and hostile stages."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from datetime import date, timedelta
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from lmshealth import examples
from lmshealth._private.arrays import FloatArray
from lmshealth.io.log import Notice, Refusal
from lmshealth.life.fleet_prior import FleetPrior, LawPrior
from lmshealth.life.posterior.fit import LoneMode
from lmshealth.life.posterior.likelihood import expected_scatter, scatter_prior
from lmshealth.life.prognosis import Prognosis
from lmshealth.machine.assessment import Assessment, assess
from lmshealth.machine.service import Service, probability_before
from lmshealth.machine.status import make_status, on_day
from lmshealth.machine.summary import summarise as summarise_machine
from lmshealth.modal.identification import read_ambient
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.spectra_summary import summarise
from lmshealth.report import figures as plots
from lmshealth.report.pages import date_page, make_page, write_index
from lmshealth.report.text import GAP, plain
from lmshealth.stage.description import Decision, ScatterPrior, load_stage
from lmshealth.stage.priors import Lognormal, Normal
from lmshealth.tracking.history import Series
from lmshealth.tracking.track import find_covariate_effects
from tests.assessments import (
    Maker,
    Page,
    blind,
    chromium,
    make,
    nothing,
    watch,
    words,
    write_report,
    write_stage,
)
from tests.report.test_readable import seen_in_a_log
from tests.signals import Mode, accelerations, make_log

__all__ = ["make"]

PER_PARAMETER = (
    *("ess_bulk", "ess_tail", "r_hat", "informed", "prior_width"),
    *("judge_shift", "judge_ratio", "at_edge", "identifiable"),
)


@pytest.fixture
def blank(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave pictures out where a test reads words only."""
    monkeypatch.setattr(plots, "svg", lambda draw, *, salt, size: f'<svg id="{salt}"></svg>')


def one(folder: Path, assessment: Assessment) -> Page:
    """Write the page of one stage and read it."""
    return Page(write_report(folder / "out", [assessment], ())[0])


@pytest.mark.usefixtures("blank")
def test_the_first_screen_of_a_worn_stage(make: Maker, tmp_path: Path) -> None:
    """Verdict, probability, reason, date and remaining life are on the first screen."""
    assessment = make()
    by = assessment.service().by
    assert by is not None
    text = words(one(tmp_path, assessment))
    first = text[: text.index("Frequencies and damping")]
    for part in ("Loss of guide preload and mount stiffness", "93 % probability", "Roll, pitch"):
        assert part in first
    assert f"By {by.isoformat()}" in first and "accepted risk of 5 %" in first
    assert re.search(r"Median [\d ]+ km [\d ]+ days", first)
    assert "service planned for 2027-03-01" in first
    work = "a preload adjustment and a tightening of the mount"
    plan = f"Order and plan {work} before {by.isoformat()}; until then a log"
    assert plan in first.replace("\u2011", "-")
    assert "Guide preload over 1 600 km: 1" in plain(first) and "limit of 60 %" in plain(first)
    assert assessment.prognosis is not None
    late = [probability_before(assessment.prognosis, by + timedelta(7 * k)) for k in (1, 8)]
    for weeks, risk in zip(("1 week", "8 weeks"), late, strict=True):
        day = (by + timedelta(7 * int(weeks[0]))).isoformat()
        shown = float(re.search(rf"{day} {weeks} (\d+) %", plain(first))[1])  # type: ignore[index]
        assert shown == pytest.approx(100 * float(risk[1, -1]), abs=1.5)
    assert (
        first.index("Loss of")
        < first.index("Health at the last log")
        < first.index("Remaining life")
    )


@pytest.mark.slow
def test_the_last_log_stands_beside_the_baseline(make: Maker, tmp_path: Path) -> None:
    """Spectrum and shapes of both, the MAC of each mode in the table, and the state by NE 107."""
    latest, before = seen_in_a_log(), seen_in_a_log("log-1.h5", seed=3)
    made = replace(make(), latest=latest, at_baseline=before)
    text = words(one(tmp_path, made))
    assert latest.shapes is not None and before.shapes is not None
    mac = dict(zip(latest.shapes.names, latest.shapes.mac_with(before.shapes), strict=True))
    row = text[text.index("MAC with baseline") : text.index("Spectrum of the last log")]
    assert re.search(rf"roll .* {mac['roll']:.3f} pitch", row) and "yaw" in row
    for part in ("first log of the baseline (log-1.h5)", "Shapes of the modes", "mode at the base"):
        assert part in text
    assert re.search(r"NAMUR NE 107 on [\d‑]+: maintenance required \(M\) \(loss", text)
    alone = words(one(tmp_path, replace(made, at_baseline=latest)))
    assert "Shapes of the modes" in alone and "MAC" not in alone


@pytest.mark.usefixtures("blank")
def test_what_is_new_follows_the_first_screen(make: Maker, tmp_path: Path) -> None:
    """The earlier report of this stage is compared with, another stage's is not."""
    earlier = make(wear_km=400000, floor=0.98)
    before = replace(summarise_machine(earlier, earlier.service()), n_logs=28)
    for identity, expected in (
        ("M7-Y", "Verdict: healthy (97 %) → loss of guide preload and mount stiffness (93 %)."),
        ("M8-Y", "This is the first report on this stage"),
    ):
        page = Page(write_report(tmp_path, [make()], (), earlier={identity: before})[0])
        text = words(page)
        place = text.index(expected)
        assert text.index("What was noticed") < place < text.index("Tracked modes")
        assert ("on 28 logs up to" in text) == (identity == "M7-Y")


@pytest.mark.usefixtures("blank")
def test_numbers_are_those_of_the_results(make: Maker, tmp_path: Path) -> None:
    """Median and interval of a gauge, and the quantiles of the life, are those of the draws."""
    assessment = make()
    assert assessment.health is not None and assessment.prognosis is not None
    text = words(one(tmp_path, assessment))
    low, middle, high = 100 * assessment.health.quantile(np.array([0.05, 0.5, 0.95]))[:, -1, 0]
    assert f"{middle:.0f} % of baseline, 90 % interval {low:.0f} to {high:.0f} %" in text
    km = np.median(assessment.prognosis.remaining[:, -1]) / 1000
    shown = float(re.search(r"Median ([\d ]+) km", text)[1].replace(" ", ""))  # type: ignore[index]
    assert shown == pytest.approx(km, rel=0.01)


@pytest.mark.usefixtures("blank")
def test_a_mode_outside_the_map_is_helped_with(make: Maker, tmp_path: Path) -> None:
    """Which mode, since which log half of its change is there, and what to check first."""
    made = make()
    track, health = made.track, made.health
    assert track is not None and health is not None
    drift = track.drift.copy()
    drift[:, 1] = np.where(np.arange(len(track.logs)) < 25, -0.004, -0.021)
    moved = replace(
        made,
        track=replace(track, drift=drift),
        health=replace(health, lone_modes=(LoneMode("pitch", -0.02, 0.001, 0.4),)),
        judgement=replace(made.judgement, verdict="outside-map"),
    )
    text = words(one(tmp_path, moved))
    help_text = text[
        text.index("cause outside the map Pitch") : text.index("Since the last report")
    ]
    assert "has moved by −1.98" in help_text
    assert f"since the log of {track.recorded_at[25].date()}" in help_text
    assert help_text.index("What was done") < help_text.index("Sensor and cables")
    assert "What to check" in text and 'href="#outside"' in one(tmp_path, moved).source
    # A mode that is neither the verdict nor probable needs no help.
    lost = replace(moved, judgement=made.judgement)
    assert "cause outside the map Pitch" not in words(one(tmp_path, lost))


@pytest.mark.usefixtures("blank")
def test_a_parameter_above_its_baseline_is_helped_with(make: Maker, tmp_path: Path) -> None:
    """What may have raised it is listed, and no mode that hardly moved alone is named."""
    made = make()
    assert made.health is not None
    lone = (LoneMode("roll", 0.01, 0.002, 0.04),)
    raised = replace(
        made,
        health=replace(made.health, chains=1.6 * made.health.chains, lone_modes=lone),
        judgement=replace(made.judgement, verdict="outside-map"),
    )
    text = words(one(tmp_path, raised))
    helped = text[text.index("moved by a cause outside the map Check") :]
    helped = helped[: helped.index("Since the last report")]
    assert "Work since the baseline." in helped
    assert "alone" not in helped
    assert 'href="#outside"' in one(tmp_path, raised).source


@pytest.mark.usefixtures("blank")
def test_an_undetermined_parameter_shows_no_number(make: Maker, tmp_path: Path) -> None:
    """An undetermined parameter is named as such on the bar, in the table and on the fleet page."""
    page = one(tmp_path, blind(make()))
    text = words(page)
    gauge = text[text.index("Mount stiffness") : text.index("Service")]
    assert "Not determined by these logs" in gauge and "of baseline" not in gauge
    assert "Depends on the prior" in text
    assert 'class="bar prior"' in page.source
    assert "not determined" in words(Page(tmp_path / "out" / "index.html"))


@pytest.mark.usefixtures("blank")
def test_a_page_without_results_gives_the_reasons(make: Maker, tmp_path: Path) -> None:
    """A page without track, health and prognosis gives the reason for each."""
    bare = nothing(make())
    text = words(one(tmp_path, replace(bare, history=replace(bare.history, baselines=(38,)))))
    assert "Not enough data for a verdict" in text
    assert "No log contains an estimate of a tracked mode" in text
    assert "usable logs since the baseline began: 2, needed 5." in text
    assert "No remaining life without health parameters" in text
    assert not re.search(r"\bnan\b", text.lower())
    untracked = replace(make(), track=None)
    assert "could not be tracked" in words(one(tmp_path, untracked))


@pytest.mark.usefixtures("blank")
def test_the_number_of_logs_is_no_reason_where_it_suffices(make: Maker, tmp_path: Path) -> None:
    """Of a parked machine the page has the notice of the step that failed, else of its verdict."""
    logs = examples.readings()[:6]
    parked = [replace(log, metadata=replace(log.metadata, travel=5e3)) for log in logs]
    text = words(one(tmp_path / "parked", assess(parked, load_stage("lms-y"))))
    part = text[text.index("Health at the last log") : text.index("Remaining life")]
    assert "over 0 km; a life needs at least 3 logs and some travel" in part
    without = one(tmp_path / "bare", nothing(make()))  # 40 logs, and no notice
    assert words(without).count("2 logs so far; a baseline needs 5.") == 3
    assert not re.search(r"since the baseline began: \d+, needed", text + words(without))


@pytest.mark.usefixtures("blank")
def test_health_of_a_machine_that_is_not_the_described_one_is_withheld(tmp_path: Path) -> None:
    """Declared and found frequencies stand side by side, with a warning in place of health."""
    stage = load_stage("lms-y")
    roll, *others = stage.modes
    moved = structs.replace(roll, frequency_hz=1.05 * roll.frequency_hz)
    description = structs.replace(stage.description, mode=(moved, *others))
    found = assess(examples.readings(), replace(stage, description=description))
    assert found.track is not None
    assert found.health is None and found.prognosis is None
    text = words(one(tmp_path, found))
    assert "Warning: The names of the modes are in doubt" in text
    assert f"roll {moved.frequency_hz:.5g} Hz and 126." in text
    assert "Withheld: The names of the modes are in doubt" in text
    assert f"roll {moved.frequency_hz:.2f} Hz 126." in text


def test_no_log_at_all(make: Maker, tmp_path: Path) -> None:
    """A history without logs is a page, not a failure."""
    bare = nothing(make())
    history = bare.history
    empty = replace(
        history,
        logs=(),
        recorded_at=(),
        travel=history.travel[:0],
        covariates={},
        ln_frequency=history.ln_frequency[:0],
        ln_damping=history.ln_damping[:0],
        cov=history.cov[:0],
        loop_error=history.loop_error[:0],
    )
    text = words(one(tmp_path, replace(bare, history=empty, digests=(), waterfall=None)))
    assert "0 logs used" in text
    assert "No log contains an estimate of a tracked mode" in text


@pytest.mark.usefixtures("blank")
def test_healthy_stage_without_visible_end(make: Maker, tmp_path: Path) -> None:
    """A life beyond the horizon is censored: no date, no number."""
    assessment = make(wear_km=400000, floor=0.98)
    assert assessment.prognosis is not None
    endless = np.where(assessment.prognosis.remaining > 2e7, np.inf, 3e7)
    assessment = replace(assessment, prognosis=replace(assessment.prognosis, remaining=endless))
    text = words(one(tmp_path, assessment))
    assert "No service needed yet" in text
    assert "No end of life within 20 000 km" in text
    seen = assessment.history.travel[-1] - assessment.history.travel[0]
    assert f"The logs cover {seen / 1000:,.0f}".replace(",", " ") in text
    assert "beyond 20 000 km" in text


@pytest.mark.usefixtures("blank")
def test_limit_already_passed_means_now(make: Maker, tmp_path: Path) -> None:
    """Where the accepted risk is used up already, the service is due now."""
    assessment = make()
    assert assessment.prognosis is not None
    late = replace(assessment.prognosis, remaining=assessment.prognosis.remaining - 2e6)
    text = words(one(tmp_path, replace(assessment, prognosis=late)))
    assert "Service Now" in text and "already passed" in text


@pytest.mark.usefixtures("blank")
def test_a_day_of_least_cost_is_named_as_such(make: Maker, tmp_path: Path) -> None:
    """With a ratio of costs page, table and picture have the day of least costs and its risk."""
    assessment = make()
    by_costs = Decision(cost_ratio=3.0)
    stage = assessment.stage
    chosen = replace(stage, description=structs.replace(stage.description, decision=by_costs))
    assessment = replace(assessment, stage=chosen)
    service = assessment.service()
    assert service.by is not None and service.by != make().service().by
    text = words(one(tmp_path, assessment))
    assert f"By {service.by.isoformat()} Day of least cost per travel" in text
    assert "a failure costs 3 times a planned service" in text
    assert "risk at least cost" in text and "accepted risk" not in text
    # By the calendar, not by the days since the last log, which may be an old one.
    assert assessment.urgency(service)[1] == service.by.toordinal()
    healthy = replace(assessment, prognosis=endless(assessment))
    assert "reduces the cost; a failure costs 3 times" in words(one(tmp_path, healthy))


def endless(assessment: Assessment) -> Prognosis:
    """Return the life of a machine that never reaches a limit."""
    assert assessment.prognosis is not None
    never = np.full_like(assessment.prognosis.remaining, np.inf)
    return replace(assessment.prognosis, remaining=never)


@pytest.mark.slow
def test_one_parameter_without_limit(make: Maker, tmp_path: Path) -> None:
    """A stage with one parameter and no limit has a density, and the reason for no life."""
    (tmp_path / "one").mkdir()
    stage = write_stage(tmp_path / "one", limited=False, parameters=1)
    assessment = make()
    health = assessment.health
    assert health is not None
    single = replace(
        health,
        parameters=health.parameters[:1],
        chains=health.chains[..., :1],
        correlation=health.correlation[:, :1, :1],
        **{name: getattr(health, name)[:, :1] for name in PER_PARAMETER},
    )
    text = words(one(tmp_path, replace(assessment, stage=stage, health=single, prognosis=None)))
    assert "sets no limit" in text
    assert "Now: guide preload" in text


@pytest.mark.usefixtures("blank")
def test_a_bad_fit_of_the_laws_is_reported(make: Maker, tmp_path: Path) -> None:
    """A bad fit and a large random walk are reported in words."""
    assessment = make()
    assert assessment.prognosis is not None
    bad = replace(assessment.prognosis, chi_square=400.0, walk=0.04)
    text = words(one(tmp_path, replace(assessment, prognosis=bad)))
    assert "The laws do not fit the logs" in text
    assert "random walk of 4.00 %" in text


@pytest.mark.usefixtures("blank")
def test_names_are_escaped(make: Maker, tmp_path: Path) -> None:
    """Markup in names and reasons stays text, and names no file outside the folder."""
    evil = "../<script>alert(1)</script>"
    assessment = make(evil)
    refusal = Refusal(log=evil, reason=f'"{evil}', detail="'><img src=x onerror=alert(1)>")
    assessment = replace(
        assessment, refused=(refusal,), notices=(Notice("new-baseline", "note", evil, evil, evil),)
    )
    paths = write_report(tmp_path / "out", [assessment], [refusal])
    assert {path.parent for path in paths} == {tmp_path / "out"}
    for path in paths:
        page = Page(path)
        assert "script" not in page.tags and "img" not in page.tags
        assert evil in page.text


@pytest.mark.usefixtures("blank")
def test_files_never_collide(make: Maker, tmp_path: Path) -> None:
    """Identities that differ only in case or signs get pages of their own; none is the index."""
    base = nothing(make())
    names = ["A 1", "A/1", "a-1", "index", "..", "Führung"]
    stages = [replace(base, judgement=replace(base.judgement, stage=name)) for name in names]
    paths = write_report(tmp_path / "out", stages, ())
    assert len({path.name.casefold() for path in paths}) == len(names) + 1
    assert {"Führung.html", "index-2.html", "stage.html"} <= {path.name for path in paths}
    again = write_report(tmp_path / "again", stages[::-1], ())
    assert [path.name for path in again] == [path.name for path in paths]


@pytest.mark.slow
def test_same_input_same_bytes(make: Maker, tmp_path: Path) -> None:
    """Pages are reproducible to the byte in any order, and have the day that they are given."""
    stages = [make(), nothing(make("M8-Y"))]
    first = write_report(tmp_path / "a", stages, ())
    second = write_report(tmp_path / "b", stages[::-1], ())
    assert [p.name for p in first] == [p.name for p in second]
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]
    for page in write_report(tmp_path / "c", stages[1:], (), today=date(2027, 1, 2)):
        assert "Written on 2027-01-02, last log 2026-10-12" in page.read_text(encoding="utf-8")


@pytest.mark.usefixtures("blank")
def test_a_page_needs_no_other_one(make: Maker, tmp_path: Path) -> None:
    """Made alone, the same page and the same rows come out."""
    stages = [make(), nothing(make("M8-Y"))]
    *pages, index = write_report(tmp_path / "a", stages, ())
    rows = [
        summarise_machine(stage, stage.service(), path.name)
        for stage, path in zip(stages, pages, strict=True)
    ]
    for stage, row, path in zip(stages, rows, pages, strict=True):
        status, today = make_status(stage, row), row.recorded_at.date()
        page = date_page(make_page(stage, row), on_day(row, status, today), status)
        assert page == path.read_text(encoding="utf-8")
    again = write_index(tmp_path, rows[::-1], ())
    assert again.read_bytes() == index.read_bytes()


@pytest.mark.usefixtures("blank")
def test_days_of_a_postponed_service_are_not_past(make: Maker, tmp_path: Path) -> None:
    """An overdue service has the days that are left, with the risks that they had before."""

    def rows(today: date | None) -> dict[str, str]:
        """Return probabilities by day of service."""
        (path, _) = write_report(tmp_path, [make()], (), today=today)
        text = words(Page(path))
        return dict(re.findall(r"(\d{4}-\d\d-\d\d) \d+ weeks? (\D*[\d.]+ %)", text))

    by = make().service().by
    assert by is not None
    before, after = rows(by), rows(by + timedelta(days=20))
    assert [date.fromisoformat(one) - by for one in before] == [
        timedelta(weeks=weeks) for weeks in (1, 2, 4, 8)
    ]
    assert [date.fromisoformat(one) - by for one in after] == [
        timedelta(weeks=weeks) for weeks in (4, 8, 13, 26, 52)
    ]
    assert all(after[one] == before[one] for one in before.keys() & after.keys())


@pytest.mark.slow
def test_the_service_is_decided_once_per_page(make: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first screen, what is new, the pictures and the row of the index share one decision."""
    assessment, asked = make(), list[Assessment]()
    decided = assessment.service()
    summary = summarise_machine(assessment, decided)

    def decide(self: Assessment) -> Service:
        asked.append(self)
        return decided

    monkeypatch.setattr(Assessment, "service", decide)
    make_page(assessment, summary, before=summary)
    assert asked == []


@pytest.mark.usefixtures("blank")
def test_index_is_sorted_by_risk(make: Maker, tmp_path: Path) -> None:
    """The worst stage comes first, an unknown one before the healthy one."""
    safe = make("safe", wear_km=400000, floor=0.98)
    assert safe.prognosis is not None
    safe = replace(safe, prognosis=replace(safe.prognosis, remaining=np.full((4000, 3), np.inf)))
    worn = make("worn")
    stages = [safe, nothing(make("unknown")), worn]
    refused = [Refusal("stray.csv", "no stage", "no description takes stage 'Q'")]
    paths = write_report(tmp_path / "out", stages, refused)
    assert [path.stem for path in paths] == ["worn", "unknown", "safe", "index"]
    text = words(Page(paths[-1]))
    assert text.index("worn") < text.index("unknown") < text.index("safe") < text.index("stray.csv")
    assert f"By {worn.service().by}" in text


def test_empty_fleet(tmp_path: Path) -> None:
    """Without any stage the fleet page is written, with a sentence."""
    paths = write_report(tmp_path / "out", [], ())
    assert [path.name for path in paths] == ["index.html"]
    assert "No log belongs to a stage" in Page(paths[0]).text


@pytest.mark.slow
def test_a_page_is_self_contained_and_well_formed(make: Maker, tmp_path: Path) -> None:
    """Nothing is loaded from outside, identifiers are unique, headings descend by one."""
    paths = write_report(tmp_path / "out", [make()], ())
    examples = Page(paths[0].with_name("how-to-read.html"))
    linked = {
        a.partition("#")[2] for a in Page(paths[0]).loads if a.startswith("how-to-read.html#")
    }
    assert linked and linked <= set(examples.ids)
    for path in [*paths, paths[0].with_name("how-to-read.html")]:
        page = Page(path)
        assert "http:" not in page.source and "https:" not in page.source
        allowed = ("#", "data:", "index.html", "M7-Y.html", "how-to-read.html")
        assert all(address.startswith(allowed) for address in page.loads), page.loads
        assert len(page.ids) == len(set(page.ids))
        assert {a[1:] for a in page.loads if a.startswith("#")} <= set(page.ids)
        assert page.headings[0] == 1 and page.headings.count(1) == 1
        assert all(b <= a + 1 for a, b in pairwise(page.headings))
        assert '<html lang="en">' in page.source and "Content-Security-Policy" in page.source
        assert all("scope=" in tag for tag in re.findall("<th[ >][^>]*", page.source))


def test_a_life_by_the_time_has_no_odometer(make: Maker, tmp_path: Path) -> None:
    """No heading, axis or description of a picture names one. Control: a machine that has it.

    The travel of its logs is that of its life, beside a service that is beyond the horizon.
    """
    known = make(wear_km=400000, floor=0.98)
    assert known.service().kind == "later"
    unknown = np.full_like(known.history.travel, np.nan)
    assert known.track is not None
    history = replace(known.history, travel=unknown)
    bare = replace(known, history=history, track=replace(known.track, travel=unknown))
    assert "odometer in km" in one(tmp_path / "known", known).source
    found = one(tmp_path / "bare", bare).source
    assert "odometer" not in found.casefold()
    assert "days since the first log" in found and "travel in km" in found
    assert f"nan{GAP}km" not in found
    assert f"The logs cover 1{GAP}600{GAP}km since the baseline." in found


@pytest.mark.usefixtures("blank")
def test_corrected_covariates_are_reported(make: Maker, tmp_path: Path) -> None:
    """The page contains range, reference, coefficient and scatter of a covariate."""
    assessment = make()
    found = find_covariate_effects(assessment.history, assessment.track, assessment.stage)  # type: ignore[arg-type]
    text = words(one(tmp_path, assessment))
    part = text[text.index("Effects other than wear") : text.index("Health over travel")]
    values = assessment.history.covariates["temperature_c"]
    low, high = values.min(), values.max()
    assert (
        f"Range in these logs: {low:.4g} to {high:.4g} °C. Frequencies are given at 21 °C." in part
    )
    assert "−0.012 ± 0.002 % per °C" in part
    assert f"{100 * found[0].measured.std():.2f} %" in part
    assert f"{100 * found[0].corrected.std():.2f} %" in part


@pytest.mark.usefixtures("blank")
def test_uncorrected_covariates_are_reported(make: Maker, tmp_path: Path) -> None:
    """Missing, constant and undescribed covariates are reported."""
    assessment = make()
    n = len(assessment.history.logs)

    def page(covariates: dict[str, FloatArray]) -> str:
        history = replace(assessment.history, covariates=covariates)
        return words(one(tmp_path, replace(assessment, history=history)))

    assert "No log contains temperature" in page({})
    text = page({"temperature_c": np.full(n, 21.0), "payload_kg": np.linspace(2, 5, n)})
    assert "Temperature was 21 °C in all logs." in text
    assert "Payload ranged from 2 to 5 kg, but the stage description does not name it" in text


@pytest.mark.usefixtures("blank")
def test_use_of_the_logs_is_counted(make: Maker, tmp_path: Path) -> None:
    """The page counts logs, outliers and reasons per mode."""
    assessment = make()
    assert assessment.track is not None
    track = replace(assessment.track, outliers=((5, "pitch"), (9, "pitch")))
    text = words(one(tmp_path, replace(assessment, track=track)))
    part = text[text.index("Data used") : text.index("Fit of the laws")]
    assert "based on 40 logs of this machine" in part
    assert "2 parts refused: 1 × not excited, 1 × gap." in part
    assert "roll 39 of 40 (98 %) none 1 × not excited" in part
    assert "pitch 40 of 40 (100 %) 2 –" in part
    assert "logs/0007.csv mode roll by acc, channel acc_feed not excited" in part
    assert "logs/x.csv whole log gap" in part


@pytest.mark.usefixtures("blank")
def test_without_spectra_there_is_no_waterfall(make: Maker, tmp_path: Path) -> None:
    """Logs that do not show the band leave the picture and its text out."""
    assert "Spectra over life" in words(one(tmp_path, make()))
    assert "Spectra over life" not in words(one(tmp_path, replace(make(), waterfall=None)))


def hostile(assessment: Assessment, evil: str) -> Assessment:
    """Put markup wherever a name comes from outside: modes, logs, lines, notes, refusals."""
    history, track, waterfall = assessment.history, assessment.track, assessment.waterfall
    assert track is not None and waterfall is not None
    modes = (evil, *history.modes[1:])
    logs = (f"{evil}.csv", *history.logs[1:])
    effects = tuple(replace(e, mode=evil) if e.mode == "roll" else e for e in track.effects)
    line = replace(waterfall.lines[0][0], kind=evil, channel=evil)
    history = replace(
        history, modes=modes, logs=logs, series=tuple(Series(mode, "acc") for mode in modes)
    )
    return replace(
        assessment,
        history=history,
        track=replace(track, modes=modes, logs=logs, effects=effects),
        waterfall=replace(waterfall, lines=((line,), *waterfall.lines[1:])),
        refused=(Refusal(evil, evil, evil, mode=evil, channel=evil, source=evil),),
        notices=(Notice("new-baseline", "note", evil, evil, evil),),
        judgement=replace(assessment.judgement, stage=evil, why=evil),
    )


@pytest.mark.slow
def test_numbers_of_a_page_agree_and_are_grounded(make: Maker, tmp_path: Path) -> None:
    """The odometer is whole, and the largest drift and the sizes of samples are those of tables."""
    worn = make()
    assert worn.prognosis is not None and worn.track is not None
    drift = 100 * np.abs(np.expm1(worn.track.drift[-1])).max()
    path = write_report(tmp_path / "a", [worn], ())[0]
    text = path.read_text()
    odometer = f"{worn.history.travel[-1] / 1000:,.0f}".replace(",", "\u202f")
    assert f"odometer {odometer}\u202fkm" in text
    assert f"largest drift: {drift:.2f}\u202f%" in text
    assert worn.health is not None
    assert f"<td>{worn.health.ess[-1, 0]:.0f}</td>" in text
    travel = np.full_like(worn.history.travel, np.nan)
    lost = replace(worn, history=replace(worn.history, travel=travel), prognosis=None)
    assert "odometer nan" not in write_report(tmp_path / "c", [lost], ())[0].read_text()


SCATTER = ScatterPrior((0.0, 1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0))
LEARNED = FleetPrior(
    n_machines=25,
    laws=(
        LawPrior(
            "guide_preload",
            "hertz-wear",
            (0.5, 0.82),
            "life_km",
            (Lognormal(8000, 1.0), Lognormal(4100, 0.5)),
        ),
        LawPrior("guide_preload", "none", (0.5, 0.18), "", None),
        LawPrior(
            "belt", "linear", (1.0, 1.0), "rate_per_km", (Normal(0, 1e-4), Normal(2e-5, 5e-5))
        ),
    ),
    scatter=SCATTER,
)


@pytest.mark.usefixtures("blank")
def test_the_prior_of_the_fleet_is_on_the_page(make: Maker, tmp_path: Path) -> None:
    """Shares, medians and 90 % intervals are those of the priors; scatter is shown by its means."""
    assessment = make()
    texts = [
        words(one(tmp_path, found)) for found in (assessment, replace(assessment, fleet=LEARNED))
    ]
    heading = "Prior learned from the fleet"
    assert heading not in texts[0]
    text = texts[1].replace(GAP, " ")
    part = text[text.index(heading) : text.index("Data quality", text.index(heading))]
    for expected in (
        "learned from 25 other machines with the description lms-y",
        "guide preload, wear of the contacts (Hertz) 50 %; life 8 000 km (1 540 to 41 400) "
        "82 %; life 4 100 km (1 800 to 9 330)",
        "guide preload, no change 50 % 18 %",
        "above 99 %; 2 % per 1 000 km (−6.2 to 10 %)",
        "random walk of ln frequency 0.16 % 0.05 %",
        "factor on reported errors 1.07 1.50",
        "deviation of health from its law 0.88 % 0.00 %",
    ):
        assert expected in part, expected


def test_expected_scatter_is_that_of_the_prior() -> None:
    """The default scatter applies to every stage; a learned one replaces it."""
    stage = load_stage("lms-y")
    assert expected_scatter(scatter_prior(replace(stage, scatter=SCATTER))) == (5e-4, 1.5, 0.0)
    assert scatter_prior(stage) == scatter_prior(replace(stage, digest="another"))


@pytest.mark.slow
@pytest.mark.parametrize("evil", ["", "<script>alert(1)</script>"])
def test_browser_opens_it_offline(
    make: Maker, tmp_path: Path, needs: Callable[[str], None], evil: str
) -> None:
    """Both pages open in both schemes and on a phone: no error, no request, no sideways scroll.

    So they do where every name is a script, which stays text.
    """
    needs("chromium")
    assessment = hostile(make(), evil) if evil else blind(make())
    paths = write_report(tmp_path / "out", [assessment], ())
    with chromium() as browser:
        for path in paths:
            for scheme, width in (("light", 1280), ("dark", 1280), ("light", 390), ("dark", 390)):
                page, seen = watch(browser, path, scheme, width)
                assert seen == []
                assert page.evaluate("document.documentElement.scrollWidth") <= width
                assert page.locator("script").count() == 0
                assert evil in page.locator("body").inner_text()
                page.context.close()


@pytest.mark.slow
def test_browser_shows_every_picture_and_prints(
    make: Maker, tmp_path: Path, needs: Callable[[str], None]
) -> None:
    """No picture is empty, the waterfall's image has loaded, titles show, and the page prints."""
    needs("chromium")
    path = write_report(tmp_path / "out", [make()], ())[0]
    with chromium() as browser:
        page, seen = watch(browser, path)
        boxes = [picture.bounding_box() for picture in page.locator("figure svg").all()]
        assert len(boxes) == page.locator("figure").count() == 17
        assert all(box["width"] > 200 and box["height"] > 100 for box in boxes)
        assert page.locator("figure svg:not([aria-hidden=true])").count() == 0
        assert page.locator("figure div[role=img]:not([aria-label])").count() == 0
        image = page.locator("figure svg image").first
        loaded = """async (image) => {
            const copy = new Image();
            copy.src = image.href.baseVal;
            await copy.decode();
            return copy.naturalWidth;
        }"""
        assert image.evaluate(loaded) > 400
        # What the pointer meets in the middle of a column is what carries its title.
        column = page.locator(".hint", has=page.locator("title", has_text="mains line")).first
        column.scroll_into_view_if_needed()
        box = column.bounding_box()
        met = page.evaluate(
            "([x, y]) => document.elementFromPoint(x, y).closest('.hint')?.textContent",
            [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2],
        )
        assert "mains line at 150.00" in met
        paper = page.pdf()
        assert paper.startswith(b"%PDF") and len(paper) > 100_000
        assert seen == []


@pytest.mark.slow
def test_the_spectrum_of_the_last_log_is_explained_and_names_what_is_missing(
    make: Maker, tmp_path: Path
) -> None:
    """The figure of the fit, its caption, and the reason of a refused mode."""
    stage = load_stage("lms-y")
    rng = np.random.default_rng(2)
    modes = [Mode(126.4, 0.015), Mode(136.4, 0.015)]
    log = make_log({"acc_pitch": accelerations(rng, modes, 20_000, 1000.0, 1.0)[0]}, 1000.0)
    reading = read_ambient(log, stage)
    spectra = summarise(reading.spectra, reading.fitted, reading.modes, (110.0, 180.0), 100)
    latest = LogEstimates("log-9.h5", log.digest, log.metadata, reading.modes, spectra=spectra)
    page = one(tmp_path, replace(make(), latest=latest))
    text = words(page)
    caption = text[text.index("Spectrum of the last log") :]
    assert "log-9.h5" in caption and "natural frequency of the machine" in caption
    assert "Dashed: not used in this log. Yaw, not-excited: no resonance near 15" in caption
    assert "A peak with neither a blue nor a dashed line is a disturbance" in caption
