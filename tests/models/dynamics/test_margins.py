"""Tests of the margins."""

import json
from dataclasses import replace
from unittest.mock import patch

import control
import numpy as np
import pytest
from click.testing import CliRunner

from models.__main__ import cli
from models.dynamics import margins as module
from models.dynamics.equations import READINGS, factors, ratio
from models.dynamics.margins import (
    GAIN_CROSSOVER,
    LOWER_CROSSOVER,
    TABLE_1,
    UPPER_CROSSOVER,
    Case,
    cases,
    complementary_sensitivity,
    drive_loop,
    flexible_loop,
    margin_record,
    margins,
    rigid_loop,
    sensitivity,
    structure_path,
)
from models.dynamics.plant import closed_loop
from models.dynamics.servo import MEASURED, controller, current_loop
from models.dynamics.stages import NOMINAL, SERVOS, STAGES, Condition, stage_named, tuning_named
from models.errors import BadParameter, UnknownStage, UnstableLoop

NAMES = sorted(STAGES)


def simulated_loop(stage, condition=NOMINAL):
    """Return the open loop that the simulation closes, factored as in `servo`.

    It is the corrected reading to within the rounding of the printed coefficients.
    """
    tuning = tuning_named(stage_named(stage).name, condition.servo_id)
    force = control.ss([], [], [], [[tuning.force_constant]])
    servo = control.series(controller(tuning), current_loop(tuning), force)
    return control.series(servo, structure_path(stage, condition))


def of_kind(found, kind):
    """Return the crossovers of a kind."""
    return [c for c in found.crossovers if c.kind == kind]


def deciding(found, kind):
    """Return the crossover of a kind that decides, which is there."""
    crossover = found.deciding(kind)
    assert crossover is not None
    return crossover


@pytest.mark.parametrize(
    ("name", "crossover", "phase", "gain", "low"),
    [("lms-x", 19.6, 55.8, 24.5, 0.88), ("lms-y", 6.5, 37.0, 31.4, 0.97)],
)
def test_erratum_rigid_margins(name, crossover, phase, gain, low):
    """The corrected rigid loops have not the margins of Table 1, and a phase crossover at 0.9 Hz.

    19.6 Hz, 24.5 dB, 55.8° in X where Table 1 has 12.5, 14.5, 40.5; 6.5, 31.4, 37.0 in Y for
    10.5, 13.5, 30.3.  Below, at 0.9 Hz, a gain lower by 46 and 30 dB makes them unstable.
    """
    found = margins(rigid_loop(name, "corrected"))
    (bandwidth,) = of_kind(found, GAIN_CROSSOVER)
    assert bandwidth.frequency_hz == pytest.approx(crossover, abs=0.05)
    assert bandwidth.margin == pytest.approx(phase, abs=0.1)
    upper = of_kind(found, UPPER_CROSSOVER)
    assert upper[0].margin == pytest.approx(gain, abs=0.1)
    (lower,) = of_kind(found, LOWER_CROSSOVER)
    assert lower.frequency_hz == pytest.approx(low, abs=0.005)
    assert lower.margin < -30
    for got, printed in zip((crossover, gain, phase), TABLE_1[name], strict=True):
        assert abs(got / printed - 1) > 0.15


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_flexible_modes_do_not_explain_table_1(name):
    """The flexible structure moves bandwidth by less than 10 % and the phase margin by 2°."""
    rigid, flexible = (margins(loop(name, "corrected")) for loop in (rigid_loop, flexible_loop))
    stiff, soft = (deciding(m, GAIN_CROSSOVER) for m in (rigid, flexible))
    assert soft.frequency_hz == pytest.approx(stiff.frequency_hz, rel=0.1)
    assert soft.margin == pytest.approx(stiff.margin, abs=2.0)
    assert flexible.verdict == "meets"


