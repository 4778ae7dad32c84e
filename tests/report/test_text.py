"""Numbers in words."""

from __future__ import annotations

import pytest

from lmshealth.report.text import GAP, probability_range


@pytest.mark.parametrize(
    ("at_least", "at_most", "text"),
    [
        (0.31, 0.31, "31 %"),
        (0.311, 0.312, "31 %"),
        (0.0, 0.0, "below 1 %"),
        (0.0, 0.2, "at most 20 %"),
        (0.3, 1.0, "at least 30 %"),
        (0.3, 0.6, "30 % to 60 %"),
        (1.0, 1.0, "above 99 %"),
    ],
)
def test_a_probability_between_bounds(at_least: float, at_most: float, text: str) -> None:
    """Bounds that read alike are one number; trivial ones are not named."""
    assert probability_range((at_least, at_most)).replace(GAP, " ") == text
