"""Tests of friction along given displacements."""

import builtins
import sys
from dataclasses import replace

import numpy as np
import pytest

from models.dynamics.stages import NOMINAL, stage_named
from models.errors import MissingLibrary
from models.recordings.effects import FrictionParameters
from models.recordings.friction import Contacts, contacts_of, elements, force_along, rub

STAGE = stage_named("lms-y-full")
LAW = FrictionParameters(cable_drag=0.0, cable_spring=0.0)
CONTACTS = contacts_of(STAGE, NOMINAL, LAW)
STEP = 1e-4


def test_elements_share_the_friction_and_slip_one_after_another():
    """The stiffness falls from that of all to none between the first and the last slip."""
    stiffness, share = elements(5, 1e-6, 16e-6, 2.0)
    assert share.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(2.0 * share / stiffness, [1e-6, 2e-6, 4e-6, 8e-6, 16e-6])


@pytest.mark.parametrize("velocity", [1e-4, 2e-3, 0.1])
def test_constant_velocity_meets_the_stribeck_curve(velocity):
    """After sliding, friction is Coulomb's, its excess at low velocity, and the viscous part."""
    path = velocity * np.arange(round(200e-6 / velocity / STEP) + 200) * STEP
    excess = 1 + 0.3 * np.exp(-velocity / LAW.stribeck_velocity)
    expected = STAGE.friction.value * excess + LAW.viscous * velocity
    assert force_along(CONTACTS, path, STEP)[-1] == pytest.approx(expected, rel=1e-6)
    # One that has slid for long starts there.
    begun = force_along(CONTACTS, path, STEP, velocity=velocity)
    np.testing.assert_allclose(begun, expected, rtol=1e-6)


def test_presliding_follows_masing():
    """A return branch is the first branch, doubled, where friction does not depend on speed."""
    flat = replace(CONTACTS, stiction=CONTACTS.coulomb, viscous=np.zeros(5))
    out = np.linspace(0, 12e-6, 1001)
    force = force_along(flat, np.concatenate([out, out[::-1][1:]]), STEP)
    half = np.interp(out / 2, out, force[:1001])
    # The path's own steps stand off the corners, where an element slips, by as much.
    np.testing.assert_allclose(force[1000:], force[1000] - 2 * half, atol=2e-3)
    # Memory: a small loop within closes, and the branch goes on as if it had not been.
    inner = np.concatenate([out[:801], out[600:800][::-1], out[601:]])
    np.testing.assert_allclose(force_along(flat, inner, STEP)[-1], force[1000], atol=1e-9)


def test_force_lags_behind_a_fall_of_friction():
    """From 0.5 mm/s to 100 mm/s the excess decays with the time constant of the lag."""
    law = replace(LAW, viscous=0.0)
    contacts = contacts_of(STAGE, NOMINAL, law)
    steps = np.concatenate([np.full(4000, 5e-4), np.full(60, 0.1)]) * STEP
    force = force_along(contacts, np.cumsum(steps), STEP)
    excess = force[4000:] - STAGE.friction.value
    np.testing.assert_allclose(excess[1:20] / excess[:19], np.exp(-STEP / law.lag), rtol=1e-6)


def test_compiled_is_python():
    """The compiled step is the one that stands there, over slips, turns and rest."""
    rng = np.random.default_rng(4)
    first, second = np.zeros((2, 8))
    for moved in 4e-6 * rng.standard_normal(300):
        row = (CONTACTS.stiffness[0], CONTACTS.share[0], CONTACTS.packed()[0], 0.9, moved, STEP)
        assert rub(first, *row) == pytest.approx(rub.py_func(second, *row), rel=1e-12)
    np.testing.assert_allclose(first, second, rtol=1e-12)


def test_dissipation_is_never_negative():
    """Along any path the work against friction less what the springs hold does not fall."""
    path = np.cumsum(2e-6 * np.random.default_rng(5).standard_normal(3000))
    single = Contacts(
        CONTACTS.stiffness[:1], CONTACTS.share[:1], CONTACTS.coulomb[:1], CONTACTS.coulomb[:1],
        1.0, 1e-9, np.zeros(1), np.zeros(1),
    )  # fmt: skip
    state, lost = np.zeros(8), []
    for moved in np.diff(path):
        before = np.sum(state**2 / single.stiffness[0]) / 2
        old = state.sum()
        new = rub(state, single.stiffness[0], single.share[0], single.packed()[0], 0.0, moved, STEP)
        held = np.sum(state**2 / single.stiffness[0]) / 2
        # The force never falls below its mean while it moves on: the trapezoid is a lower bound.
        lost.append((old + new) / 2 * moved - (held - before))
    assert min(lost) > -1e-12
    assert sum(lost) > 1e-4


def test_no_friction_is_none():
    """Without parameters contacts neither hold nor drag."""
    none = contacts_of(STAGE, NOMINAL, None)
    assert not force_along(none, np.linspace(0, 1e-3, 50), STEP).any()


def test_without_numba_the_extra_is_named(monkeypatch):
    """A missing compiler is an error that names the extra."""
    found = builtins.__import__

    def refused(name, *arguments, **options):
        if name == "numba":
            raise ImportError(name)
        return found(name, *arguments, **options)

    monkeypatch.delitem(sys.modules, "models.recordings.friction")
    monkeypatch.setattr(builtins, "__import__", refused)
    with pytest.raises(MissingLibrary, match=r"numba.*lmshealth\[models\]"):
        __import__("models.recordings.friction")
