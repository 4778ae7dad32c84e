"""Tests of the truth laws."""

from datetime import UTC, datetime

import numpy as np
import pytest

from models.degradation import (
    HALL,
    LIVES,
    ROOM,
    HertzWear,
    Loosening,
    Steady,
    draw_laws,
    life_named,
)
from models.errors import UnknownLife


def test_laws_start_at_one_and_fall():
    """New is 1, and nothing heals."""
    for law in (HertzWear(8000.0, 1.1), Loosening(3000.0, 0.55)):
        values = [law.at(s) for s in np.linspace(0, 7000, 50)]
        assert values[0] == 1.0
        assert np.all(np.diff(values) < 0)


@pytest.mark.parametrize(
    ("law", "limit"), [(HertzWear(8000.0, 1.1), 0.6), (Loosening(3000.0, 0.55), 0.7)]
)
def test_limit_odometer_is_where_the_law_reaches_it(law, limit):
    """The closed form and the law agree."""
    assert law.at(law.reaches_km(limit)) == pytest.approx(limit, rel=1e-12)


def test_never_is_never():
    """A floor above the limit and a steady parameter are never crossed."""
    assert Loosening(3000.0, 0.75).reaches_km(0.7) is None
    assert Steady().reaches_km(0.6) is None


def test_draws_follow_their_distributions():
    """Medians and ranges of 2,000 drawn laws are those stated (4.5 σ of the median)."""
    rng = np.random.default_rng(0)
    draws = [draw_laws(rng) for _ in range(2000)]
    tolerance = 4.5 * 0.25 * 1.2533 / np.sqrt(2000)
    for values, median in (
        ([d.wear.life_km for d in draws], 8000.0),
        ([d.loosening.scale_km for d in draws], 3000.0),
    ):
        assert abs(np.log(np.median(values) / median)) < tolerance
    assert all(0.9 <= d.wear.exponent <= 1.3 for d in draws)
    assert all(0.5 <= d.loosening.floor <= 0.65 for d in draws)


def test_climate_stays_in_its_range():
    """The room stays within ±3 K of its mean, the hall within ±10 K."""
    rng = np.random.default_rng(1)
    for climate, reach in ((ROOM, 3.0), (HALL, 10.0)):
        values = [
            climate.at(datetime(2026, month, day, hour, tzinfo=UTC), rng)
            for month in range(1, 13)
            for day in (1, 15)
            for hour in (3, 9, 15, 21)
        ]
        assert np.ptp(values) > reach
        assert np.abs(np.array(values) - climate.mean_c).max() <= reach


def test_lives_of_one_seed_share_their_laws():
    """`both` wears and loosens exactly as the single-cause lives do."""
    both, wear, loose = (
        life_named(n, np.random.default_rng(7)) for n in ("both", "preload-wear", "mount-loosening")
    )
    assert both.preload == wear.preload
    assert both.mount == loose.mount
    assert isinstance(wear.mount, Steady)


def test_unknown_life_lists_the_known():
    """An unknown life raises and names the registered ones."""
    with pytest.raises(UnknownLife, match="healthy") as caught:
        life_named("eternal", np.random.default_rng(0))
    assert caught.value.known == tuple(LIVES)
