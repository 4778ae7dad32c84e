"""Tests of the equations' readings: each erratum with the number that shows it."""

import numpy as np
import pandas as pd
import pytest

from models.dynamics.equations import (
    BACK_EMF,
    ERRATA,
    OPEN_LOOP,
    PRINTED,
    READINGS,
    RESISTANCE,
    Ratio,
    controller,
    controller_ratio,
    derived_tuning,
    factors,
    plant,
    ratio,
)
from models.dynamics.plant import closed_loop_modes
from models.dynamics.servo import TUNINGS
from models.dynamics.servo import controller as factored_controller
from models.dynamics.stages import STAGES, stage_named
from models.errors import BadParameter, UnknownReading, UnknownStage
from models.recordings.motion_profile import Profile

# The constants as the paper's text gives them, apart from the code's own.
L, K_F, K_P, K_I, K_V, R = 1.24e-3, 12.9, 25.0, 21000.0, 15.0, 6.4
MASS = {6: 23.5, 7: 25.0}
SCALE = {6: 21.02, 7: 18.0}
NAMES = sorted(STAGES)
TABLE_3 = "studies/paper/tables/printed/table3.csv"
S = 2j * np.pi * np.geomspace(0.01, 2000.0, 200)


def roots(coefficients):
    """Return the roots of a polynomial given in ascending powers, zeros at the origin left out."""
    kept = np.trim_zeros(np.array(coefficients))
    return np.roots(kept[::-1])


def with_coefficient(equation, part, power, value):
    """Return a corrected equation in which one coefficient has another value."""
    parts = {
        "numerator": list(ratio(equation, "corrected").numerator),
        "denominator": list(ratio(equation, "corrected").denominator),
    }
    parts[part][power] = value
    return Ratio(tuple(parts["numerator"]), tuple(parts["denominator"]))


def sections(coefficients):
    """Return frequency (Hz) and damping ratio of each complex pair of roots, by frequency."""
    pairs = [r for r in roots(coefficients) if r.imag > 0]
    return sorted((abs(r) / (2 * np.pi), -r.real / abs(r)) for r in pairs)


@pytest.mark.parametrize("equation", [6, 7])
def test_s2_term_follows_from_k_i(equation):
    """In (6) and (7) the s² term is s·m·K_i with s = 21.02 and 18, within 0.05 %."""
    expected = SCALE[equation] * MASS[equation] * K_I
    assert PRINTED[equation].denominator[2] == pytest.approx(expected, rel=5e-4)


@pytest.mark.parametrize(("equation", "value"), [(6, 6.126e-1), (7, 5.580e-1)])
def test_erratum_s4_of_the_plants(equation, value):
    """The s⁴ term is s·L·m with the same s within 0.05 %; read as printed it is 100 times that."""
    assert ratio(equation, "corrected").denominator[4] == value
    assert value == pytest.approx(SCALE[equation] * L * MASS[equation], rel=5e-4)
    assert PRINTED[equation].denominator[4] == pytest.approx(100 * value)


def test_erratum_s4_of_y_is_450_times_l():
    """In (7) s⁴ is 450·L to all printed digits, and 450 = 18 × 25 kg."""
    assert ratio(7, "corrected").denominator[4] == pytest.approx(450 * L, abs=5e-5)
    assert SCALE[7] * MASS[7] == 450


@pytest.mark.parametrize("equation", [6, 7])
def test_erratum_s3_has_k_v_in_place_of_r(equation):
    """The s³ term is s·m·40.0, K_p + K_v, within 0.05 %; K_p + R would be 31.4."""
    found = PRINTED[equation].denominator[3] / (SCALE[equation] * MASS[equation])
    assert found == pytest.approx(K_P + K_V, rel=5e-4)
    assert pytest.approx(31.4) == K_P + R


def test_erratum_s3_is_kept_in_corrected_and_mended_in_derived():
    """The corrected plant keeps the 40.0, the derived one has 31.4."""
    for equation, total in ((6, 31.4), (7, 31.4)):
        assert ratio(equation, "corrected").denominator[3] == PRINTED[equation].denominator[3]
        found = ratio(equation, "derived").denominator[3] / MASS[equation]
        assert found == pytest.approx(total)


