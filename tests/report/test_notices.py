"""Notices of a machine: each by its cause, and none without one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from lmshealth.report.assessment import summarise
from lmshealth.report.notices import notices
from lmshealth.report.tables import COLUMNS, machine_tables
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
    wrong = {
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
    (row, *_) = [row for row in machine_tables([], bad)["warnings"] if row["code"] == code]
    assert list(row) == COLUMNS["warnings"].split()
    assert row["what"].endswith(".")


def test_the_gauge_shows_the_method_that_allows_for_more(make: Maker) -> None:
    """Where epoch and laws disagree the wider interval is shown, whichever it is."""
    good = make()
    assert good.health is not None and good.prognosis is not None
    by_laws = np.quantile(good.prognosis.health[:, 0], (0.05, 0.95))
    for power in (0.05, 20.0):  # of the draws about their half
        chains = 0.5 * (good.health.chains / np.median(good.health.chains[-1, ..., 0])) ** power
        health = replace(good.health, chains=np.clip(chains, 0.05, 0.6))
        bad = replace(good, health=health)
        own = np.quantile(health.samples[-1, :, 0], (0.05, 0.95))
        wider = max((own, by_laws), key=lambda one: one[1] / one[0])
        assert own[1] < by_laws[0] and codes(bad) >= {"methods-disagree"}
        gauge = summarise(bad, bad.service()).health[0]
        assert [gauge.low, gauge.high] == pytest.approx(wider)


def test_a_parameter_in_newton_is_compared_with_its_own_baseline(make: Maker) -> None:
    """Health in units of its own is the same fraction on pages, and disagrees with no law."""
    good = make()
    assert good.health is not None and good.prognosis is not None
    preload, mount = good.stage.description.parameter
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