@pytest.mark.parametrize("name", NAMES)
def test_all_crossovers_are_found(name):
    """On rigid loops ``control.stability_margins`` finds the same, from roots of polynomials."""
    loop = rigid_loop(name, "corrected")
    found = margins(loop)
    with np.errstate(all="ignore"):
        gains, phases, _, at_phase, at_gain, _ = control.stability_margins(loop, returnall=True)
    (gain,) = of_kind(found, GAIN_CROSSOVER)
    assert gain.frequency_hz == pytest.approx(float(at_gain[0]) / (2 * np.pi), rel=1e-6)
    assert gain.margin == pytest.approx(float(phases[0]), abs=1e-4)
    others = sorted((c for c in found.crossovers if c is not gain), key=lambda c: c.frequency_hz)
    assert len(gains) == len(others)
    assert [c.frequency_hz for c in others] == pytest.approx(at_phase / (2 * np.pi), rel=1e-5)
    assert [c.margin for c in others] == pytest.approx(20 * np.log10(gains), abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_denser_grid_finds_no_more(name, monkeypatch):
    """Four times the grid gives the same crossovers of the flexible loop."""
    loop = flexible_loop(name, "corrected")
    coarse = margins(loop)
    monkeypatch.setattr(module, "_PER_DECADE", 2400)
    fine = margins(loop)
    assert [c.name for c in fine.crossovers] == [c.name for c in coarse.crossovers]
    for a, b in zip(fine.crossovers, coarse.crossovers, strict=True):
        assert a.frequency_hz == pytest.approx(b.frequency_hz, rel=1e-9)
    assert fine.peak_sensitivity == pytest.approx(coarse.peak_sensitivity, rel=1e-6)


def test_a_sharp_resonance_is_not_missed(monkeypatch):
    """Two crossovers 0.02 Hz apart on a resonance of ζ = 1e-5 are both found.

    Without the points around the poles they fall between those of the grid.
    """
    w = 2 * np.pi * 123.4
    loop = control.ss([[0, w], [-w, -2e-5 * w]], [[0], [1e-4 * w]], [[1, 0]], [[0]])
    pair = of_kind(margins(loop), GAIN_CROSSOVER)
    assert len(pair) == 2
    assert pair[1].frequency_hz - pair[0].frequency_hz == pytest.approx(1e-4 * 123.4, rel=0.05)
    monkeypatch.setattr(module, "_AROUND_RESONANCE", np.zeros(0))
    assert not of_kind(margins(loop), GAIN_CROSSOVER)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [UPPER_CROSSOVER, LOWER_CROSSOVER])
@pytest.mark.parametrize("make", [rigid_loop, flexible_loop])
@pytest.mark.parametrize("name", NAMES)
def test_gain_margin_is_where_stability_ends(name, make, kind):
    """With 1 % less than the smallest gain margin the loop is stable, with 1 % more it is not."""
    loop = make(name, "corrected")
    margin = deciding(margins(loop), kind).margin
    for part, stable in ((0.99, True), (1.01, False)):
        assert margins(10 ** (part * margin / 20) * loop).stable is stable


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_phase_margin_is_where_stability_ends(name):
    """A delay of 1 % less than the phase margin is borne, of 1 % more is not."""
    loop = rigid_loop(name, "corrected")
    crossover = deciding(margins(loop), GAIN_CROSSOVER)
    delay = crossover.margin / 360 / crossover.frequency_hz
    for part, stable in ((0.99, True), (1.01, False)):
        lag = control.ss(control.tf(*control.pade(part * delay, 6)))
        assert margins(control.series(loop, lag)).stable is stable


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("name", NAMES)
def test_stability_of_rigid_loops(name, reading):
    """The largest real part of the poles is that of the roots of numerator plus denominator."""
    shaping, plant = factors(name, reading)
    product = shaping * plant
    # Scaled by 100 rad/s the polynomial of tenth order keeps its slow roots.
    scale = 100.0 ** np.arange(len(product.denominator))
    characteristic = np.array(product.denominator) * scale
    characteristic[: len(product.numerator)] += (
        np.array(product.numerator) * scale[: len(product.numerator)]
    )
    worst = 100.0 * np.roots(characteristic[::-1]).real.max()
    assert margins(rigid_loop(name, reading)).growth_per_s == pytest.approx(worst, rel=1e-5)