def test_erratum_numerator_of_y():
    """K_i/K_p = 840 holds in (6) within 0.01 %; in (7) it is 10.5 printed, 840 corrected."""
    assert K_I / K_P == 840
    x, printed, corrected = (r.numerator for r in (PRINTED[6], PRINTED[7], ratio(7, "corrected")))
    assert x[0] / x[1] == pytest.approx(840, rel=1e-4)
    assert printed[0] / printed[1] == pytest.approx(10.5, rel=3e-3)
    assert corrected[0] / corrected[1] == pytest.approx(840, rel=2e-4)


@pytest.mark.parametrize(("equation", "stage", "gain"), [(6, "lms-x", 11630), (7, "lms-y", 4455)])
def test_erratum_gain_of_the_plants(equation, stage, gain):
    """The numerators hold a gain of 11,630 (X), 4,455 (Y) within 0.02 % that no constant gives."""
    found = PRINTED[equation].numerator[1] / (SCALE[equation] * K_P * K_F)
    assert found == pytest.approx(gain, rel=2e-4)
    assert TUNINGS[stage].drive_gain == gain
    assert ratio(equation, "derived").numerator[1] == pytest.approx(gain * K_P * K_F)


def test_erratum_eq_8_is_table_1():
    """(8) is Table 1 for X, notch ζ 0.094/0.30, over 22000: 0.02 %, one term 0.25 %."""
    found, table = ratio(8, "corrected"), controller_ratio(TUNINGS["lms-x"])
    scale = table.denominator[1] / found.denominator[1]
    top = np.array(table.numerator) / np.array(found.numerator) / scale - 1
    bottom = np.array(table.denominator[1:]) / np.array(found.denominator[1:]) / scale - 1
    assert np.abs(np.delete(top, 3)).max() < 2e-4
    # The notch's 0.094 is a rounded 0.0943, which shows in s³.
    assert abs(top[3]) < 2.5e-3
    assert np.abs(bottom).max() < 1e-4
    assert np.abs(table(S) / found(S) - 1).max() < 3e-3


def test_erratum_eq_9_is_table_1():
    """(9) is Table 1 for Y with the notch at 160 Hz and a bi-quad, over 19550: each term 0.1 %."""
    found, table = ratio(9, "corrected"), controller_ratio(TUNINGS["lms-y"])
    scale = table.denominator[1] / found.denominator[1]
    top = np.array(table.numerator) / np.array(found.numerator) / scale - 1
    bottom = np.array(table.denominator[1:]) / np.array(found.denominator[1:]) / scale - 1
    assert np.abs(top).max() < 1e-3
    assert np.abs(bottom).max() < 4e-4
    assert np.abs(table(S) / found(S) - 1).max() < 6e-3


def test_erratum_notch_of_y():
    """The coefficients of (9) put Y's notch at 160 Hz within 0.3 %, ζ 0.15/0.50; Table 1: 165."""
    above, below = (
        next(pair for pair in sections(part) if 150 < pair[0] < 170)
        for part in (ratio(9, "corrected").numerator, ratio(9, "corrected").denominator)
    )
    assert above[0] == pytest.approx(160, rel=3e-3)
    assert below[0] == pytest.approx(160, rel=3e-3)
    assert (above[1], below[1]) == pytest.approx((0.15, 0.50), abs=2e-3)
    assert derived_tuning("lms-y").sections[0].frequency_hz == 165.0
    assert np.abs(ratio(9, "derived")(S) / ratio(9, "corrected")(S) - 1).max() > 0.1


def test_erratum_b2_of_eq_9():
    """With b2 = 1.977e10 the low pass is at 300 Hz, ζ 0.705; with the 1.1977e10 at 318 Hz."""
    good = sections(ratio(9, "corrected").denominator)[-1]
    assert good == pytest.approx((300.0, 0.705), rel=1e-3)
    assert PRINTED[9].denominator[1] == 1.1977e10
    bad = sections(with_coefficient(9, "denominator", 1, 1.1977e10).denominator)[-1]
    assert bad[0] == pytest.approx(318.3, abs=0.1)


