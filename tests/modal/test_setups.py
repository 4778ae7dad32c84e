"""Set-ups with roving sensors are merged to one shape and one estimate per mode."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

import lmshealth
from lmshealth.errors import NotEnoughData
from lmshealth.io.log import Metadata
from lmshealth.modal.identification import read_ambient
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.mode_shapes import ModeShapes, mode_shapes
from lmshealth.modal.modes import estimates_only
from lmshealth.modal.naming import assurance
from tests.signals import Mode, accelerations, make_log

PLACES = ("base", "left", "right", "top", "far")
TRUTH = {  # Hz: shape over the places
    40.0: (0.5, 1.0, -0.8, 0.3, 0.9),
    62.0: (0.6, -0.4, 0.7, 1.0, -0.5),
}
SETUPS = (("base", "left", "right"), ("base", "top"), ("top", "far", "base"))
METADATA = Metadata(stage="M", recorded_at=datetime(2026, 1, 1, tzinfo=UTC))


def measured(seed: int) -> list[LogEstimates]:
    """Simulate and identify each set-up, under forces of different sizes."""
    found = []
    for k, places in enumerate(SETUPS):
        at = [PLACES.index(place) for place in places]
        modes = [Mode(f, 0.01, 4.0**k, tuple(shape[i] for i in at)) for f, shape in TRUTH.items()]
        values = accelerations(np.random.default_rng([seed, k]), modes, 60_000, 500.0, 1e-3)
        log = make_log({f"acc_{p}": row for p, row in zip(places, values, strict=True)}, 500.0)
        reading = read_ambient(log, band=(20.0, 100.0))
        shapes = mode_shapes(reading.modes, reading.fitted)
        found.append(LogEstimates(f"{k}.h5", str(k), METADATA, reading.modes, shapes=shapes))
    return found


@pytest.fixture(scope="module")
def setups() -> list[LogEstimates]:
    """Three set-ups of one machine, each with two modes."""
    return measured(0)


def test_shapes_over_all_places_are_those_of_the_machine(setups: list[LogEstimates]) -> None:
    """MAC above 0.999 over five places, of which no set-up saw more than three."""
    merged = lmshealth.merge_setups(setups)
    assert merged.log == "0.h5 + 1.h5 + 2.h5"
    assert merged.modes.names == ("mode_1", "mode_2")
    assert merged.modes.shape_channels == tuple(f"acc_{place}" for place in PLACES)
    truth = np.array(list(TRUTH.values()))
    mac = assurance(merged.modes.shapes, truth)
    assert (mac.diagonal() > 0.999).all()
    assert mac[0, 1] < 0.5
    assert merged.shapes is not None
    assert (assurance(merged.shapes.shapes, truth).diagonal() > 0.999).all()
    np.testing.assert_allclose(np.linalg.norm(merged.modes.shapes, axis=1), 1.0)
    # Without the common channel the scales of the parts are those of their forces.
    naive = np.zeros(len(PLACES))
    for one in setups:
        naive[[PLACES.index(c.removeprefix("acc_")) for c in one.modes.shape_channels]] = (
            one.modes.shapes[0]
        )
    assert assurance(naive[None], truth[:1])[0, 0] < 0.99


def test_estimates_are_averaged_by_their_precision(setups: list[LogEstimates]) -> None:
    """As the inverse of the sum of precisions; nearer to the truth than their σ allows for."""
    merged = lmshealth.merge_setups(setups).modes
    precision = sum(np.linalg.inv(one.modes.cov) for one in setups)
    weighted = sum(np.linalg.inv(one.modes.cov) @ one.modes.estimate for one in setups)
    np.testing.assert_allclose(merged.cov, np.linalg.inv(precision), rtol=1e-9)
    np.testing.assert_allclose(merged.estimate, np.linalg.solve(precision, weighted), rtol=1e-9)
    assert (np.abs(merged.frequency - list(TRUTH)) < 4 * merged.frequency_std).all()


def by_hand(
    name: str, channels: tuple[str, ...], ln_f: float, shape: tuple[float, ...], std: float = 1e-3
) -> LogEstimates:
    """Return a set-up with one mode."""
    cov = np.diag([std**2, 0.01])
    modes = estimates_only(np.array([ln_f, -4.6]), cov, np.array([10.0]), "acc", channels[:1])
    unit = np.array([shape]) / np.linalg.norm(shape)
    modes = replace(modes, names=(name,), shape_channels=channels, shapes=unit)
    shapes = ModeShapes((name,), channels, unit + 0j)
    log = f"{'-'.join(channels)}.h5"
    return LogEstimates(log, log, METADATA, modes, shapes=shapes)


def test_frequencies_that_scatter_widen_and_those_that_agree_do_not() -> None:
    """Two set-ups 14 of their standard deviations apart: a temperature, or another machine."""
    for apart, factor in ((0.02e-3, 1.0), (14e-3, 14 / 2)):
        pair = [
            by_hand("roll", ("a", "b"), 3.0, (1.0, 0.5)),
            by_hand("roll", ("a", "c"), 3.0 + apart, (1.0, -2.0)),
        ]
        merged = lmshealth.merge_setups(pair).modes
        assert merged.names == ("roll",)
        assert merged.ln_frequency == pytest.approx(3.0 + apart / 2)
        assert np.sqrt(merged.cov[0, 0]) == pytest.approx(1e-3 / np.sqrt(2) * factor, rel=1e-6)
        expected = np.array([1.0, 0.5, -2.0]) / np.linalg.norm([1.0, 0.5, -2.0])
        largest = expected * np.sign(expected[np.abs(expected).argmax()])
        np.testing.assert_allclose(merged.shapes[0], largest, atol=1e-12)


@pytest.mark.parametrize("other", ["pitch", "far", "unlike"])
def test_different_modes_are_not_merged(other: str) -> None:
    """Other names, other frequencies, or another shape where both have channels."""
    first = by_hand("roll" if other == "pitch" else "mode_1", ("a", "b", "c"), 3.0, (1, 0.5, 0))
    name = "pitch" if other == "pitch" else "mode_1"
    shape = (0.5, -1, 0.3) if other == "unlike" else (1, 0.5, 0.3)
    second = by_hand(name, ("a", "b", "d"), 3.0 if other != "far" else 3.1, shape)
    merged = lmshealth.merge_setups([first, second]).modes
    assert len(merged.names) == 2
    assert np.isnan(merged.shapes).sum() == 2


def test_a_set_up_between_others_decides_whether_these_show_one_mode() -> None:
    """The first and the last have no channel in common; the last is unlike the second."""
    parts = [
        by_hand("mode_1", ("a", "b"), 3.0, (1, 0.5)),
        by_hand("mode_1", ("a", "b", "c", "d"), 3.0, (1, 0.5, 1, 1)),
        by_hand("mode_1", ("c", "d"), 3.0, (1, -1)),
    ]
    assert len(lmshealth.merge_setups(parts).modes.names) == 2
    assert len(lmshealth.merge_setups(parts[:2]).modes.names) == 1


def test_two_resonances_of_one_name_stay_two() -> None:
    """A description names 20.1 and 20.9 Hz alike: the second is numbered, nothing is lost."""
    parts = [by_hand("roll", ("a", "b"), 3.0, (1, 1)), by_hand("roll", ("a", "c"), 3.04, (1, 1))]
    assert lmshealth.merge_setups(parts).modes.names == ("roll", "mode_2")


@pytest.mark.parametrize("empty", [0, 1])
def test_a_set_up_without_modes_changes_nothing(empty: int) -> None:
    """Its channels are there, and show nothing."""
    parts = [by_hand("roll", ("a", "b"), 3.0, (1, 0.5)), by_hand("roll", ("a", "c"), 3.0, (1, 1))]
    none = parts[empty].modes.select([])
    parts[empty] = replace(parts[empty], modes=none, shapes=None)
    merged = lmshealth.merge_setups(parts).modes
    assert merged.names == ("roll",)
    assert merged.cov[0, 0] == pytest.approx(1e-6)


@pytest.mark.parametrize("shape", [(1.0, 0.0), (1.0, 0.0, 0.0), (np.nan, np.nan)])
def test_nodes_and_unknown_shapes_stay_what_they_are(shape: tuple[float, ...]) -> None:
    """A channel that does not move is 0, one that was not identified is unknown."""
    names = ("a", "b", "c")[: len(shape)]
    parts = [by_hand("roll", names, 3.0, shape), by_hand("pitch", ("a", "d"), 4.0, (1, 1))]
    merged = lmshealth.merge_setups(parts).modes
    found = merged.shapes[0, : len(shape)]
    np.testing.assert_allclose(found, shape, atol=1e-12)
    assert ("loose-shape" in merged.flags[0]) == np.isnan(shape).all()


def test_a_reference_that_hardly_moves_gives_no_shape() -> None:
    """The scales of the parts are not determined: a flag, no shape; the frequency is merged."""
    pair = [
        by_hand("roll", ("a", "b"), 3.0, (0.02, 1.0)),
        by_hand("roll", ("a", "c"), 3.0, (0.03, 1.0)),
    ]
    merged = lmshealth.merge_setups(pair).modes
    assert merged.flags == ("loose-shape",)
    assert np.isnan(merged.shapes).all()
    assert merged.cov[0, 0] == pytest.approx(5e-7)


def test_set_ups_without_a_common_channel_are_refused() -> None:
    """The error lists what each has; one set-up alone is none to merge."""
    apart = [by_hand("roll", (c, f"{c}2"), 3.0, (1.0, 1.0)) for c in ("a", "b")]
    with pytest.raises(NotEnoughData, match=r"a-a2.h5: a, a2; b-b2.h5: b, b2.*keep a sensor"):
        lmshealth.merge_setups(apart)
    with pytest.raises(NotEnoughData, match="two or more"):
        lmshealth.merge_setups(apart[:1])
    bare = replace(
        apart[0], modes=replace(apart[0].modes, shape_channels=(), shapes=np.empty((1, 0)))
    )
    with pytest.raises(NotEnoughData, match=r"a-a2.h5: no mode shape; needed are"):
        lmshealth.merge_setups([bare])
    with pytest.raises(NotEnoughData, match="same log"):
        lmshealth.merge_setups([apart[0], apart[0]])
    other = replace(apart[1], metadata=replace(METADATA, stage="N"))
    with pytest.raises(NotEnoughData, match="2 machines: M, N"):
        lmshealth.merge_setups([apart[0], other])
