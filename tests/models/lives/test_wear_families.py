"""Tests of further laws of wear."""

import numpy as np
import pytest

from models.lives.degradation import HertzWear, Steady
from models.lives.wear_families import (
    Backlash,
    Cycles,
    Exponential,
    Growth,
    Onset,
    PowerLoss,
    Product,
    Recovering,
    Settling,
    Shocks,
    first_passage_km,
)

SHOCKS = Shocks((400.0, 1000.0, 3000.0), (0.9, 0.8, 0.7))
DIPS = Recovering((300.0, 2000.0), (0.2, 0.5), 100.0)
FALLING = (
    PowerLoss(2500.0, 4.0, 0.4),
    Onset(800.0, 1200.0, 0.4),
    Exponential(700.0, 0.02),
    SHOCKS,
    Product(Settling(0.1, 60.0), PowerLoss(2500.0, 4.0, 0.4)),
)


@pytest.mark.parametrize("law", [*FALLING, DIPS, Settling(0.1, 60.0)])
def test_laws_start_at_one(law):
    """New is 1."""
    assert law.at(0.0) == 1.0


@pytest.mark.parametrize("law", FALLING)
def test_wear_never_heals(law):
    """No law but recovery rises."""
    values = [law.at(s) for s in np.linspace(0.0, 8000.0, 3000)]
    assert np.all(np.diff(values) <= 0)
    assert min(values) > 0


@pytest.mark.parametrize(
    ("law", "limit", "expected"),
    [
        (PowerLoss(2500.0, 4.0, 0.4), 0.6, 2500.0),
        (Onset(800.0, 1200.0, 0.4), 0.6, 2000.0),
        (Exponential(700.0, 0.02), 0.6, 700.0 * np.log(21.0)),
        (Settling(0.5, 60.0), 0.6, -60.0 * np.log(0.2)),
        (SHOCKS, 0.75, 1000.0),
        (SHOCKS, 0.6, 3000.0),
        (DIPS, 0.6, 2000.0),
        (Product(Steady(), HertzWear(8000.0, 1.1)), 0.6, HertzWear(8000.0, 1.1).reaches_km(0.6)),
    ],
)
def test_first_passage_has_its_closed_form(law, limit, expected):
    """The search finds the limit where algebra does, at jumps and dips as well."""
    assert law.reaches_km(limit) == pytest.approx(expected, rel=1e-9)


def test_what_is_never_reached():
    """A law that settles or recovers above the limit reaches it never."""
    assert Settling(0.3, 60.0).reaches_km(0.6) is None
    assert Recovering((300.0,), (0.3,), 100.0).reaches_km(0.6) is None
    assert SHOCKS.reaches_km(0.3) is None


def test_dips_are_seen_however_short():
    """A dip between two odometers of the search counts, because its beginning is stated."""
    dip = Recovering((50_123.0,), (0.5,), 1.0)
    assert dip.reaches_km(0.6) == pytest.approx(50_123.0)
    assert first_passage_km(dip, 0.6) is None  # control: not stated


def test_cycles_repeat():
    """Fresh at every greasing, aged before it."""
    cycles = Cycles(200.0, 0.7, 50.0)
    for start in (0.0, 200.0, 1400.0):
        assert cycles.at(start) == 1.0
        assert cycles.at(start + 199.9) == pytest.approx(0.7 + 0.3 * np.exp(-199.9 / 50.0))


def test_backlash_opens_below_a_preload():
    """Above the preload nothing; without preload the stated rest; in between a line."""
    wear = Onset(0.0, 1000.0, 1.0)
    lash = Backlash(wear, 0.8, 0.4)
    assert lash.at(100.0) == 1.0
    assert lash.at(600.0) == pytest.approx(1 - 0.6 * 0.5)


def test_growth_doubles_and_ends():
    """Level doubles per 1,000 km as stated and stays at eight times."""
    assert [Growth(1.0).at(s) for s in (0.0, 1000.0, 2000.0, 9000.0)] == [1.0, 2.0, 4.0, 8.0]