def test_erratum_b5_of_eq_9():
    """With b5 = 1.177e5 (9) has four poles in the right half plane; with 1.177e2 none."""
    bad = roots(with_coefficient(9, "denominator", 4, PRINTED[9].denominator[4]).denominator)
    assert np.sum(bad.real > 0) == 4
    assert np.all(roots(ratio(9, "corrected").denominator).real < 0)


SIGNS = [e for e in ERRATA if "minus sign" in e.reason]


@pytest.mark.parametrize("erratum", SIGNS, ids=lambda e: f"eq{e.equation}-{e.part}-{e.power}")
def test_errata_of_signs(erratum):
    """An exponent without its minus sign puts poles or zeros into the right half plane."""
    printed = getattr(PRINTED[erratum.equation], erratum.part)[erratum.power]
    digits = np.log10(printed / erratum.corrected)
    assert digits == pytest.approx(2 * round(digits / 2), abs=1e-9)
    wrong = with_coefficient(erratum.equation, erratum.part, erratum.power, printed)
    assert np.any(roots(getattr(wrong, erratum.part)).real > 0)
    right = ratio(erratum.equation, "corrected")
    assert np.all(roots(getattr(right, erratum.part)).real < 0)


def test_errata_are_of_the_signs_found():
    """The lost signs are a6, a7, b6, b7, b8 of (9) and b6 of (8)."""
    places = {(e.equation, e.part[0], e.power + 1) for e in SIGNS}
    assert places == {(8, "d", 6), (9, "n", 6), (9, "n", 7), (9, "d", 6), (9, "d", 7), (9, "d", 8)}


def test_erratum_eq_10():
    """(10) has the numerator of (6) × (8) within 0.03 %, but the denominator of (8) alone."""
    product = ratio(10, "corrected")
    assert PRINTED[10].numerator == pytest.approx(product.numerator, rel=3e-4)
    assert PRINTED[10].denominator == PRINTED[8].denominator
    assert len(product.denominator) == len(PRINTED[10].denominator) + 4


def test_erratum_eq_11():
    """(11) has the numerator of (9) alone over the denominator of X's (6) × (8), within 0.03 %."""
    x = ratio(10, "corrected").denominator
    assert PRINTED[11].numerator == PRINTED[9].numerator
    assert PRINTED[11].denominator[:9] == pytest.approx(x[:9], rel=3e-4)
    # The last has lost its sign like b6 of (8).
    assert PRINTED[11].denominator[9] == pytest.approx(1e6 * x[9], rel=3e-4)


def test_erratum_table_3(root):
    """At 100 mm/s, and there only, Table 3 has one deviation and one mean for X and Y."""
    table = pd.read_csv(root / TABLE_3, index_col=0)
    same = table[["x_std_um", "x_mean_um"]].to_numpy() == table[["y_std_um", "y_mean_um"]]
    assert list(table.index[same.all(axis=1)]) == [100]
    assert list(table.index[same.any(axis=1)]) == [100]
    # It is not X's: above 20 mm/s every other deviation is larger in Y.
    assert table.loc[100, "x_std_um"] > table.loc[[200, 400], "x_std_um"].max()
    assert table["y_std_um"].is_monotonic_increasing


@pytest.mark.parametrize(("stage", "pair"), [("lms-x", (12.6, 36.8)), ("lms-y", (12.4, 36.6))])
def test_erratum_table_5(stage, pair):
    """The labels feed and vertical are swapped in Y; the stages have the frequencies, ± 0.3 Hz."""
    modes = {mode.name: mode.frequency_hz for mode in closed_loop_modes(stage_named(stage))}
    assert modes["granite_feed"] == pytest.approx(pair[0], abs=0.3)
    assert modes["granite_vertical"] == pytest.approx(pair[1], abs=0.3)


def test_erratum_yaw_is_roll():
    """The text's yaw mode at 126.4 Hz is Y's roll."""
    nearest = min(
        closed_loop_modes(stage_named("lms-y")), key=lambda m: abs(m.frequency_hz - 126.4)
    )
    assert nearest.name == "roll"


