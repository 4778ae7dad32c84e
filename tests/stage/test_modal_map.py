"""Modal maps: exact where the truth is a polynomial, honest about error, never extrapolated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.polynomial import Chebyshev

from lmshealth.errors import BadStage, OutsideMap
from lmshealth.stage.description import load_stage, shipped
from lmshealth.stage.modal_map import ModalMap, read_map
from tests.lives import BEND, FREQUENCY, SENSITIVITY, map_rows, true_drift

NAMES = ("guide_preload", "mount_stiffness")


def write(folder: Path, rows: list[str]) -> str:
    """Write a map and give its path."""
    path = folder / "map.csv"
    path.write_text("\n".join(rows) + "\n")
    return str(path)


@pytest.fixture
def small(tmp_path: Path) -> ModalMap:
    """Two parameters, two modes, quadratic in ln parameter."""
    return read_map(write(tmp_path, map_rows(NAMES)), NAMES)


def points(modal_map: ModalMap, n: int = 200) -> np.ndarray:
    """Draw ln parameters all over the grid."""
    share = np.random.default_rng(1).uniform(size=(n, len(modal_map.parameters)))
    return modal_map.low + share * (modal_map.high - modal_map.low)


def test_a_polynomial_map_is_reproduced_exactly(small: ModalMap) -> None:
    """Between grid points the surrogate equals the formula that made the map."""
    x = points(small)
    known = np.log(FREQUENCY[:2]) + true_drift(NAMES, x)[:, :2]
    np.testing.assert_allclose(small.ln_frequency(x), known, atol=1e-12)
    assert (small.leave_out_error < 1e-12).all()


def test_the_gradient_is_that_of_the_formula(small: ModalMap) -> None:
    """The derivative of a quadratic map is known everywhere, the corners of the grid included."""
    corners = np.array([small.low, small.high, [small.low[0], small.high[1]]])
    x = np.concatenate([points(small), corners])
    known = np.stack([np.tile(SENSITIVITY[name][:2], (len(x), 1)) for name in NAMES], axis=-1)
    known[:, :, 0] += 2 * BEND * x[:, :1]
    np.testing.assert_allclose(small.gradient(x), known, atol=1e-11)


@pytest.mark.parametrize("names", [NAMES[:1], (*NAMES, "foot")], ids=["one", "three"])
def test_the_gradient_has_one_slope_per_mode_and_parameter(
    tmp_path: Path, names: tuple[str, ...]
) -> None:
    """Axes are points, modes, parameters, however many parameters there are."""
    found = read_map(write(tmp_path, map_rows(names)), names)
    x = points(found, 7)
    known = np.stack([np.tile(SENSITIVITY[name][:2], (7, 1)) for name in names], axis=-1)
    known[:, :, 0] += 2 * BEND * x[:, :1]
    np.testing.assert_allclose(found.gradient(x), known, atol=1e-10)


@pytest.mark.parametrize("name", ["lms-x", "lms-y"])
def test_the_gradient_is_the_limit_of_differences(name: str) -> None:
    """On curved maps central differences inside, and one-sided ones at the corners, approach it."""
    stage = load_stage(name)
    assert stage.modal_map is not None
    found, step = stage.modal_map, 1e-4
    inner = 0.99 * points(found, 50) + 0.005 * (found.low + found.high)
    for k, shift in enumerate(step * np.eye(2)):
        change = found.ln_frequency(inner + shift) - found.ln_frequency(inner - shift)
        np.testing.assert_allclose(found.gradient(inner)[:, :, k], change / (2 * step), atol=1e-6)
        for corner, inward in ((found.low, shift), (found.high, -shift)):
            at = corner + np.outer([0, 1, 2], inward)
            f = found.ln_frequency(at)
            # Three points take the bend out of a one-sided difference.
            change = (-3 * f[0] + 4 * f[1] - f[2]) / (2 * inward[k])
            np.testing.assert_allclose(found.gradient(corner[None])[0, :, k], change, atol=1e-5)


def test_the_order_of_rows_and_columns_does_not_matter(tmp_path: Path, small: ModalMap) -> None:
    """Shuffled rows, and columns in another order, make the same surrogate."""
    head, *rows = map_rows(NAMES)
    np.random.default_rng(2).shuffle(rows)
    turned = [",".join(np.array(row.split(","))[[3, 2, 1, 0]]) for row in [head, *rows]]
    other = read_map(write(tmp_path, turned), NAMES)
    x = points(small)
    order = [other.modes.index(mode) for mode in small.modes]
    np.testing.assert_allclose(other.ln_frequency(x)[:, order], small.ln_frequency(x), atol=1e-12)


def test_leave_out_error_tells_a_map_that_is_not_smooth(tmp_path: Path) -> None:
    """A kink of 1 % between grid points shows in the error of the mode that has it alone."""
    head, *rows = map_rows(NAMES)
    kinked = []
    for row in rows:
        preload, mount, mode, f = row.split(",")
        jump = 1.01 if mode == "roll" and float(preload) > 0.6 else 1.0
        kinked.append(f"{preload},{mount},{mode},{float(f) * jump:.17g}")
    found = read_map(write(tmp_path, [head, *kinked]), NAMES)
    assert found.leave_out_error[found.modes.index("roll")] > 1e-3
    assert found.leave_out_error[found.modes.index("pitch")] < 1e-10


def test_leave_out_error_bounds_the_error_between_grid_points(tmp_path: Path) -> None:
    """For a curved map the true error inside the grid is of the order that is stated."""
    axis = np.geomspace(0.2, 1.5, 9)
    rows = ["guide_preload,mode,frequency_hz"]
    rows += [f"{p:.17g},roll,{100 * np.exp(0.3 * np.tanh(2 * np.log(p))):.17g}" for p in axis]
    found = read_map(write(tmp_path, rows), ("guide_preload",))
    x = points(found)
    miss = np.abs(found.ln_frequency(x)[:, 0] - np.log(100) - 0.3 * np.tanh(2 * x[:, 0])).max()
    assert miss < 2 * found.leave_out_error[0]
    assert found.leave_out_error[0] < 0.1


def test_leave_out_error_is_that_of_fits_without_a_point(tmp_path: Path) -> None:
    """The largest miss of numpy's fits of the same degree, each without one inner point."""
    axis = np.geomspace(0.2, 1.5, 9)
    f = 100 * np.exp(0.3 * np.tanh(2 * np.log(axis)))
    rows = [f"{p:.17g},roll,{value:.17g}" for p, value in zip(axis, f, strict=True)]
    found = read_map(write(tmp_path, ["p,mode,frequency_hz", *rows]), ("p",))
    x, degree = np.log(axis), found.coefficients.shape[0] - 1
    misses = []
    for k in range(1, 8):
        rest = np.delete(np.arange(9), k)
        fit = Chebyshev.fit(x[rest], np.log(f[rest]), degree, domain=[x[0], x[-1]])
        misses.append(abs(fit(x[k]) - np.log(f[k])))
    assert found.leave_out_error[0] == pytest.approx(max(misses), rel=1e-9)


