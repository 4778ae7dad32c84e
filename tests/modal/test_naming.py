"""Names for what was found: by frequency, in order, and only where they are clear."""

from __future__ import annotations

from lmshealth.modal.naming import assign
from lmshealth.modal.targets import Target

TARGETS = (
    Target("roll", 105.0, 0.02, 0.15),
    Target("pitch", 120.0, 0.02, 0.15),
    Target("yaw", 150.0, 0.02, 0.15),
)


def test_modes_where_they_are_expected_get_their_names() -> None:
    """Three modes shifted together by wear are named in order."""
    found = [(0.9 * f, 0.02) for f in (105.0, 120.0, 150.0)]
    assert assign(found, TARGETS) == (["roll", "pitch", "yaw"], {})


def test_a_stranger_gets_no_name() -> None:
    """A resonance outside every search stays unnamed and takes no name away."""
    names, unclear = assign([(f, 0.02) for f in (60.0, 105.5, 121.0, 150.5)], TARGETS)
    assert names == ["", "roll", "pitch", "yaw"]
    assert not unclear


def test_one_of_two_equal_candidates_is_not_guessed() -> None:
    """Of two resonances as far from one target neither gets its name, and why is said."""
    names, unclear = assign([(98.0, 0.02), (112.5, 0.02)], TARGETS[:1])
    assert names == ["", ""]
    assert "98 Hz" in unclear["roll"]
    assert "112.5 Hz" in unclear["roll"]


def test_nothing_found_names_nothing() -> None:
    """No resonance leaves all targets without an ambiguity: they are missing, not unclear."""
    assert assign([], TARGETS) == ([], {})
    assert assign([(50.0, 0.02)], TARGETS) == ([""], {})


def test_a_damping_far_off_belongs_to_something_else() -> None:
    """Of two resonances near one target, one ten times as damped, the other has the name."""
    names, unclear = assign([(98.0, 0.2), (112.5, 0.02)], TARGETS[:1])
    assert names == ["", "roll"]
    assert not unclear
