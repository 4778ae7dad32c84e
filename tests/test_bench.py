"""How figures of speed are held: chance does not miss them, a slower program does."""

from __future__ import annotations

import numpy as np
import pytest

from studies.cost.ratios.ratios import FALSE_ALARM, Figure, table


def figure(ratios: np.ndarray, at_most: float = 1.0) -> Figure:
    """Hold some ratios."""
    return Figure("something", "something else", at_most, tuple(ratios.tolist()))


@pytest.mark.slow
def test_a_figure_that_is_just_held_is_hardly_ever_missed() -> None:
    """With the median on the bound, and noise of any size, at most 1 in 100 is said to be missed.

    Of 5,000 more than 1.44 % would be by chance in one of a thousand tests.
    """
    rng = np.random.default_rng(1)
    for turns in (7, 9, 15, 40):
        missed = [figure(rng.lognormal(0.0, 0.5, turns)).missed for _ in range(5000)]
        assert np.mean(missed) < FALSE_ALARM + 0.0044


def test_a_figure_that_is_a_fifth_worse_is_missed() -> None:
    """A program a fifth slower than asked is found out by seven turns with noise of 5 %."""
    rng = np.random.default_rng(2)
    missed = [figure(1.2 * rng.lognormal(0.0, 0.05, 7)).missed for _ in range(200)]
    assert np.mean(missed) > 0.99


def test_too_few_turns_are_refused() -> None:
    """What could never be missed is no figure."""
    with pytest.raises(ValueError, match="6 turns can miss nothing"):
        figure(np.full(6, 9.0))


def test_rows_tell_ratio_scatter_and_bound() -> None:
    """A row has the median and its range, and a table says what is missed and beside what."""
    row = figure(np.array([1.5, 1.2, 1.3, 1.4, 1.6, 1.7, 1.1])).row()
    assert (row["ratio"], row["least"], row["largest"], row["missed"]) == (1.4, 1.1, 1.7, True)
    head, line, beside = table({"something": row})
    assert head.split() == ["figure", "ratio", "least", "largest", "at", "most", "turns"]
    assert line.split() == ["something", "1.4", "1.1", "1.7", "1", "7", "MISSED"]
    assert beside.strip() == "beside something else"
