"""Names of resonances: assignments that keep the order, and only where they are clear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lmshealth.io.log import Refusal
from lmshealth.modal.constants import SURE_NAME
from lmshealth.modal.modes import Modes, Rejection, estimates_only, merge
from lmshealth.modal.naming import (
    Named,
    assign,
    compare,
    is_near,
    likeness,
    name_resonances,
    name_response,
    pairing_probability,
    why_unnamed,
)
from lmshealth.modal.targets import Target, choose_targets
from lmshealth.stage.description import Description, ModeSpec, Stage, load_stage
from tests.signals import make_stage

TARGETS = (
    Target("roll", 105.0, 0.02, 0.15),
    Target("pitch", 120.0, 0.02, 0.15),
    Target("yaw", 150.0, 0.02, 0.15),
)


def named(
    *found: float, targets: tuple[Target, ...] = TARGETS
) -> tuple[tuple[str, ...], dict[str, Rejection]]:
    """Assign resonances of the described damping."""
    return assigned(found, targets, damping=[0.02] * len(found))


def assigned(
    found: Sequence[float], targets: tuple[Target, ...], **given: Any
) -> tuple[tuple[str, ...], dict[str, Rejection]]:
    """Assign resonances by the probability of pairs; options are those of `pairing_probability`."""
    probability = pairing_probability(found, targets, **given)
    return assign(found, targets, probability, complete=given.get("complete", False))


def test_modes_where_they_are_expected_get_their_names() -> None:
    """Three modes shifted together by wear are named in order."""
    shifted = [0.9 * f for f in (105.0, 120.0, 150.0)]
    assert named(*shifted) == (("roll", "pitch", "yaw"), {})
    assert assigned(shifted, TARGETS, complete=True) == named(*shifted)


def test_a_resonance_outside_every_search_gets_no_name() -> None:
    """It stays unnamed and takes no name from a mode."""
    result = named(60.0, 105.5, 121.0, 150.5)
    assert result == (("", "roll", "pitch", "yaw"), {})


def test_one_of_two_equal_candidates_is_not_guessed() -> None:
    """Of two resonances as far from one target neither gets its name, and both are quoted."""
    names, ambiguous = named(98.0, 112.5, targets=TARGETS[:1])
    assert names == ("", "")
    reason, detail, place = ambiguous["roll"]
    assert reason == "ambiguous"
    assert place in (98.0, 112.5)
    assert "98 Hz may be roll" in detail
    assert "112.5 Hz may be roll" in detail


def test_a_single_resonance_known_to_be_a_target_is_ambiguous_between_neighbours() -> None:
    """At the frequency of roll it may be roll or pitch; the message quotes both probabilities."""
    names, ambiguous = assigned([112.0], TARGETS, complete=True)
    assert names == ("",)
    assert set(ambiguous) == {"roll", "pitch"}
    assert "112 Hz may be roll" in ambiguous["roll"].detail
    assert "pitch" in ambiguous["roll"].detail


def test_a_refused_mode_is_where_the_likeliest_resonance_without_a_name_is() -> None:
    """Roll may be at 95 Hz, or, less likely, at 121 Hz, which has the name of pitch."""
    names, ambiguous = named(95.0, 121.0, 151.0)
    assert names == ("", "pitch", "yaw")
    assert ambiguous["roll"].frequency == 95.0


def test_modes_that_a_loose_mount_moves_apart_are_named_by_the_map() -> None:
    """At 62 % of mount stiffness roll is 11 % low, yaw 5 %; control: without the map."""
    targets = choose_targets(load_stage("lms-y"))
    found, damping = [111.97, 128.95, 147.55], [0.0147, 0.0153, 0.0175]
    given = {"damping": damping, "standing": True}
    assert assigned(found, targets, **given) == (("roll", "pitch", "yaw"), {})
    without = tuple(replace(one, wear=np.empty(0)) for one in targets)
    names, ambiguous = assigned(found, without, **given)
    assert names == ("", "pitch", "yaw")
    assert ambiguous["roll"].frequency == found[0]


def test_nothing_found_names_nothing() -> None:
    """Without a resonance no target is ambiguous."""
    assert named() == ((), {})
    assert named(50.0) == (("",), {})


def test_a_damping_far_off_belongs_to_something_else() -> None:
    """Of two resonances near one target, one ten times as damped, the other has the name."""
    result = assigned([98.0, 112.5], TARGETS[:1], damping=[0.2, 0.02])
    assert result == (("", "roll"), {})


def test_unshifted_beside_an_undescribed_mode_beats_a_shift_to_the_neighbours() -> None:
    """With 126.5, 136.4 and 155.1 Hz the described 126.5 and 136.5 Hz keep their places."""
    described = (Target("roll", 126.5, 0.015, 0.15), Target("pitch", 136.5, 0.015, 0.15))
    found, damping = [126.5, 136.4, 155.1], [0.015, 0.015, 0.017]
    assert assigned(found, described, damping=damping, standing=True)[0] == ("roll", "pitch", "")
    # A regular row of modes shifted by its spacing is never certain.
    regular = tuple(
        Target(name, f, 0.015, 0.15) for name, f in zip("abc", (126, 137, 148), strict=True)
    )
    row = [117.0, 126.0, 137.0, 148.0]
    probability = pairing_probability(row, regular, damping=[0.015] * 4, standing=True)
    assert probability.max() < SURE_NAME


def found(frequency: Sequence[float], damping: Sequence[float]) -> Modes:
    """Make modes with provisional names."""
    n = len(frequency)
    cov = np.eye(2 * n) * 1e-6
    modes = estimates_only(np.log([*frequency, *damping]), cov, np.ones(n), "acc", ["a"] * n)
    return replace(modes, names=tuple(f"mode_{i}" for i in range(n)))


def test_a_resonance_that_is_no_described_mode_costs_the_others_no_name() -> None:
    """Of few resonances two share the only mode near them, or one has another damping."""
    targets = tuple(Target(n, 100.0 * (1 + i), 0.015, 0.05) for i, n in enumerate("abcd"))
    shared = name_resonances(found([99.0, 101.0, 200.0], [0.015] * 3), targets, "log")
    assert shared.names == {"mode_2": "b"}
    assert set(shared.ambiguous) == {"a"}
    narrow = name_resonances(found([100.0, 200.0, 301.0], [0.015, 0.015, 0.0014]), targets, "log")
    assert narrow.names == {"mode_0": "a", "mode_1": "b"}
    assert narrow.undescribed == {"mode_2"}
    # Control: where all can be described modes, all are.
    whole = name_resonances(found([100.0, 200.0, 301.0], [0.015] * 3), targets, "log")
    assert whole.names == {"mode_0": "a", "mode_1": "b", "mode_2": "c"}


def test_beside_a_resonance_that_is_no_described_mode_a_name_may_be_doubtful() -> None:
    """The second of two near one mode is undescribed: an assignment that is not sure has a flag."""
    targets = tuple(
        Target(n, f, 0.015, 0.15) for n, f in (("a", 100.0), ("b", 200.0), ("c", 300.0))
    )
    two = name_resonances(found([92.0, 101.0], [0.015] * 2), targets, "log")
    assert two.names == {"mode_1": "a"}
    assert two.doubtful == {"a"}


def test_a_silent_mode_is_not_refused_for_the_resonance_of_another() -> None:
    """Roll is too uncertain, and pitch, in whose search it lies, is not excited."""
    uncertain = Refusal("log", "too-uncertain", "112 Hz", mode="mode_0", frequency=112.0)
    named_roll = Named({"mode_0": "roll"}, frozenset(), {}, frozenset(), "log")
    modes = named_roll.publish(merge([], (), ()), TARGETS[:2], {"mode_0": uncertain})
    assert {r.mode: r.reason for r in modes.refused} == {
        "roll": "too-uncertain",
        "pitch": "not-excited",
    }
    # Control: a resonance without a name may be either.
    unnamed = replace(named_roll, names={}).publish(
        merge([], (), ()), TARGETS[:2], {"mode_0": uncertain}
    )
    assert {r.reason for r in unnamed.refused} == {"too-uncertain"}


@pytest.mark.parametrize(("frequency", "inside"), [(86, 0), (87, 1), (114.9, 1), (115.1, 0)])
def test_a_search_reaches_by_the_same_factor_down_and_up(frequency: float, inside: bool) -> None:
    """At 100 Hz one of 0.15 reaches from 87 to 115 Hz for every method."""
    target = Target("roll", 100.0, 0.02, 0.15)
    assert is_near(target, frequency) == inside
    assert (pairing_probability([frequency], [target])[0, 0] > 0) == inside
    one = found([frequency], [0.02])
    stage = make_stage([("roll", 100.0, 0.02)])
    assert name_response(one, stage).names == ("roll" if inside else "",)
    named_all = name_resonances(one, (target, replace(target, name="yaw", frequency=200.0)), "log")
    assert named_all.names == ({"mode_0": "roll"} if inside else {})
    published = named_all.publish(one, (target,), {})
    assert published.flags == (("at-bound",) if inside else ())


def shaped(name: str, frequency: float, shape: list[float], damping: float = 0.015) -> Modes:
    """Make one mode with its shape in two channels."""
    cov = np.diag([1e-3, 0.1]) ** 2
    one = estimates_only(np.log([frequency, damping]), cov, np.ones(1), "acc", ["a"])
    return replace(one, names=(name,), shape_channels=("a", "b"), shapes=np.array([shape]))


def test_described_shapes_name_what_frequencies_leave_open() -> None:
    """One resonance half way between two modes has the name whose shape it has."""
    shapes = ({"a": 2.0, "b": 2.0}, {"a": 1.0, "b": -1.0}, {"c": 1.0})
    described = tuple(replace(t, shape=s) for t, s in zip(TARGETS, shapes, strict=True))
    alike = likeness(shaped("", 112.0, [0.6, -0.8]), described)
    np.testing.assert_allclose(alike, [[0.02, 0.98, np.nan]])
    assert assigned([112.0], described, shapes=alike, complete=True)[0] == ("pitch",)
    assert assigned([112.0], described, complete=True)[0] == ("",)


def test_a_mode_off_its_description_is_compared_with_it() -> None:
    """So is one by 4 %, a factor of 4 of damping, or another shape; not one by 2 %."""
    mode = ModeSpec("roll", 126.0, 0.015, shape={"a": 1.0, "b": 1.0})
    stage = Stage(Description(name="test", mode=(mode,)), None, "0" * 64)
    right = [0.8, 0.6]
    assert compare(shaped("roll", 123.5, right, 0.02), stage) == ()
    for off in (
        shaped("roll", 121.0, right),
        shaped("roll", 126.0, right, 0.06),
        shaped("roll", 126.0, [0.8, -0.6]),
    ):
        (one,) = compare(off, stage)
        assert one[:2] == ("roll", 126.0)
        assert one.found_hz == pytest.approx(off.frequency[0])


def test_the_reason_for_no_name_lists_which_modes_are_searched_for_there() -> None:
    """One mode in the searches of two has no name, and the reason names both; so for three."""
    one = estimates_only(np.log([126.0, 0.015]), np.eye(2) * 1e-4, np.ones(1), "frf", ["acc_0"])
    described = [("roll", 120.0, 0.015), ("pitch", 130.0, 0.015)]
    (why,) = why_unnamed(name_response(one, make_stage(described)), make_stage(described))
    assert why.startswith("the mode at 126 Hz has no name: roll and pitch are both searched for")
    described += [("yaw", 135.0, 0.015)]
    (why,) = why_unnamed(name_response(one, make_stage(described)), make_stage(described))
    assert "roll, pitch and yaw are all searched for" in why
    alone = make_stage(described[:1])
    assert not list(why_unnamed(name_response(one, alone), alone))