@pytest.mark.parametrize("n", [3, 4, 5])
def test_a_map_of_one_parameter_with_few_values_is_enough(tmp_path: Path, n: int) -> None:
    """Three to five values of one parameter make a map that meets a straight line exactly."""
    axis = np.geomspace(0.5, 2.0, n)
    rows = ["p,mode,frequency_hz", *(f"{p:.17g},roll,{50 * p**0.3:.17g}" for p in axis)]
    found = read_map(write(tmp_path, rows), ("p",))
    x = points(found, 20)
    np.testing.assert_allclose(found.ln_frequency(x)[:, 0], np.log(50) + 0.3 * x[:, 0], atol=1e-12)
    assert found.leave_out_error[0] < 1e-12


def test_three_parameters_make_a_map(tmp_path: Path) -> None:
    """The tensor surrogate works for more than two axes."""
    names = (*NAMES, "foot")
    found = read_map(write(tmp_path, map_rows(names)), names)
    x = points(found)
    known = np.log(FREQUENCY[:2]) + true_drift(names, x)[:, :2]
    np.testing.assert_allclose(found.ln_frequency(x), known, atol=1e-11)


def test_a_map_is_never_extrapolated(small: ModalMap) -> None:
    """One point outside among many raises, and the error names its parameters."""
    x = points(small, 5)
    x[3, 1] = small.high[1] + 1e-3
    assert small.inside(x).tolist() == [True, True, True, False, True]
    for ask in (small.ln_frequency, small.gradient):
        with pytest.raises(OutsideMap, match=r"mount_stiffness.*make a wider map"):
            ask(x)


def test_the_edge_of_the_grid_is_inside(small: ModalMap) -> None:
    """Corners belong to the map."""
    corners = np.array([small.low, small.high])
    assert small.inside(corners).all()
    assert np.isfinite(small.ln_frequency(corners)).all()


