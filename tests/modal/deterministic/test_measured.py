"""Measured responses: tables and UFF58 of function type 4, noise known and unknown, refusals."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lmshealth.errors import BadLog
from lmshealth.io.column_map import load_columns
from lmshealth.modal.deterministic.frequency_response import read_measured
from lmshealth.modal.deterministic.measured import read_responses
from studies.modes.frf.records import Machine

F = np.arange(0.0, 200.0, 0.5)
MACHINE = Machine(modes=((62.0, 0.015, 1.0), (130.0, 0.02, -0.6)))
AVERAGES, NOISE = 12, 0.02


def lines(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return a response with the scatter of its averages, and the coherence they show."""
    rng, h = np.random.default_rng(seed), np.zeros(F.size, dtype=complex)
    h[1:] = MACHINE.response(F[1:])
    scatter = rng.standard_normal((2, AVERAGES, F.size)) * NOISE * np.abs(h).max() / math.sqrt(2)
    each = h + scatter[0] + 1j * scatter[1]
    power = np.mean(np.abs(each) ** 2, axis=0)
    return each.mean(axis=0), np.abs(each.mean(axis=0)) ** 2 / power


H, COHERENCE = lines()


def table(path: Path, **columns: np.ndarray) -> Path:
    """Write a table of lines."""
    np.savetxt(path, np.column_stack(list(columns.values())), header=",".join(columns),
               delimiter=",", comments="")  # fmt: skip
    return path


def assert_found(path: Path, **options: Any) -> np.ndarray:
    """Expect both modes of the first response within four standard deviations; return these."""
    modes = read_measured(read_responses(path)[0], **options).modes
    truth = np.log([62, 130, 0.015, 0.02])
    std = np.sqrt(np.diag(modes.cov))
    error = np.concatenate([modes.ln_frequency, modes.ln_damping]) - truth
    assert np.abs(error / std).max() < 4
    return std


def test_noise_is_that_of_the_residual_or_of_coherence_and_averages(tmp_path: Path) -> None:
    """Both give the same standard deviations within a third: the residual is honest."""
    path = table(tmp_path / "a.csv", frequency_hz=F, real=H.real, imag=H.imag, coherence=COHERENCE)
    unknown, known = assert_found(path), assert_found(path, averages=AVERAGES)
    assert unknown == pytest.approx(known, rel=1 / 3)
    (response,) = read_responses(path)
    for averages in (None, 1, AVERAGES):
        reading = read_measured(response, averages=averages)
        assert reading.frf.std.mean() == pytest.approx(
            NOISE * np.abs(H).max() / math.sqrt(AVERAGES), rel=0.2
        )
        assert math.isnan(reading.fit.chi_square) == (averages != AVERAGES)


def test_tables_name_responses_parts_and_units(tmp_path: Path) -> None:
    """Several responses, gain and phase, other units of both, other names by a column map."""
    path = table(
        tmp_path / "b.csv",
        frequency_khz=F / 1e3, acc_x_g_per_kn_db=20 * np.log10(np.abs(H)),
        acc_x_g_per_kn_phase_rad=np.angle(H), h21_real=H.real, h21_imag=H.imag,
    )  # fmt: skip
    one, other = read_responses(path)
    assert (one.output, one.unit, other.output, other.unit) == ("acc_x", "(m/s²)/N", "h21", "")
    assert one.name.endswith("b.csv:acc_x")
    np.testing.assert_allclose(one.values, 9.80665e-3 * other.values, rtol=1e-9)
    np.testing.assert_allclose(one.frequency, F[1:])
    (tmp_path / "map.toml").write_text('[columns]\nfrequency_hz = "f"\nreal = "a"\nimag = "b"\n')
    path = table(tmp_path / "c.csv", f=F, a=H.real, b=H.imag)
    assert read_responses(path) == ()
    (mapped,) = read_responses(path, columns=load_columns(tmp_path / "map.toml"))
    np.testing.assert_allclose(mapped.values, other.values, rtol=1e-9)


