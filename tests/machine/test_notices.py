"""Notices of a machine: each by its cause, and none without one."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from lmshealth._private.tables import FLAGS, TABLES
from lmshealth.io.log import Refusal
from lmshealth.life.posterior.fit import LoneMode
from lmshealth.machine.assessment import assess
from lmshealth.machine.status import make_status, notices
from lmshealth.machine.summary import summarise
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.report.language import in_language, sentence
from lmshealth.report.text import changes, headline, service_on_day
from lmshealth.stage.description import load_stage
from lmshealth.tracking.history import Step
from lmshealth.tracking.maintenance import Action, Maintenance
from tests.assessments import Assessment, Maker, make, nothing, tables_of
from tests.lives import FREQUENCY, MODES, START, make_reading, make_stage

__all__ = ["make"]


def codes(assessment: Assessment) -> set[str]:
    """Return the codes of what is noticed beyond the notice of the logs."""
    return {one.code for one in notices(assessment)} - {"mode-missing"}


def test_a_machine_that_its_model_fits_has_no_notices(make: Maker) -> None:
    """Without results there are none either."""
    assert codes(make()) == set()
    assert codes(nothing(make())) == set()


@pytest.mark.parametrize("code", [
    "names-in-doubt", "filter-inconsistent", "unexplained-drifts", "end-of-map",
    "limit-not-included", "laws-do-not-fit", "last-logs-left-out", "step-suspected",
    "above-baseline", "baseline-left-out",
])  # fmt: skip
def test_each_cause_has_its_notice(make: Maker, code: str) -> None:
    """What is wrong is noticed by its code, in words, and with the place."""
    good = make()
    health, prognosis, track = good.health, good.prognosis, good.track
    assert health is not None and prognosis is not None and track is not None
    last = np.arange(len(health.recorded_at)) == len(health.recorded_at) - 1
    wrong: dict[str, dict[str, Any]] = {
        "names-in-doubt": {"doubt": "The names of the modes are in doubt."},
        "filter-inconsistent": {"track": replace(track, nis=track.nis * 9)},
        "unexplained-drifts": {"health": replace(health, fit=np.where(last, 1e-9, health.fit))},
        "above-baseline": {"health": replace(health, chains=1.6 * health.chains)},
        "end-of-map": {"health": replace(health, at_edge=np.ones_like(health.at_edge))},
        "limit-not-included": {
            "prognosis": replace(prognosis, unidentifiable=("mount_stiffness",))
        },
        "laws-do-not-fit": {"prognosis": replace(prognosis, chi_square=1e4)},
        "step-suspected": {"track": replace(track, suspected=Step.found("step", 4, 9))},
        "baseline-left-out": {"track": replace(track, outliers=((good.history.baseline, "roll"),))},
        "last-logs-left-out": {"track": replace(track, outliers=((len(track.logs) - 1, "roll"),))},
    }
    bad = replace(good, **wrong[code])
    assert codes(bad) == {code}
    (row, *_) = [row for row in tables_of(bad)["warnings"] if row["code"] == code]
    assert tuple(row) == TABLES["warnings"].names
    assert row["what"].endswith(".")


def test_a_mode_that_moves_alone_is_noticed_from_a_half(make: Maker) -> None:
    """With its size and what to check; one that is improbable is not named."""
    good = make()
    assert good.prognosis is not None
    for probability in (0.49, 0.5):
        lone = LoneMode("yaw", -0.02, 0.001, probability)
        off = replace(good, prognosis=replace(good.prognosis, modes_off=(lone,)))
        found = [one for one in notices(off) if one.code == "mode-off-map"]
        assert len(found) == (probability >= 0.5)
    assert "Yaw has moved by −2.0 ± 0.1 % alone" in found[0].what
    assert found[0].where == "yaw"


def test_a_parameter_in_newton_is_compared_with_its_own_baseline(make: Maker) -> None:
    """Health in units of its own is the same fraction on pages."""
    good = make()
    assert good.health is not None and good.prognosis is not None
    preload, mount = good.stage.description.parameter
    assert preload.limit is not None
    limit = structs.replace(preload.limit, below=5e3 * preload.limit.below)
    in_newton = structs.replace(preload, baseline=5e3, unit="N", limit=limit)
    described = structs.replace(good.stage.description, parameter=(in_newton, mount))
    prognosis = replace(
        good.prognosis,
        limits=good.prognosis.limits * [5e3, 1, 1],
        health=good.prognosis.health * [5e3, 1],
    )
    health = replace(good.health, chains=good.health.chains * [5e3, 1])
    own = replace(
        good,
        stage=replace(good.stage, description=described),
        health=health,
        prognosis=prognosis,
    )
    assert codes(own) == set()
    found, expected = (summarise(one, one.service()).health[0] for one in (own, good))
    for name in ("low", "median", "high", "limit", "below_limit"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name))


@pytest.mark.parametrize(
    ("reason", "channel", "severity"),
    [("levels", "acc_x", "caution"), ("spikes", "acc_x", "note"), ("flat", "acc_x", None)],
)
def test_warnings_about_channels_are_noticed(
    make: Maker, reason: str, channel: str, severity: str | None
) -> None:
    """What is repaired is a note, what is not a caution; refused channels are in refused.csv."""
    good = make()
    row = Refusal(good.history.logs[-1], reason, "as it is", channel=channel)
    found = {one.code: one for one in notices(replace(good, refused=(row, *good.refused)))}
    assert (found[reason].severity if reason in found else None) == severity
    assert reason not in found or found[reason].where == channel


def few_logs(n: int, drift: float, seed: int, scale: float = 1.0) -> list[LogEstimates]:
    """Return logs of errors of 5e-4 of ln f, the last one with pitch off by a drift."""
    rng, logs = np.random.default_rng(seed), []
    for day in range(n):
        values = np.log(FREQUENCY) + scale * 5e-4 * rng.standard_normal(len(MODES))
        values[1] += drift if day == n - 1 else 0.0
        log = make_reading(f"{day}", float(day), 1e5 * day, dict(zip(MODES, values, strict=True)))
        cov = np.diag([2.5e-7] * len(MODES) + [1e-3] * len(MODES))
        logs.append(replace(log, modes=replace(log.modes, cov=cov)))
    return logs


@pytest.mark.parametrize("n", [2, 3, 4])
def test_a_drift_that_no_scatter_explains_is_stated_at_once(tmp_path: Path, n: int) -> None:
    """Before a verdict is possible, also of an estimate that the filter has left out as a jump."""
    stage = make_stage(tmp_path, parameters=(), tail="")
    found = assess(few_logs(n, 0.014, 1), stage)
    assert found.judgement.verdict == "not-enough-data" and list(found.drifted) == ["pitch"]
    (notice,) = (one for one in notices(found) if one.code == "large-drift")
    assert (notice.severity, notice.where) == ("serious", "pitch")
    assert "Pitch has moved by +1." in notice.what and f"in {n} logs, 1" in notice.what
    summary = summarise(found, found.service())
    assert summary.step.kind == "check-drift" and summary.urgency[0] == 0
    status = make_status(found, summary)
    assert (status.device_health, [*status.conditions]) == ("OFF_SPEC", ["large-drift"])
    # With enough logs the filter has learned how they scatter: alarms decide.
    assert assess(few_logs(5, 0.014, 1), stage).drifted == {}


def test_a_drift_at_another_temperature_is_that_of_the_machine(tmp_path: Path) -> None:
    """What a covariate adds is no drift: the last of four warm logs has moved by +1.4 %."""
    stage = make_stage(tmp_path, parameters=())
    rng, slope, logs = np.random.default_rng(2), -1e-3, []
    warmth = np.r_[rng.uniform(-20, 20, 20), 20.0, 20.0, 20.0, 20.0]
    for day, offset in enumerate(warmth.tolist()):
        values = np.log(FREQUENCY) + slope * offset + 1e-4 * rng.standard_normal(len(MODES))
        values[1] += 0.014 * (day == 23)
        own = make_reading(
            f"{day}", float(day), 1e5 * day, dict(zip(MODES, values, strict=True)),
            covariates={"temperature_c": 21.0 + offset},
        )  # fmt: skip
        cov = np.diag([2.5e-7] * len(MODES) + [1e-3] * len(MODES))
        logs.append(replace(own, modes=replace(own.modes, cov=cov)))
    work = Maintenance((Action("AX-1", START + timedelta(days=19.5), "guide-replaced"),))
    found = assess(logs, stage, work=work)
    assert found.drifted["pitch"][0] == pytest.approx(0.014, abs=2e-3)
    (refused,) = (one for one in found.refused if one.reason == "jump")
    frequency, before = map(float, re.findall(r"[\d.]+(?= Hz)", refused.detail))
    assert frequency / before == pytest.approx(1.014, abs=2e-3)


def test_after_a_reset_of_the_odometer_no_health_is_stated(tmp_path: Path) -> None:
    """Half of the logs contradict the others: one serious notice, and no verdict."""
    stage, logs = make_stage(tmp_path), few_logs(12, 0.0, 1)
    reset = [
        replace(log, metadata=replace(log.metadata, travel=1e5 * (k - 5.5)))
        for k, log in enumerate(logs)
        if k > 5
    ]
    found = assess([*logs[:6], *reset], stage)
    assert found.health is None and found.judgement.verdict == "not-enough-data"
    (notice,) = (one for one in notices(found) if one.severity == "serious")
    assert notice.code == "logs-contradict" and notice.what == found.doubt == found.judgement.why
    assert "no-verdict" in make_status(found, summarise(found, found.service())).conditions


@pytest.mark.parametrize(("value", "noticed"), [(-40.0, True), (5.0, False)])
def test_a_covariate_far_from_all_before_is_noticed(
    tmp_path: Path, value: float, noticed: bool
) -> None:
    """A sensor stuck at -40 °C is, also in the third such log; a cold day is not."""
    stage, logs = load_stage("lms-y"), few_logs(12, 0.0, 1)
    values = [20.0 + k % 3 for k in range(9)] + 3 * [value]
    logs = [
        replace(log, metadata=replace(log.metadata, covariates={"temperature_c": one}))
        for log, one in zip(logs, values, strict=True)
    ]
    found = [one for one in notices(assess(logs, stage)) if one.code == "covariate-far"]
    assert [one.where for one in found] == noticed * ["temperature_c"]
    assert not noticed or f"{value:g} in the last log, far outside of" in found[0].what


@pytest.mark.parametrize("stated", [True, False])
def test_a_temperature_that_no_log_states_is_noticed(stated: bool) -> None:
    """Its seasons would read as wear; one constant value states that it is controlled."""
    covariates = {"temperature_c": 21.0} if stated else {}
    logs = [
        replace(log, metadata=replace(log.metadata, covariates=covariates))
        for log in few_logs(3, 0.0, 1)
    ]
    found = notices(assess(logs, load_stage("lms-y")))
    missing = [one for one in found if one.code == "covariate-missing"]
    assert [(one.where, one.severity) for one in missing] == (not stated) * [
        ("temperature_c", "caution")
    ]
    assert stated or "by 0.1 % per unit" in missing[0].what


def test_scatter_is_no_large_drift(tmp_path: Path) -> None:
    """Errors twice as large as reported give none in 60 machines of two to four logs."""
    stage = make_stage(tmp_path, parameters=(), tail="")
    logs = [few_logs(2 + seed % 3, 0.0, seed, scale=2.0) for seed in range(60)]
    assert not [found for found in (assess(one, stage) for one in logs) if found.drifted]


@pytest.mark.parametrize(("epochs", "severity"), [((-1,), "caution"), ((-2, -1), "serious")])
def test_last_logs_that_are_left_out_are_counted(
    make: Maker, epochs: tuple[int, ...], severity: str
) -> None:
    """One outlier may be chance; of several the page would state a health of long ago."""
    good = make()
    good = replace(good, judgement=replace(good.judgement, verdict="healthy"))
    assert good.track is not None
    n = len(good.track.logs)
    outliers = ((n - 4, "roll"), *((n + epoch, "roll") for epoch in epochs))
    bad = replace(good, track=replace(good.track, outliers=outliers))
    (told,) = (one for one in notices(bad) if one.code == "last-logs-left-out")
    assert (told.severity, told.where) == (severity, "roll")
    assert ("last 2 logs" in told.what) == (len(epochs) > 1)
    # Before a service is planned by the logs that are left, the jump is confirmed or refuted.
    before, after = (summarise(one, one.service()) for one in (good, bad))
    assert before.step.kind != after.step.kind == "check-drift"
    assert headline(after) == f"{headline(before)} before the last log, which deviates in roll"
    assert bad.track is not None
    every = replace(bad.track, outliers=tuple((n - 1, mode) for mode in bad.track.modes))
    whole = replace(bad, track=every)
    assert headline(summarise(whole, whole.service())).endswith("last log, which deviates")
    (whole_told,) = (one for one in notices(whole) if one.code == "last-logs-left-out")
    assert whole_told.where == "pitch, roll, yaw"
    assert "unconfirmed-jump" in make_status(bad, after).conditions
    # A second log alike leaves the jump unconfirmed; one bad log does not hide a service.
    later = replace(good, track=replace(good.track, suspected=Step.found("step", n - 2, n)))
    assert "unconfirmed-jump" in make_status(later, summarise(later, later.service())).conditions
    lost = replace(bad, judgement=replace(bad.judgement, verdict="preload"))
    summary = summarise(lost, lost.service())
    assert summary.step.kind == "check-loss" and service_on_day(summary).endswith("was repaired")
    assert headline(summary) == "Loss of guide preload before the last log, which deviates in roll"
    assert "before the last log, which deviates in roll (" in next(iter(changes(summary, summary)))


@pytest.mark.parametrize(("reason", "told"), [("ambiguous", True), ("not-excited", False)])
def test_a_last_log_without_a_certain_name_deviates(make: Maker, reason: str, told: bool) -> None:
    """A jump of all modes to the places of others was a healthy machine without a notice."""
    good = make()
    ln_f = good.history.ln_frequency.copy()
    ln_f[-1] = np.nan
    last, modes = good.history.logs[-1], good.history.modes
    of_last = tuple(Refusal(last, reason, "", mode=mode) for mode in modes)
    bad = replace(good, history=replace(good.history, ln_frequency=ln_f), refused=of_last)
    found = [one for one in notices(bad) if one.code == "last-logs-left-out"]
    assert [one.severity for one in found] == told * ["caution"]
    assert bad.left_out == (dict.fromkeys(sorted(modes), 1) if told else {})
    if told:  # the log before was far from those before it
        assert good.track is not None
        n = len(good.track.logs)
        outliers = tuple((n - 2, mode) for mode in modes[:1])
        both = replace(bad, track=replace(good.track, outliers=outliers))
        assert both.left_out == dict.fromkeys(sorted(modes), 1) | {modes[0]: 2}
        found = [one for one in notices(both) if one.code == "last-logs-left-out"]
        assert {one.where: one.severity for one in found}[modes[0]] == "serious"
    # One of two logs at the end that has a name is no outlier.
    with_name = replace(bad, history=good.history)
    assert with_name.left_out == {}


def test_a_flag_of_the_last_log_is_noticed_with_its_meaning(make: Maker) -> None:
    """For all modes that have it in one notice; its meaning is that of the table of flags."""
    latest = make_reading("last", 40, 1e6, {"roll": 4.8, "pitch": 4.9, "yaw": 5.0})
    modes = replace(latest.modes, flags=("unsteady", "", "unsteady"))
    of_log = replace(make(), latest=replace(latest, modes=modes))
    (notice,) = (one for one in notices(of_log) if one.code == "unsteady")
    names = f"{modes.names[0]} and {modes.names[2]}"
    assert notice.what == f"The last log has the flag unsteady at {names}: {FLAGS['unsteady']}"
    with in_language("de"):
        assert sentence(notice.what).endswith("was die Standardabweichungen enthalten.")


def test_a_declared_baseline_that_is_left_out_is_named() -> None:
    """It is not replaced in silence: a notice has declaration, reason and the log that is used."""
    readings = [
        make_reading(f"{k}.csv", k, 1e8 if k == 1 else 1e5 * k, {"roll": 4.8}, baseline=k == 1)
        for k in range(4)
    ]
    found = assess(readings, load_stage("lms-y"), epochs=1)
    (notice,) = (one for one in found.notices if one.code == "baseline-refused")
    assert (notice.where, found.history.baseline) == ("1.csv", 0)
    assert "baseline = true" in notice.what and "travel_km 100000 contradicts" in notice.what
    assert "begins with 0.csv" in notice.what and "manifest.csv" in notice.to_do
