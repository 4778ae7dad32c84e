"""Notices of a machine: each by its cause, and none without one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from lmshealth._private.tables import TABLES
from lmshealth.life.verdict import judge
from lmshealth.io.log import Refusal
from lmshealth.report.assessment import summarise
from lmshealth.report.notices import notices
from lmshealth.report.tables import machine_tables
from tests.assessments import PARAMETERS as PARTS
from tests.assessments import Assessment, Maker, make, nothing

__all__ = ["make"]


def codes(assessment: Assessment) -> set[str]:
    """Return the codes of what is noticed beyond the notice of the logs."""
    return {one.code for one in notices(assessment)} - {"mode-missing"}


def test_a_machine_that_its_model_fits_has_no_notices(make: Maker) -> None:
    """Without results there are none either."""
    assert codes(make()) == set()
    assert codes(nothing(make())) == set()


@pytest.mark.parametrize("code", [
    "names-in-doubt", "filter-inconsistent", "not-converged", "unexplained-drifts", "end-of-map",
    "limit-not-included", "laws-do-not-fit", "methods-disagree",
])  # fmt: skip
def test_each_cause_has_its_notice(make: Maker, code: str) -> None:
    """What is wrong is noticed by its code, in words, and with the place."""
    good = make()
    health, prognosis, track = good.health, good.prognosis, good.track
    assert health is not None and prognosis is not None and track is not None
    last = np.arange(len(health.recorded_at)) == len(health.recorded_at) - 1
    low = replace(health, chains=health.chains * 0.5)
    wrong: dict[str, dict[str, Any]] = {
        "names-in-doubt": {"doubt": "The names of the modes are in doubt."},
        "filter-inconsistent": {"track": replace(track, nis=track.nis * 9)},
        "not-converged": {"health": replace(health, converged=health.converged & ~last)},
        "unexplained-drifts": {"health": replace(health, fit=np.where(last, 1e-9, health.fit))},
        "end-of-map": {"health": replace(health, at_edge=np.ones_like(health.at_edge))},
        "limit-not-included": {
            "prognosis": replace(prognosis, unidentifiable=("mount_stiffness",))
        },
        "laws-do-not-fit": {"prognosis": replace(prognosis, chi_square=1e4)},
        "methods-disagree": {"health": low},
    }
    bad = replace(good, **wrong[code])
    assert codes(bad) == {code}
    (row, *_) = [row for row in machine_tables(bad)["warnings"] if row["code"] == code]
    assert tuple(row) == TABLES["warnings"].names
    assert row["what"].endswith(".")


@pytest.mark.parametrize("power", [0.05, 20.0])
def test_gauges_verdict_and_service_agree_where_methods_disagree(make: Maker, power: float) -> None:
    """Half of the draws are those of the laws: no answer contradicts another."""
    good = make()
    assert good.health is not None and good.prognosis is not None
    by_laws = np.quantile(good.prognosis.health[:, 0], (0.05, 0.95))
    chains = 0.5 * (good.health.chains / np.median(good.health.chains[-1, ..., 0])) ** power
    health = replace(good.health, chains=np.clip(chains, 0.05, 0.6))
    low = replace(good, health=health)
    own = np.quantile(health.samples[-1, :, 0], (0.05, 0.95))
    assert own[1] < by_laws[0] and codes(low) >= {"methods-disagree"}
    assert good.service().kind != "now"  # by the laws alone
    gauge, service = summarise(low, low.service()).health[0], low.service()
    assert gauge.low <= own[1] and gauge.high >= by_laws[0]
    assert gauge.below_limit > 0.05 and service.kind == "now" and service.risk >= gauge.below_limit
    found = judge(low.stage, low.history, low.present)
    assert found.verdict != "healthy" and found.probability <= 1


def test_a_healthy_epoch_does_not_hide_an_end_by_the_laws(make: Maker) -> None:
    """Where the laws are past a limit, no verdict is healthy with more than half of the draws."""
    good = make()
    assert good.health is not None and good.prognosis is not None
    draws = np.tile(good.prognosis.limits[:2] * 0.95, (len(good.prognosis.health), 1))
    past = np.full_like(good.prognosis.remaining, -1e3)
    ended = replace(good.prognosis, health=draws, remaining=past)
    sound = replace(good.health, chains=np.full_like(good.health.chains, 0.99))
    both = replace(good, health=sound, prognosis=ended)
    assert judge(both.stage, both.history, sound).verdict == "healthy"
    found = judge(both.stage, both.history, both.present)
    assert both.service().kind == "now"
    assert found.verdict == "both" and found.probability == pytest.approx(0.5, abs=1e-3)


def test_methods_that_overlap_but_differ_about_the_verdict_are_pooled(make: Maker) -> None:
    """A preload that is healthy by the epoch and degraded by the laws is neither for sure."""
    good = make()
    assert good.health is not None and good.prognosis is not None
    rng = np.random.default_rng(1)
    chains = np.array([0.91, 0.99]) * np.exp(0.01 * rng.standard_normal(good.health.chains.shape))
    draws = good.prognosis.health * 0 + 0.885 * np.exp(0.01 * rng.standard_normal((4000, 1)))
    draws[:, 1] = 0.99
    edge = replace(good, health=replace(good.health, chains=chains),
                   prognosis=replace(good.prognosis, health=draws))  # fmt: skip
    assert "methods-disagree" not in {one.code for one in notices(edge) if one.where != PARTS[1]}
    alone, pooled = (judge(edge.stage, edge.history, h) for h in (edge.health, edge.present))
    assert (alone.verdict, pooled.verdict) == ("healthy", "preload")
    assert alone.probability > 0.7 and pooled.probability < 0.7


def test_a_parameter_in_newton_is_compared_with_its_own_baseline(make: Maker) -> None:
    """Health in units of its own is the same fraction on pages, and disagrees with no law."""
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