# pyuff leaves files open.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("binary", [0, 1])
@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("even", [0, 1])
def test_uff_holds_responses_with_coherence(
    tmp_path: Path, binary: int, double: bool, even: int
) -> None:
    """ASCII or binary, single or double, even or not: degrees of freedom name the responses."""
    pyuff = pytest.importorskip("pyuff")
    file = pyuff.UFF(str(tmp_path / "a.uff"))
    for node, kind, values in ((1, 4, H), (2, 4, 2 * H), (2, 6, COHERENCE)):
        code = (6 if double else 5) if kind == 4 else (4 if double else 2)
        file.write_sets(
            {"type": 58, "func_type": kind, "binary": binary, "data": values, "x": F,
             "rsp_node": node, "rsp_dir": 3, "ref_node": 1, "ref_dir": -1, "num_pts": F.size,
             "abscissa_spacing": even, "abscissa_min": 0.0, "abscissa_inc": 0.5,
             "abscissa_spec_data_type": 18, "abscissa_axis_units_lab": "Hz",
             "ordinate_axis_units_lab": "m/s2", "orddenom_axis_units_lab": "N",
             "orddenom_spec_data_type": 13,
             "ordinate_spec_data_type": 12, "ord_data_type": code},
            "add",
        )  # fmt: skip
    one, other = read_responses(tmp_path / "a.uff")
    assert (one.output, one.input, other.output) == ("1+Z", "1-X", "2+Z")
    assert (bool(np.isnan(one.coherence).all()), other.unit) == (True, "(m/s2)/(N)")
    np.testing.assert_allclose(other.frequency, F[1:], rtol=1e-5)
    np.testing.assert_allclose(other.values, 2 * H[1:], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(other.coherence, COHERENCE[1:], rtol=1e-4)


def test_coarse_lines_without_noise_show_a_mode_or_are_the_reason_why_not(tmp_path: Path) -> None:
    """A resonance of 77 Hz and 1.5 %: lines every 2 Hz show it, every 4 Hz do not."""
    for step, found in ((2.0, True), (4.0, False)):
        f = np.arange(8.0, 180.0, step)
        h = Machine(modes=((77.0, 0.015, 1.0),)).response(f)
        path = table(tmp_path / f"{step:g}.csv", frequency_hz=f, real=h.real, imag=h.imag)
        modes = read_measured(read_responses(path)[0]).modes
        assert modes.frequency.tolist() == (pytest.approx([77], rel=1e-3) if found else [])
        assert found or modes.refused[-1].reason == "too-few-lines"


def test_the_damping_of_an_exponential_window_is_removed(tmp_path: Path) -> None:
    """A window of 2 s adds 1/τ = 0.5 to ζω, and leaves ω√(1-ζ²); one of 0.05 s is all there is."""
    own = [2 * np.pi * f * (-z + 1j * math.sqrt(1 - z**2)) for f, z, _ in MACHINE.modes]
    added = [p - 0.5 for p in own]
    machine = Machine(modes=tuple((abs(p) / 2 / np.pi, -p.real / abs(p), 1.0) for p in added))
    h = machine.response(F[1:]) * (1 + 1e-4 * np.random.default_rng(1).standard_normal(F.size - 1))
    path = table(tmp_path / "a.csv", frequency_hz=F[1:], real=h.real, imag=h.imag)
    assert_found(path, window=2.0)
    modes = read_measured(read_responses(path)[0], window=0.05).modes
    assert modes.names == ()
    assert {r.reason for r in modes.refused} == {"too-uncertain"}


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    """A part, lines in order, enough lines, the other response of a file."""
    half = table(tmp_path / "a.csv", frequency_hz=F, real=H.real)
    with pytest.raises(BadLog, match=r"has real; needed real and imag, or magnitude .* and phase"):
        read_responses(half)
    mixed = table(tmp_path / "b.csv", frequency_hz=F[::-1], real=H.real, imag=H.imag)
    with pytest.raises(BadLog, match=r"do not ascend: 199 Hz follows 199.5 Hz"):
        read_responses(mixed)
    unit = table(tmp_path / "c.csv", frequency_hz=F, acc_g_per_lb_real=F, acc_g_per_lb_imag=F)
    with pytest.raises(BadLog, match=r"per 'lb'; needed one of n, kn"):
        read_responses(unit)
    few = table(tmp_path / "d.csv", frequency_hz=F[:20], real=H[:20].real, imag=H[:20].imag)
    with pytest.raises(BadLog, match=r"19 lines in the band.* needed 34 .*16 suffice with coh"):
        read_measured(read_responses(few)[0])


def test_a_real_file_of_few_lines_is_refused_as_that(needs: Callable[[str], None]) -> None:
    """Five lines of a file with a header that is no ASCII."""
    needs("data")
    data = Path(os.environ["LMSHEALTH_DATA"])
    (response,) = read_responses(data / "uff58_samples" / "non_ascii_header.uff")
    assert response.output == "ref6_23_Mar"
    with pytest.raises(BadLog, match="has 5 lines"):
        read_measured(response)


def test_a_damaged_file_is_refused_as_that(tmp_path: Path) -> None:
    """Cut off, or of another format: no traceback."""
    (tmp_path / "a.uff").write_bytes(b"    -1\n    58\n")
    with pytest.raises(BadLog, match=r"corrupt"):
        read_responses(tmp_path / "a.uff")
    (tmp_path / "b.uff").write_bytes(b"\x89HDF\r\n\x1a\n" + b"\0" * 100)
    with pytest.raises(BadLog, match=r"the content is HDF5; rename the file"):
        read_responses(tmp_path / "b.uff")
