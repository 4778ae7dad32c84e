"""Channels and modes that an identification uses."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from lmshealth.errors import BadLog, BadStage
from lmshealth.modal import constants
from lmshealth.modal.targets import Target, choose_channels, choose_targets, limit_channels
from tests.signals import make_log, make_stage

NAMES = ("acc_b", "current", "delta_e", "acc_a")
STAGE = make_stage([("pitch", 136.6, 0.015), ("roll", 105.0, 0.02), ("yaw", 155.0, 0.03)])


def names(order: tuple[str, ...] = NAMES, chosen: list[str] | None = None) -> list[str]:
    """Name the channels that are used of a log of some."""
    log = make_log({name: np.zeros(4) for name in order}, 100.0)
    return [channel.name for channel in choose_channels(log, chosen)]


def test_what_shows_modes_is_used_in_the_order_of_names() -> None:
    """Currents are left out; the order of the file changes nothing."""
    assert {tuple(names(order)) for order in permutations(NAMES)} == {("acc_a", "acc_b", "delta_e")}


def test_only_named_channels_are_used() -> None:
    """Of those named, whatever their order, each is used once."""
    assert names(chosen=["delta_e", "acc_a", "delta_e"]) == ["acc_a", "delta_e"]


@pytest.mark.parametrize("unknown", ["acc_c", "current"])
def test_a_channel_that_is_not_usable_is_named_with_those_that_are(unknown: str) -> None:
    """Neither what is not there nor what shows no modes is passed over in silence."""
    with pytest.raises(BadLog, match=f"{unknown}.*acc_a.*acc_b.*delta_e") as caught:
        names(chosen=["acc_a", unknown])
    assert caught.value.reason == "channel"


@pytest.mark.parametrize(("there", "chosen"), [(("current",), None), (NAMES, [])])
def test_no_channel_left_is_an_error(there: tuple[str, ...], chosen: list[str] | None) -> None:
    """A log of currents only, or an empty choice, is refused."""
    with pytest.raises(BadLog, match="delta_e or acc") as caught:
        names(there, chosen)
    assert caught.value.reason == "no-signal"


def test_modes_are_looked_for_as_they_are_described_and_in_order() -> None:
    """Frequency, damping and search are the description's, ascending in frequency."""
    found = choose_targets(STAGE)
    assert [target.name for target in found] == ["roll", "pitch", "yaw"]
    roll = found[0]
    assert (roll.frequency, roll.damping_ratio, roll.search) == (105.0, 0.02, 0.15)


def test_a_band_takes_the_modes_inside_it_ends_included() -> None:
    """Modes outside are left out."""
    assert [t.name for t in choose_targets(STAGE, (105.0, 136.6))] == ["roll", "pitch"]
    assert [t.name for t in choose_targets(STAGE, (105.1, 154.9))] == ["pitch"]


def test_a_band_without_modes_is_an_error() -> None:
    """A band without described modes is an error, not an empty table."""
    with pytest.raises(BadStage, match="300 and 400 Hz"):
        choose_targets(STAGE, (300.0, 400.0))


def test_surplus_channels_are_named() -> None:
    """Of too many channels those that add most are kept, a copy with little noise is not."""
    most = constants.MOST_CHANNELS
    rng = np.random.default_rng(0)
    values = {f"acc_{k:02d}": rng.standard_normal(500) for k in range(most)}
    values["acc_00b"] = values["acc_00"] + 0.01 * rng.standard_normal(500)
    log = limit_channels(make_log(values, 100.0))
    assert len(log.channels) == most
    (refused,) = log.refused
    assert refused.reason == "surplus" and refused.channel in ("acc_00", "acc_00b")
    few = limit_channels(make_log(values, 100.0), ["acc_00", "acc_00b"])
    assert len(few.channels) == 2 and not few.refused


def test_a_target_has_a_band_about_it() -> None:
    """The band reaches so many damping ratios up and down, down never below half."""
    target = Target("roll", 100.0, 0.02, 0.15)
    assert target.band(8.0) == pytest.approx((84.0, 116.0))
    assert target.band(100.0)[0] == pytest.approx(50.0)