@pytest.mark.parametrize("condition", [Condition(), Condition(0.6, 0.5)])
@pytest.mark.parametrize("name", NAMES)
def test_simulated_loop_closes_to_the_simulated_poles(name, condition):
    """Opened at the servo's input and closed again, the loop has the poles of the simulation."""
    poles = complementary_sensitivity(simulated_loop(name, condition)).poles()
    expected = np.linalg.eigvals(closed_loop(stage_named(name), condition).a)
    for pole in expected:
        assert np.abs(poles - pole).min() < 1e-6 * max(1.0, abs(pole))
    assert len(poles) == len(expected)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_simulated_loop_is_the_corrected_reading(name):
    """The factored servo of the simulation has the margins of the corrected coefficients."""
    pair = [margins(simulated_loop(name)), margins(flexible_loop(name, "corrected"))]
    for ours, printed in zip(*(m.crossovers for m in pair), strict=True):
        assert ours.name == printed.name
        assert ours.frequency_hz == pytest.approx(printed.frequency_hz, rel=2e-3)
        assert ours.margin == pytest.approx(printed.margin, abs=0.1)


@pytest.mark.parametrize("name", NAMES)
def test_flexible_loop_is_rigid_below_the_structure(name):
    """At 0.1 Hz, far below every resonance, the loops around both structures agree."""
    s = 0.2j * np.pi
    assert flexible_loop(name, "derived")(s) == pytest.approx(
        rigid_loop(name, "derived")(s), rel=0.01
    )


def test_sensitivity_of_y_in_its_health_band():
    """Rigid, |S| is 1.005 to 1.010 from 117 to 137 Hz in Y; the roll and pitch modes widen it."""
    s = 2j * np.pi * np.linspace(117.0, 137.0, 500)
    rigid, flexible = (
        np.abs(sensitivity(loop("lms-y", "corrected"))(s)) for loop in (rigid_loop, flexible_loop)
    )
    assert rigid.min() == pytest.approx(1.005, abs=5e-4)
    assert rigid.max() == pytest.approx(1.010, abs=5e-4)
    assert np.ptp(flexible) > 2 * np.ptp(rigid)
    assert np.abs(flexible - 1).max() < 0.25


@pytest.mark.parametrize("name", NAMES)
def test_sensitivities_add_to_one(name):
    """S + T = 1, and no |S| is above the peak that is found."""
    loop = rigid_loop(name, "corrected")
    hertz = np.geomspace(0.01, 2000.0, 3000)
    s = 2j * np.pi * hertz
    error = sensitivity(loop)(s)
    assert np.abs(error + complementary_sensitivity(loop)(s) - 1).max() < 1e-9
    found = margins(loop)
    assert np.abs(error).max() <= found.peak_sensitivity * (1 + 1e-9)
    assert np.abs(error).max() == pytest.approx(found.peak_sensitivity, rel=1e-4)
    assert hertz[np.argmax(np.abs(error))] == pytest.approx(found.peak_hz, rel=5e-3)


@pytest.mark.slow
def test_a_structure_that_the_loop_cannot_hold_is_judged_unstable():
    """Where the simulation refuses to run, the same loop has the verdict, and grows as fast."""
    loose = Condition(guide_damping=0.01)
    with pytest.raises(UnstableLoop) as refused:
        closed_loop(stage_named("lms-x"), loose)
    found = margins(simulated_loop("lms-x", loose))
    assert found.verdict == "unstable"
    assert found.growth_per_s == pytest.approx(refused.value.growth_per_s, rel=1e-6)
    judged = {(c.reading, c.structure): c.margins.verdict for c in cases("lms-x", loose)}
    assert judged["corrected", "flexible"] == "unstable"
    assert judged["corrected", "rigid"] == "meets"


def test_textbook_loop():
    """1/(s (s+1) (s/5+1)) has gain margin 6 and its phase crossover at √5 rad/s."""
    loop = control.tf([1.0], np.polymul([1.0, 1.0, 0.0], [0.2, 1.0]))
    found = margins(loop)
    (upper,) = of_kind(found, UPPER_CROSSOVER)
    assert upper.margin == pytest.approx(20 * np.log10(6.0), abs=1e-6)
    assert upper.frequency_hz == pytest.approx(np.sqrt(5) / (2 * np.pi), rel=1e-9)
    assert found.verdict == "meets"
    # 7.6 dB would do, 20° does not.
    tight = margins(2.5 * loop)
    assert [c.enough for c in tight.crossovers] == [False, True]
    assert tight.verdict == "fails"
    assert margins(7.0 * loop).verdict == "unstable"


