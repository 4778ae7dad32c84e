"""Figures of single logs."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Annotation, Text

from lmshealth.io.log import Log, Refusal
from lmshealth.modal.ambient.wandering import Harmonic
from lmshealth.modal.identification import ModalReading, read_ambient
from lmshealth.modal.mode_shapes import ModeShapes
from lmshealth.modal.modes import Modes, estimates_only, merge, numbered
from lmshealth.report.log_figures import (
    LogFigure,
    modes_figure,
    plot_shape,
    plot_shapes,
    plot_spectra,
    shapes_size,
    write_figure,
)
from lmshealth.signal.segments import find_segments
from lmshealth.signal.spectra import LogSpectra, cross_spectra
from lmshealth.signal.spectral_lines import Line
from lmshealth.stage.description import ChannelSpec, load_stage
from tests.report.test_readable import seen_in_a_log
from tests.signals import Mode, accelerations, make_log, make_stage, sine, white

RATE, N = 500.0, 16000


@pytest.fixture(scope="module")
def log() -> Log:
    """White noise of density 1 with a line, and a mode at 62 Hz; a dollar sign in its name."""
    rng = np.random.default_rng(3)
    noise = white(rng, 1.0, N, RATE) + sine(N, RATE, 50.0, 10.0)
    shaken = accelerations(rng, [Mode(62.0, 0.02)], N, RATE, 0.5)[0]
    return make_log({"acc_n": noise, "acc_$s": shaken}, RATE)


def some_modes(ln_f_std: float, *frequencies: float) -> Modes:
    """Give modes with a line in acc_n and a candidate that was refused."""
    n = len(frequencies)
    estimate = np.log([*frequencies, *[0.02] * n])
    cov = np.diag([ln_f_std**2] * n + [0.1**2] * n)
    found = estimates_only(estimate, cov, np.full(n, 100.0), "acc", ["acc_$s"] * n)
    refused = Refusal("log", "too-uncertain", "a $ and a $", mode="80.5 Hz", frequency=80.5)
    return numbered(merge([found], [Line(50.0, 10.0, "m/s²", "mains", "acc_n")], [refused]))


def read(log: Log, modes: Modes) -> ModalReading:
    """Give the spectra of a whole log."""
    segments = find_segments(log, 1.0)
    spectra = cross_spectra(log.channels, segments, RATE, 0.49 * RATE)
    names = tuple(channel.name for channel in log.channels)
    return ModalReading(modes, LogSpectra(names, ("acc",) * len(names), spectra))


def draw(figure: LogFigure) -> Figure:
    """Draw with matplotlib, and lay out."""
    whole = Figure(figsize=figure.size, layout="constrained")
    FigureCanvasAgg(whole)
    figure.draw(whole)
    whole.canvas.draw()
    return whole


def test_spectra_modes_lines_and_refusals_stand_at_their_places(log: Log) -> None:
    """The level of white noise, the interval of a mode, a line in its channel, a candidate."""
    whole = draw(modes_figure(log, read(log, some_modes(0.01, 62.0)), band=(40.0, 90.0)))
    first, second, _ = whole.axes  # then the singular values
    curves: dict[str, Any] = {str(line.get_label()): line for line in first.lines}
    x, y = np.asarray(first.lines[0].get_data(), dtype=float)
    away = np.abs(x - 50) > 2
    assert y[away].mean() == pytest.approx(1.0, abs=5 / np.sqrt(away.sum() * 4))
    assert curves["line: mains"].get_xdata() == pytest.approx([50.0])
    assert curves["refused, or not found"].get_xdata() == pytest.approx([80.5, 80.5])
    assert not [line for line in second.lines if line.get_label() == "line: mains"
                and len(np.asarray(line.get_xdata()))]  # fmt: skip
    (span,) = (p for p in second.patches if "95 %" in str(p.get_label()))
    box: Any = span
    assert (box.get_x(), box.get_x() + box.get_width()) == pytest.approx(
        62.0 * np.exp([-0.0196, 0.0196])
    )
    assert [text.get_text() for text in first.texts][1:] == [
        "mode 1\n62.00 ± 0.62 Hz", "80.5 Hz\ntoo-uncertain"
    ]  # fmt: skip


@pytest.mark.parametrize("frequencies", [(60.0, 60.2, 60.4), tuple(60 + 0.1 * np.arange(12))])
def test_names_of_close_modes_do_not_overlap(log: Log, frequencies: tuple[float, ...]) -> None:
    """Labels above the axes are moved apart, upright when there are many."""
    reading = read(log, some_modes(1e-4, *frequencies))
    whole = draw(modes_figure(log, reading, band=(40.0, 90.0)))
    # The extent of an annotation includes its arrow.
    texts = [Text.get_window_extent(text) for text in whole.axes[0].texts[1:]]
    spans = sorted((box.x0, box.x1) for box in texts)
    assert len(spans) == len(frequencies) + 1
    assert all(end <= start for (_, end), (start, _) in pairwise(spans))
    assert spans[-1][1] <= whole.bbox.x1


def test_a_described_mode_that_is_refused_is_drawn_where_it_is_described(log: Log) -> None:
    """The whole search is shown."""
    stage = make_stage([("roll", 80.0, 0.02)])
    refusal = Refusal("log", "not-excited", "none", mode=stage.modes[0].name)
    whole = draw(modes_figure(log, read(log, merge([], [], [refusal])), stage))
    (line,) = (one for one in whole.axes[0].lines if "refused" in str(one.get_label()))
    assert np.asarray(line.get_xdata()) == pytest.approx(80.0)
    reach = stage.modes[0].search
    assert whole.axes[0].get_xlim() == pytest.approx((80 * (1 - reach), 80 * (1 + reach)))


def test_figures_are_reproducible_and_keep_dollar_signs(log: Log, tmp_path: Path) -> None:
    """A dollar sign starts no formula; the bytes of a figure are the same each time."""
    figure = modes_figure(log, read(log, some_modes(0.01, 62.0)), band=(40.0, 90.0))
    for suffix in ("svg", "png", "html"):
        for name in "ab":
            write_figure(tmp_path / f"{name}.{suffix}", figure)
        assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()


def test_resonances_that_were_rejected_are_drawn_where_they_were_found(log: Log) -> None:
    """Without a description the list of refusals lacks them; those not excited are not drawn."""
    rejected = (
        Refusal("log", "poor-fit", "scatters", mode="mode_7", frequency=70.25),
        Refusal("log", "not-excited", "nothing", mode="mode_8", frequency=75.0),
    )
    reading = replace(read(log, numbered(merge([], [], []))), rejected=rejected)
    whole = draw(modes_figure(log, reading, band=(40.0, 90.0)))
    assert [t.get_text() for t in whole.axes[0].texts][1:] == ["70.25 Hz\npoor-fit"]


def test_shapes_are_drawn_where_the_description_places_the_sensors() -> None:
    """Two sensors at one place and one above; the largest motion is a quarter of their extent."""
    shape = np.array([[1.0, -0.5, 0.25]], dtype=complex)
    shapes = ModeShapes(("roll",), ("a", "b", "c"), shape)
    places = [
        ChannelSpec("a", (0.0, 0.0, 0.0), (2.0, 0.0, 0.0)),
        ChannelSpec("b", (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
        ChannelSpec("c", (0.0, 0.0, 4.0), (0.0, 0.0, -1.0)),
    ]
    ax = plot_shape(Figure().add_subplot(), shapes, 0, places)
    tips = [text.xy for text in ax.texts if isinstance(text, Annotation)]
    motions = np.array([[1.0, -0.5, 0.0], [0.0, 0.0, -0.25]]) / np.hypot(1.0, 0.5)
    rest = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 4.0]])
    isometric = np.array([[0.866, -0.5], [0.866, 0.5], [0.0, 1.0]])
    assert np.array(tips) == pytest.approx((rest + motions) @ isometric)


def test_components_stand_beside_those_of_the_baseline() -> None:
    """Bars are real parts, points imaginary ones; the baseline is turned to the same sign."""
    now = ModeShapes(("roll", "yaw"), ("a", "b"), np.array([[1.0, -0.5 + 0.2j], [np.nan, 1.0]]))
    before = ModeShapes(("roll",), ("b", "a"), np.array([[0.4, -0.8]], dtype=complex))
    figure = Figure()
    plot_shapes(figure, now, None, before)
    (ax,) = figure.axes  # a mode in one channel has no shape
    widths = [[bar.get_width() for bar in part] for part in ax.containers]
    assert widths == [pytest.approx([0.8, -0.4]), pytest.approx([1.0, -0.5])]
    assert np.asarray(ax.lines[0].get_xdata()) == pytest.approx([0.0, 0.2])
    assert ax.get_title() == "roll\nMPC 0.90, MAC 0.98"
    assert shapes_size(now.__class__((), (), np.empty((0, 0), complex)), None)[1] == 0


def test_the_baseline_and_the_declared_frequencies_are_in_the_spectrum() -> None:
    """An earlier log is an area with its modes; orders are where the velocity puts them."""
    latest, before = seen_in_a_log(), seen_in_a_log("log-1.h5", seed=3)
    spectra = latest.spectra
    assert spectra is not None
    spectra = replace(spectra, velocities=(0.128,))  # 32 Hz over 4 mm
    stage = load_stage("lms-y")
    figure = Figure()
    plot_spectra(figure, spectra, latest.modes, stage, before=before)
    ends: dict[str, list[float]] = {}
    for line in figure.axes[-1].lines + figure.axes[0].lines:
        x = np.atleast_1d(np.asarray(line.get_xdata(), dtype=float))
        ends.setdefault(str(line.get_label()), []).append(float(x[0]))
    assert ends["declared frequency"] == [126.4, 136.6, 155.0]
    assert sorted(set(ends["mode at the baseline"])) == pytest.approx(before.modes.frequency)
    assert set(ends["expected: ball pass"]) == {128.0, 160.0}
    again = Figure()
    plot_spectra(again, spectra, latest.modes, stage)
    assert len(again.axes[0].collections) < len(figure.axes[0].collections)


def test_the_search_shows_its_poles_and_leaves_out_lines_that_wander(log: Log) -> None:
    """Stable poles stand at the mode; the fit is that of the modes in the band of such a line."""
    reading = read_ambient(log, band=(40.0, 90.0))
    (part,) = reading.sought
    whole = draw(modes_figure(log, reading, band=(40.0, 90.0)))
    marks = {str(line.get_label()): line for line in whole.axes[-1].lines}
    stable: Any = marks["stable pole of the search"].get_xydata()
    assert np.median(stable[:, 0]) == pytest.approx(62.0, abs=1.0)
    line = Harmonic(60.0, 59.0, 61.0, 1.0, 0, np.full(2, 1e3, dtype=complex))
    fitted = []
    for fit in reading.fitted:
        rows = [reading.spectra.channels.index(name) for name in fit.channels]
        added = np.abs(line.expected(fit.spectrum.frequency)[:, rows, 0]) ** 2
        fitted.append(replace(fit, density=fit.density + added / fit.unit**2))
    sought = (replace(part, harmonics=(line,)),)
    other = replace(reading, fitted=tuple(fitted), sought=sought)
    again = draw(modes_figure(log, other, band=(40.0, 90.0)))
    (first,), (second,) = (
        [
            np.asarray(one.get_ydata(), dtype=float)
            for one in figure.axes[0].lines
            if one.get_label() == "fit"
        ]
        for figure in (whole, again)
    )  # fmt: skip
    assert np.isfinite(first).any()
    np.testing.assert_allclose(first, second, rtol=0.05)
    assert any("wanders" in str(patch.get_label()) for patch in again.axes[0].patches)
