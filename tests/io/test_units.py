"""Column names: quantity, name, factor."""

import pytest

from lmshealth.io.refusal import Unusable, listed
from lmshealth.io.units import parse_column, role_of


@pytest.mark.parametrize(
    ("column", "name", "role", "factor"),
    [
        ("delta_e_um", "delta_e", "displacement", 1e-6),
        ("delta_e_nm", "delta_e", "displacement", 1e-9),
        ("delta_e_x_mm", "delta_e_x", "displacement", 1e-3),
        ("acc_feed_m_s2", "acc_feed", "acceleration", 1.0),
        ("acc_feed_mm_s2", "acc_feed", "acceleration", 1e-3),
        ("acc_x_g", "acc_x", "acceleration", 9.80665),
        ("current_ma", "current", "current", 1e-3),
        ("current_q_a", "current_q", "current", 1.0),
        ("reference_position_mm", "reference_position", "reference_position", 1e-3),
        ("reference_velocity_m_s", "reference_velocity", "reference_velocity", 1.0),
        ("time_s", "time", "time", 1.0),
    ],
)
def test_contract_names(column, name, role, factor):
    """The longest unit wins and gives the factor to SI."""
    signal = parse_column(column)
    assert (signal.name, signal.role, signal.factor) == (name, role, factor)


@pytest.mark.parametrize("column", ["delta_e", "delta_e_inch", "acc_x", "acc_x_m_s", "current_mm"])
def test_unknown_units(column):
    """An absent unit, an unknown one and one of another quantity are errors."""
    with pytest.raises(Unusable, match="needed one of"):
        parse_column(column)


@pytest.mark.parametrize("column", ["accuracy", "delta_energy", "time_of_day", "position_mm"])
def test_no_signal(column):
    """A name that only resembles a signal's is none."""
    assert role_of(column) is None


@pytest.mark.parametrize(("unit", "factor"), [("m/s²", 1.0), ("g", 9.80665), (0.01, 0.01)])
def test_given_units(unit, factor):
    """A column map may give a unit or the SI value of one count."""
    assert parse_column("acc_x", unit).factor == factor


@pytest.mark.parametrize(("column", "unit"), [("acc_x_g", "g"), ("acc_x", "um"), ("acc_x", 0.0)])
def test_contradicting_units(column, unit):
    """A unit given twice, of another quantity or a scale of 0 are errors."""
    with pytest.raises(Unusable):
        parse_column(column, unit)


def test_listed():
    """Long lists are cut and control characters made visible."""
    assert listed(str(i) for i in range(14)).endswith("11 and 2 more")
    assert listed(["a\x1b"]) == "'a\\x1b'" and listed([]) == "nothing"