@pytest.mark.parametrize("name", NAMES)
def test_erratum_units_of_velocity(root, name):
    """In mm/s every velocity of Table 3 is reached on the travel; in m/s only the slowest is."""
    printed = pd.read_csv(root / TABLE_3)["velocity_mm_s"]

    def reached(velocity):
        try:
            return Profile(velocity, STAGES[name].travel.value).constant_s > 0
        except BadParameter:
            return False

    assert all(reached(1e-3 * velocity) for velocity in printed)
    assert [velocity for velocity in printed if reached(velocity)] == [1]


@pytest.mark.parametrize("equation", [6, 7])
def test_derived_plant_solves_equations_1_to_5(equation):
    """The derived plant is the solution of (1), (2), (3) and the PI loop (5), times the gain."""
    mass = MASS[equation]
    gain = {6: 11630.0, 7: 4455.0}[equation]
    derived = ratio(equation, "derived")
    for s in 2j * np.pi * np.array([0.1, 3.0, 50.0, 900.0]):
        # Unknowns x, F, I, u for a command current of 1 A.
        pi = K_P + K_I / s
        rows = np.array(
            [
                [mass * s**2, -1.0, 0.0, 0.0],
                [0.0, 1.0, -K_F, 0.0],
                [K_V * s, 0.0, L * s + R, -1.0],
                [0.0, 0.0, pi, 1.0],
            ]
        )
        x, _, current, voltage = np.linalg.solve(rows, np.array([0.0, 0.0, 0.0, pi]))
        assert derived(s) == pytest.approx(gain * x, rel=1e-9)
        # (4): the current replaced by the acceleration.
        assert current == pytest.approx(mass / K_F * s**2 * x)
        left = L * s * current + R * mass / K_F * s**2 * x
        assert left == pytest.approx(voltage - K_V * s * x)


def test_back_emf_is_small():
    """The term K_v·K_f that the print leaves out is 0.04 % of m·K_i."""
    assert BACK_EMF * K_F / (MASS[6] * K_I) == pytest.approx(4e-4, rel=0.03)
    assert RESISTANCE == R


@pytest.mark.parametrize("name", NAMES)
def test_derived_controller_is_the_factored_chain(name):
    """The polynomials of the derived controller and the factors in state space are one."""
    tuning = derived_tuning(name)
    chain = np.asarray(factored_controller(tuning)(S))
    assert np.abs(chain / (tuning.drive_gain * controller_ratio(tuning)(S)) - 1).max() < 1e-9


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("name", NAMES)
def test_all_forms_have_one_response(name, reading):
    """Polynomials, state space and python-control's transfer functions agree at 1e-12."""
    shaping, drive = factors(name, reading)
    expected = shaping(S) * drive(S)
    for part in (shaping, drive):
        assert np.abs(part.state_space()(S) / part(S) - 1).max() < 1e-12
    assert (
        np.abs(controller(name, reading)(S) * plant(name, reading)(S) / expected - 1).max() < 1e-12
    )
    if reading != "printed":
        assert np.abs(ratio(OPEN_LOOP[name], reading)(S) / expected - 1).max() < 1e-12


def test_state_space_has_the_roots():
    """The scaled companion form has the poles of its factors, to rounding."""
    poles = [-1.0, -30.0, -2000.0]
    found = Ratio((1.0,), tuple(np.poly(poles)[::-1])).state_space().poles()
    assert np.sort(found.real) == pytest.approx(np.sort(poles), rel=1e-10)


def test_improper_ratio_is_refused():
    """A numerator of higher order has no state space."""
    with pytest.raises(BadParameter, match="order of the numerator is 2; needed: at most 1"):
        Ratio((1.0, 1.0, 1.0), (1.0, 1.0)).state_space()


def test_unknown_names_are_refused():
    """Stage, reading and equation are checked at the door."""
    with pytest.raises(UnknownReading, match="unknown reading 'guessed'; known: printed"):
        factors("lms-x", "guessed")
    with pytest.raises(UnknownStage):
        factors("lms-z", "printed")
    with pytest.raises(BadParameter, match="equation is 12; needed: 6 to 11"):
        ratio(12, "printed")
