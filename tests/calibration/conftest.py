"""A check of a small description, which several tests look at."""

from __future__ import annotations

import pytest

from lmshealth.calibration.check import CalibrationCheck, check_calibration
from lmshealth.calibration.lives import Schedule
from lmshealth.stage.description import Stage
from tests.lives import FADING, four_settings, make_stage

SCHEDULE = Schedule(logs=12, km_per_day=10.0)


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Return a stage with one parameter that fades."""
    return make_stage(tmp_path_factory.mktemp("small"), (FADING,))


@pytest.fixture(scope="session")
def checked(small: Stage) -> CalibrationCheck:
    """Check it on eight lives and those that each kind lacks."""
    with four_settings():
        return check_calibration(small, SCHEDULE, lives=8, seed=2)
