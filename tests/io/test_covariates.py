"""Covariates of installed packages: read from logs as the shipped ones, and checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lmshealth.io.log import OTHER_KEYS, _checked, covariates, metadata_keys
from tests.installed import install, run_script

SHIPPED = [(key, *ends) for key, ends in covariates().items()]
# The package offers a law as well, whose module imports the package that looks for covariates.
_MODULE = """
from lmshealth.stage.degradation_laws import Linear
HUMIDITY = ("humidity_percent", 0.0, 100.0)
WRONG = ("recorded_at", 0.0, 1.0)
"""
_SCRIPT = """
import sys
import lmshealth
from lmshealth.errors import BadLog
for name in sys.argv[1:]:
    try:
        print(lmshealth.read_log(name).metadata.covariates)
    except BadLog as error:
        print(error)
"""
_LOG = """# sample_rate_hz: 1000
# recorded_at: 2026-07-12T06:00:00Z
# temperature_c: 21.5
# humidity_percent: {humidity}
delta_e_um
"""


def test_the_shipped_keys_are_in_the_order_of_the_contract() -> None:
    """Names and places as logs, maps and messages have them."""
    assert list(covariates()) == ["temperature_c", "payload_kg", "position_mm"]
    assert metadata_keys()[3:8] == (
        *("sample_rate_hz", "temperature_c", "payload_kg", "position_mm", "servo_id"),
    )
    assert set(metadata_keys()) == {*OTHER_KEYS, *covariates()}


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ("humidity_percent", "needed a tuple"),
        (("humidity_percent", 0.0), "needed a tuple"),
        (("humidity", 0.0, 1.0), "with a unit"),
        (("Humidity_percent", 0.0, 1.0), "small letters"),
        (("temperature_c", 0.0, 1.0), "is known already"),
        (("recorded_at", 0.0, 1.0), "is known already"),
        (("humidity_percent", 1.0, 1.0), "ascending"),
        (("humidity_percent", 0.0, float("nan")), "ascending"),
    ],
)
def test_an_object_that_is_no_covariate_is_refused(given: Any, why: str) -> None:
    """Type, key and range, with what is needed."""
    with pytest.raises((TypeError, ValueError)) as refused:
        _checked(given, SHIPPED)
    assert why in str(refused.value)
    assert _checked(("humidity_percent", 0, 100), SHIPPED) == ("humidity_percent", 0.0, 100.0)


@pytest.mark.slow
def test_a_covariate_of_another_package_is_read(tmp_path: Path) -> None:
    """From a file, within its range; without the package its key is unknown and left out."""
    entries = "[lmshealth.covariates]\nhumidity = my_plant:HUMIDITY\nwrong = my_plant:WRONG\n"
    package = install(tmp_path, "my_plant", _MODULE, entries)
    samples = "\n".join(str((7 * k) % 31) for k in range(400))
    for name, humidity in (("dry.csv", 40), ("odd.csv", 140)):
        (tmp_path / name).write_text(_LOG.format(humidity=humidity) + samples + "\n")
    for known in (True, False):
        own = package if known else None
        done = run_script(_SCRIPT, "dry.csv", "odd.csv", cwd=tmp_path, package=own)
        assert done.returncode == 0, done.stderr
        dry, odd = done.stdout.splitlines()
        if known:
            assert dry == "{'temperature_c': 21.5, 'humidity_percent': 40.0}"
            assert "metadata: humidity_percent is '140', needed a number from 0 to 100" in odd
            assert "'wrong' of my_plant is not used: ValueError" in done.stderr
        else:
            assert dry == odd == "{'temperature_c': 21.5}"
