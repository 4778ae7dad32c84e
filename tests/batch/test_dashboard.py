"""Values for dashboards: those of the tables."""

from __future__ import annotations

import numpy as np

from lmshealth.batch.outputs import points
from lmshealth.machine.summary import summarise
from lmshealth.report.tables import machine_tables
from tests.assessments import Maker, make, nothing

__all__ = ["make"]


def test_points_of_a_dashboard_are_those_of_the_tables(make: Maker) -> None:
    """Health and frequencies per log with 90 % intervals, and the remaining life now."""
    assessment = make()
    summary = summarise(assessment, assessment.service())
    found = points(machine_tables(assessment))
    health = [one for one in found if one["quantity"] == "health"]
    assert assessment.health is not None and assessment.track is not None
    expected = assessment.health.quantile(np.array([0.05, 0.5, 0.95]))
    last = [health[-1][name] for name in ("low", "median", "high")]
    np.testing.assert_allclose(last, expected[:, -1, 1])
    roll = [one for one in found if (one["quantity"], one["subject"]) == ("frequency_hz", "roll")]
    frequency = np.exp(assessment.track.ln_frequency[:, 0])
    np.testing.assert_allclose([one["median"] for one in roll], frequency)
    moments = [moment.isoformat() for moment in assessment.track.recorded_at]
    assert [one["recorded_at"] for one in roll] == moments
    km = {one["subject"]: one["median"] for one in found if one["quantity"] == "remaining_km"}
    assert summary.life is not None
    assert km["any"] == summary.life.any.travel[3] / 1000
    assert points(machine_tables(nothing(make()))) == points({}) == []