@pytest.mark.parametrize(
    ("change", "needle"),
    [
        (lambda rows: [r.replace("frequency_hz", "hz") for r in rows], "no column.*frequency_hz"),
        (lambda rows: [r.replace("mount_stiffness", "foot") for r in rows], "mount_stiffness"),
        (lambda rows: [rows[0] + ",load", *(r + ",1" for r in rows[1:])], "load.*not parameters"),
        (lambda rows: [r.replace("pitch", "") for r in rows], "line 3: a mode without a name"),
        (lambda rows: rows[:-1], "97 values where a full grid of 49"),
        (lambda rows: [*rows, rows[-1]], "line 100: .*twice"),
        (lambda rows: [*rows[:-1], rows[-1].rsplit(",", 1)[0] + ",-3"], "line 99: .*-3.*positive"),
        (
            lambda rows: [*rows[:-1], rows[-1].rsplit(",", 1)[0] + ","],
            "line 99: frequency_hz is nan.*positive",
        ),
    ],
    ids=["no-frequency", "no-parameter", "extra", "no-name", "hole", "twice", "negative", "empty"],
)
def test_a_map_that_breaks_its_contract_is_refused(tmp_path: Path, change, needle: str) -> None:
    """The error names the file and what is missing."""
    with pytest.raises(BadStage, match=needle) as caught:
        read_map(write(tmp_path, change(map_rows(NAMES))), NAMES)
    assert "map.csv" in str(caught.value)


def test_text_where_numbers_belong_is_refused_as_such(tmp_path: Path) -> None:
    """A word in a number column is an error of the map with its line; blank lines count."""
    rows = map_rows(NAMES)
    rows[3] = "low" + rows[3][rows[3].index(",") :]
    rows.insert(2, "")
    with pytest.raises(BadStage, match=r"map\.csv: line 5: guide_preload is low; needed"):
        read_map(write(tmp_path, rows), NAMES)


def test_too_few_grid_values_are_refused(tmp_path: Path) -> None:
    """Two values of a parameter make no surrogate."""
    rows = ["p,mode,frequency_hz", "1,roll,100", "2,roll,120"]
    with pytest.raises(BadStage, match=r"at least 3 grid values.*'p': 2"):
        read_map(write(tmp_path, rows), ("p",))


def test_a_map_that_is_not_there_is_refused(tmp_path: Path) -> None:
    """The path is in the message."""
    with pytest.raises(BadStage, match=r"gone\.csv"):
        read_map(str(tmp_path / "gone.csv"), NAMES)


@pytest.mark.parametrize("name", ["lms-x", "lms-y"])
def test_shipped_maps_are_smooth_and_hold_their_nominal_frequencies(name: str) -> None:
    """Shipped maps leave out at most 1e-5 and give the nominal frequencies at baseline.

    In Y roll and pitch, named by their shapes, cross on mounts stiffer than new although they repel
    each other there: no smooth surrogate meets that, the error is 1.5e-5.
    """
    assert name in shipped()
    stage = load_stage(name)
    assert stage.modal_map is not None
    limit = 2e-5 if name == "lms-y" else 1e-5
    assert (stage.modal_map.leave_out_error <= limit).all()
    base = stage.modal_map.ln_frequency(stage.baseline_point[None])[0]
    for mode in stage.modes:
        f = np.exp(base[stage.modal_map.modes.index(mode.name)])
        assert f == pytest.approx(mode.frequency_hz, rel=0.01)


def test_the_x_stage_does_not_see_its_mount_and_the_y_stage_does() -> None:
    """Sensitivity to the mount is next to nothing in X, and in Y of the size of the preload's."""
    slopes = {}
    for name in ("lms-x", "lms-y"):
        stage = load_stage(name)
        assert stage.modal_map is not None
        slopes[name] = np.abs(stage.modal_map.gradient(stage.baseline_point[None])[0])
    assert slopes["lms-x"][:, 1].max() < 0.1
    assert slopes["lms-y"][:, 1].max() > 0.15
    assert (slopes["lms-y"][:, 0].max()) > 0.05


@pytest.mark.parametrize("name", ["lms-x", "lms-y"])
def test_parameters_alone_are_points_with_all_others_at_their_base(name: str) -> None:
    """Drifts along points and of each parameter alone are those at points made for each."""
    stage = load_stage(name)
    found = stage.modal_map
    assert found is not None
    x = np.random.default_rng(2).uniform(found.low, found.high, (50, found.low.size))
    alone = (np.where(own, x, stage.baseline_point) for own in np.eye(x.shape[1], dtype=bool))
    modes = found.modes[::-1]
    known = [stage.drift(one, modes) for one in (x, *alone)]
    np.testing.assert_allclose(stage.drifts(x, modes), known, rtol=0, atol=1e-13)


def test_a_row_with_too_many_cells_is_no_table(tmp_path: Path) -> None:
    """Cells without a column could be anything."""
    rows = ["p,mode,frequency_hz", "1,roll,100,7"]
    with pytest.raises(BadStage, match="no table of numbers with commas"):
        read_map(write(tmp_path, rows), ("p",))