def test_phase_of_a_full_turn_is_no_crossover():
    """0.9/(s+1)⁶ crosses −180° at tan 30° rad/s; its −360° at tan 60° is no phase crossover."""
    (only,) = margins(control.tf([0.9], np.poly([-1.0] * 6))).crossovers
    assert only.kind == UPPER_CROSSOVER
    assert 2 * np.pi * only.frequency_hz == pytest.approx(np.tan(np.pi / 6), rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_printed_loops_do_not_work(name):
    """As printed the product of the equations is unstable, rigid and flexible, and is called so."""
    for case in cases(name):
        if case.reading == "printed" and "×" in case.equations:
            assert case.margins.verdict == "unstable"
            assert {row["enough"] for row in margin_record(case)["crossovers"]} == {None}


def test_erratum_open_loops_as_printed():
    """(10) as printed has no roll-off: 5e6 at infinity; (11) grows by 221 1/s."""
    x, y = (margins(ratio(equation, "printed").state_space()) for equation in (10, 11))
    assert x.verdict == "no roll-off"
    ten = ratio(10, "printed")
    assert ten.numerator[5] / ten.denominator[5] == pytest.approx(5.09e6, rel=1e-3)
    assert y.verdict == "unstable"
    assert y.growth_per_s == pytest.approx(220.9, abs=0.1)


def test_crossovers_on_a_resonance_are_named():
    """A crossover within 5 % of natural frequencies has the nearest one's name, others none."""
    found = margins(rigid_loop("lms-x", "corrected"))
    resonances = {"low": 19.0, "near": 20.0, "high": 400.0}
    case = Case("corrected", "flexible", "", found, resonances)
    assert [case.near(c) for c in found.crossovers] == [None, "near", None, None, None]
    rigid = Case("corrected", "rigid", "", found, {})
    assert [rigid.near(c) for c in found.crossovers] == [None] * 5


@pytest.mark.slow
def test_command_as_json():
    """The JSON names every loop, its crossovers and what decides, with null and never NaN."""
    result = CliRunner().invoke(cli, ["margins", "lms-x", "--format", "json"])
    report = json.loads(result.output, parse_constant=pytest.fail)
    assert report["needed"] == {"gain_margin_db": 6.0, "phase_margin_deg": 30.0}
    loops = {(r["reading"], r["structure"], r["equations"]): r for r in report["loops"]}
    assert set(loops) == {
        *((reading, kind, "(6) × (8)") for reading in READINGS for kind in ("rigid", "flexible")),
        ("printed", "rigid", "(10)"),
    }
    rows = loops["corrected", "rigid", "(6) × (8)"]["crossovers"]
    assert [row["crossover"] for row in rows] == [
        "lower phase crossover 1",
        "gain crossover 1",
        "upper phase crossover 1",
        "upper phase crossover 2",
        "upper phase crossover 3",
    ]
    assert [row["decides"] for row in rows] == [True, True, True, False, False]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_command_as_table(name, monkeypatch):
    """At 100 columns no cell of the table is cut or broken."""
    monkeypatch.setenv("COLUMNS", "100")
    output = CliRunner().invoke(cli, ["margins", name]).output
    assert max(map(len, output.splitlines())) <= 100
    assert "…" not in output
    assert "corrected, flexible, (" in output
    assert "upper phase 1" in output
    assert "unstable" in output


def test_command_refuses():
    """An unknown stage and a preload without meaning are named errors."""
    with pytest.raises(UnknownStage):
        CliRunner().invoke(cli, ["margins", "lms-z"], catch_exceptions=False)
    with pytest.raises(BadParameter, match="guide_preload is 0"):
        CliRunner().invoke(cli, ["margins", "lms-x", "--preload", "0"], catch_exceptions=False)


def test_command_help_has_an_example():
    """The command's help ends with an example."""
    output = CliRunner().invoke(cli, ["margins", "--help"]).output
    assert "Example: python -m models margins" in output


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(MEASURED))
def test_margins_of_the_full_stages_are_those_measured(name):
    """Bandwidth and margins are within 10 % of Table 1; control: not without lag."""

    def off(**change):
        tunings = {**SERVOS["commissioning"], name: replace(MEASURED[name], **change)}
        with patch.dict(SERVOS, commissioning=tunings):
            found = margins(drive_loop(name, "flexible"))
        first = of_kind(found, GAIN_CROSSOVER)[0]
        limits = first.frequency_hz, deciding(found, UPPER_CROSSOVER).margin, first.margin
        return np.abs(np.array(limits) / TABLE_1[name] - 1)

    assert off().max() < 0.1
    assert off(delay=1e-4)[1:].min() > 0.15
