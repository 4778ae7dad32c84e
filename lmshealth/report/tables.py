"""Tables of a run and of single logs, with the columns of the public contract (units in names)."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, astuple
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from lmshealth._private.arrays import finite_or_none
from lmshealth._private.tables import TABLES, Row
from lmshealth.io.log import Refusal, covariates
from lmshealth.stage.constants import TYPICAL_DURATION

if TYPE_CHECKING:
    from lmshealth.machine.assessment import Assessment
    from lmshealth.machine.summary import Summary
    from lmshealth.modal.deterministic.frequency_response import FrfReading
    from lmshealth.modal.log_estimates import LogEstimates
    from lmshealth.modal.mode_shapes import ModeShapes
    from lmshealth.modal.modes import Modes
    from lmshealth.signal.readings import FollowingError, Growth, Magnitude
    from lmshealth.signal.spectral_lines import Line
    from lmshealth.stage.check import Diagnostic, ParameterCheck, StageCheck
    from lmshealth.stage.identifiability import Plan
    from lmshealth.tracking.track import Track

_KM, _MILLI, _MICRO, _NANO = 1000.0, 1e-3, 1e-6, 1e-9


def csv_text(table: str, rows: Iterable[Row]) -> str:
    """Write rows of a table of `TABLES` as CSV, NaN as a missing value.

    Further columns follow as they appear.
    """
    rows = list(rows)
    columns = dict.fromkeys(TABLES[table].names)
    for row in rows:
        columns |= dict.fromkeys(row)
    cells = ([row.get(name) for name in columns] for row in rows)
    return _lines([columns, *([cell if cell == cell else None for cell in own] for own in cells)])


def join_csv(parts: Sequence[Any], read: Callable[[Any], str] = str) -> Iterator[str]:
    """Join tables of `csv_text` to one, in pieces; columns of later ones follow as they appear.

    Each part is read twice, so that only one of them needs to be in memory as text.
    """
    columns: dict[str, None] = {}
    for part in parts:
        columns |= dict.fromkeys(next(csv.reader(io.StringIO(read(part), newline=""))))
    yield (header := _lines([columns]))
    for part in parts:
        text = read(part)
        if text.startswith(header):
            yield text[len(header) :]
        else:
            rows = csv.DictReader(io.StringIO(text, newline=""))
            yield _lines([row.get(name) for name in columns] for row in rows)


def _lines(rows: Iterable[Iterable[Any]]) -> str:
    """Write rows as CSV."""
    target = io.StringIO()
    csv.writer(target, lineterminator="\n").writerows(rows)
    return target.getvalue()


def log_tables(reading: LogEstimates) -> dict[str, str]:
    """Return the tables of one log as CSV, by name."""
    modes, table = reading.modes, TABLES["modes_cov"]
    names = list(zip(modes.sources, modes.names, strict=True))
    cov = [
        table.row(reading.log, *names[a], *names[b], float(modes.cov[a, b]))
        for a, b in combinations(range(len(names)), 2)
        if modes.cov[a, b] != 0
    ]
    return {
        "modes": csv_text("modes", modes_rows(reading)),
        "modes_cov": csv_text("modes_cov", cov),
    }


def machine_tables(assessment: Assessment, summary: Summary) -> dict[str, list[Row]]:
    """Return the rows of the tables of one machine without those of its logs, by table."""
    from lmshealth.machine.status import notices  # late: single logs need nothing of lives
    from lmshealth.machine.summary import prognosis_rows

    rows = {} if assessment.track is None else track_tables(assessment.track)
    if assessment.health is not None:
        rows["health"] = to_rows(assessment.health.to_columns())
    if summary.life is not None:
        rows["prognosis"] = prognosis_rows(summary.life, summary.service)
    found = assessment.judgement
    if assessment.stage.parameters:  # else all that is known is in events.csv and warnings.csv
        rows["verdict"] = TABLES["verdict"].rows_of([found])
    rows["refused"] = refused_rows(assessment.refused)
    own, table = (found.stage, found.recorded_at), TABLES["warnings"]
    rows["warnings"] = [table.row(*own, *astuple(one)) for one in notices(assessment)]
    return rows


def modes_rows(reading: LogEstimates) -> list[Row]:
    """Return the estimates of one log, one row per mode, with a column per channel of a shape."""
    metadata, modes, error = reading.metadata, reading.modes, reading.loop_error
    of_log = {
        **{name: metadata.covariates.get(name) for name in covariates()},
        "log": reading.log,
        "travel_km": None if metadata.travel is None else metadata.travel / _KM,
        "delta_e_below_40hz_um": None if error is None else error / _MICRO,
        "sample_rate_hz": reading.sample_rate,
    }
    if metadata.baseline is not None:  # a further column, as some covariates are
        of_log["baseline"] = str(metadata.baseline).lower()
    rows = [TABLES["modes"].read(metadata, **of_log, **own) for own in to_rows(modes.to_columns())]
    further = {key: value for key, value in of_log.items() if key not in TABLES["modes"].names}
    for row, shape in zip(rows, modes.shapes.tolist(), strict=True):
        channels = zip(modes.shape_channels, shape, strict=True)
        row |= further | {f"shape_{channel}": part for channel, part in channels}
    return rows


def factor_rows(log: str, modes: Modes) -> list[Row]:
    """Return the factors on the standard deviation of each mode, one row per mode and cause."""
    table, each = TABLES["std_factors"], zip(modes.names, modes.credibility, strict=True)
    return [table.row(log, name, *one) for name, own in each for one in own.factors]


def shapes_rows(log: str, shapes: ModeShapes) -> tuple[list[Row], list[Row]]:
    """Return complex shapes, one row per mode, and the MAC of each pair of modes.

    Amplitudes and phases in degrees are relative to the largest component; None where the channel
    does not show the mode.
    """
    if not shapes.channels:
        return [], []
    names, mac = shapes.names, TABLES["mac"]
    rows = []
    for name, complexity, own in zip(names, shapes.complexity, shapes.shapes, strict=True):
        row = TABLES["shapes"].row(log, name, finite_or_none(complexity))
        for part, values in (("amplitude", np.abs(own)), ("phase_deg", np.angle(own, deg=True))):
            cells = zip(shapes.channels, values, strict=True)
            row |= {f"{part}_{channel}": finite_or_none(value) for channel, value in cells}
        rows.append(row)
    return rows, [
        mac.row(log, names[i], names[j], finite_or_none(shapes.mac[i, j]))
        for i, j in combinations(range(len(names)), 2)
    ]


def refused_rows(refused: Iterable[Refusal]) -> list[Row]:
    """Return refusals, one row each."""
    return TABLES["refused"].rows_of(refused)


def track_rows(track: Track, smoothed: Track | None = None) -> list[Row]:
    """Return a track, one row per epoch and mode, with columns of smoothed values."""
    from lmshealth.tracking.track import mode_columns  # late, as above

    columns = track.to_columns()
    if smoothed is not None:
        later = mode_columns(smoothed)
        columns |= {f"{name}_smoothed": values for name, values in later.items()}
    return to_rows(columns)


def track_tables(track: Track, smoothed: Track | None = None) -> dict[str, list[Row]]:
    """Return the rows of a track, its covariances, effects other than wear and events, by table."""
    modes, cov = track.modes, TABLES["track_cov"]
    return {
        "track": track_rows(track, smoothed),
        "track_cov": [
            cov.row(track.stage, moment, modes[a], modes[b], own[a, b])
            for moment, own in zip(track.recorded_at, track.drift_cov, strict=True)
            for a, b in combinations(range(len(modes)), 2)
        ],
        "effects": TABLES["effects"].rows_of(track.effects, stage=track.stage),
        "events": events_rows(track),
    }


def to_rows(columns: Row) -> list[Row]:
    """Return rows of columns of one length."""
    values = zip(*(np.asarray(own).tolist() for own in columns.values()), strict=True)
    return [dict(zip(columns, one, strict=True)) for one in values]


def events_rows(track: Track) -> list[Row]:
    """Return the events of a machine, one row per event and mode."""
    table, moments = TABLES["events"], track.recorded_at
    return [
        table.row(
            *(track.stage, moments[one.epoch], track.travel[one.epoch] / _KM),
            *(one.kind, one.mode, one.source, one.size, one.std, one.evidence, one.declared),
            moments[one.found_at],
        )
        for one in track.events
    ]


def error_row(log: str, error: FollowingError) -> Row:
    """Return the analysis of the following error of one log; bandwidth: highest minus lowest."""
    harmonics, above = error.harmonics, error.above
    (low, high), (low_above, high_above) = harmonics.span(error.kept), harmonics.span(above)
    return TABLES["error"].row(
        *(log, error.channel, error.velocity / _MILLI, error.duration),
        *(v / _MICRO for v in (error.lowest, error.highest, error.std, error.mean)),
        *(error.kept.size, high - low, low, high),
        error.max_magnitude / _MICRO,
        float(harmonics.frequency[error.kept[0]]),
        harmonics.share(error.kept),
        error.floor / _NANO,
        *(above.size, high_above - low_above, low_above, high_above),
        harmonics.share(above),
    )


def harmonics_rows(log: str, error: FollowingError) -> list[Row]:
    """Return the kept harmonics of one log, strongest first: A cos(2πft + φ)."""
    found, above, table = error.harmonics, set(error.above.tolist()), TABLES["harmonics"]
    return [
        table.row(
            *(log, error.channel, float(found.frequency[i])),
            *(float(found.amplitude[i]) / _MICRO, float(found.phase[i]), i in above),
        )
        for i in error.kept.tolist()
    ]


def frf_rows(log: str, reading: FrfReading) -> list[Row]:
    """Return a frequency response, one row per line, in SI units of output per input."""
    frf, fit, table = reading.frf, reading.fit, TABLES["frf"]
    f, lines, response = frf.frequency, fit.ordinates.frequency, fit.response
    fitted = np.interp(f, lines, response.real) + 1j * np.interp(f, lines, response.imag)
    columns = [f, np.abs(frf.response), np.angle(frf.response), frf.std, frf.coherence]
    for one in (frf.h1, frf.h2, frf.hv, fitted):
        columns += [np.abs(one), np.angle(one)]
    values = zip(*(column.tolist() for column in columns), strict=True)
    return [table.row(log, *row) for row in values]


def fit_row(log: str, reading: FrfReading) -> Row:
    """Return how a frequency response was measured, and the quality of its modal fit."""
    frf, fit = reading.frf, reading.fit
    return TABLES["fit"].row(
        *(log, frf.input, frf.output, frf.method, frf.note, frf.period, float(frf.n_averages)),
        *(frf.frequency.size, float(frf.frequency[0]), float(frf.frequency[-1])),
        *(float(frf.coherence.mean()), fit.chi_square, fit.distortion, fit.colour),
    )


def magnitudes_rows(
    magnitudes: Iterable[Magnitude], growth: Iterable[Growth], lines: Iterable[tuple[str, Line]]
) -> list[Row]:
    """Return accelerations, one row per log, channel and band, with their growth.

    Column ``line`` is the kind of the spectral line (given with its log) at the strongest harmonic.
    """
    found: dict[tuple[str, str], list[Line]] = {}
    for log, line in lines:
        found.setdefault((log, line.channel), []).append(line)
    grown = {(g.stage, g.channel, g.band): g for g in growth}
    rows, table = [], TABLES["magnitudes"]
    for m in magnitudes:
        own, band = grown[m.stage, m.channel, m.band.name], m.band
        lines_there = found.get((m.log, m.channel), ())
        near = [x.kind for x in lines_there if abs(x.frequency - m.frequency) <= m.resolution]
        row = table.row(
            *(m.log, m.stage or None, m.velocity / _MILLI, m.channel),
            *(band.name, band.kind, band.low, band.high, band.placed_by or None),
            *(m.magnitude / _MILLI, m.frequency, near[0] if near else None),
            *(m.rms / _MILLI, m.dof, own.slope, own.slope_std, own.p_value, own.grows),
        )
        rows.append(row)
    return rows


def growth_rows(growth: Iterable[Growth]) -> list[Row]:
    """Return the growth of accelerations with velocity, one row per machine, channel and band."""
    return [row | {"stage": row["stage"] or None} for row in TABLES["growth"].rows_of(growth)]


def lines_rows(log: str, lines: Iterable[Line]) -> list[Row]:
    """Return the spectral lines of a log, one row each."""
    return [TABLES["lines"].row(log, *astuple(line)) for line in lines]


def plan_rows(plans: Sequence[Plan]) -> dict[str, list[Row]]:
    """Return the questions of plans (``detect``), and their answers per length of log."""
    detect, plan = TABLES["detect"], TABLES["plan"]
    efforts = ((own, effort) for own in plans for effort in own.efforts)
    return {
        "detect": [detect.read(own, seconds_for_one_log=own.duration_of_one) for own in plans],
        "plan": [plan.row(own.parameter, own.loss, *astuple(effort)) for own, effort in efforts],
    }


def stage_rows(examined: StageCheck, found: Sequence[Diagnostic]) -> dict[str, list[Row]]:
    """Return the results of a check of a stage description, by table."""
    names = [check.name for check in examined.parameters]
    return {
        "stage": [TABLES["stage"].read(examined, seconds_per_log=TYPICAL_DURATION)],
        "modes": [
            TABLES["stage_modes"].row(
                *(one.mode.name, one.mode.frequency_hz, *one.searched),
                *(one.mode.tracked, one.informs, one.map_frequency, one.limit_frequency),
                *(one.surrogate_error, one.reached),
            )
            for one in examined.modes
        ],
        "parameters": [_parameter_row(one) for one in examined.parameters],
        "sensitivities": [
            TABLES["sensitivities"].row(
                mode, name, float(examined.slopes[i, j]), float(examined.limit_slopes[i, j])
            )
            for i, mode in enumerate(examined.informative)
            for j, name in enumerate(names)
        ],
        "correlations": [
            TABLES["correlations"].row(names[i], names[j], float(examined.correlation[i, j]))
            for i, j in combinations(range(len(names)), 2)
        ],
        "findings": [asdict(finding) for finding in found],
    }


def _parameter_row(one: ParameterCheck) -> Row:
    limit = one.spec.limit
    limits = (limit.below, one.has_limit_on_map) if limit else (None, None)
    return TABLES["stage_parameters"].row(
        *(one.name, one.spec.baseline, *limits, one.low, one.high),
        *(*one.quantiles, one.below, one.above, one.prior_std, one.usual_std),
        *(one.endless_std, one.exact_map_std, one.known_std, one.change_std),
        *(one.variance_removed(one.usual_std), one.verdict),
    )
