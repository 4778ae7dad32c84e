"""Tables of a run and of single logs, with the columns of the public contract (units in names)."""

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, astuple
from datetime import date, datetime
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

from lmshealth.health.results import Health
from lmshealth.io.log import Refusal
from lmshealth.io.metadata import COVARIATES
from lmshealth.modal.frf.identification import FrfReading
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.mode_shapes import ModeShapes
from lmshealth.modal.modes import Modes
from lmshealth.prognosis.maintenance_decision import ProbabilityBounds, Service
from lmshealth.report.assessment import Assessment, Life, summarise_life
from lmshealth.report.constants import RUL_LEVELS
from lmshealth.report.notices import notices
from lmshealth.signal.acceleration_levels import Growth, Magnitude
from lmshealth.signal.following_error import FollowingError
from lmshealth.signal.spectral_lines import Line
from lmshealth.stage.check import Diagnostic, StageCheck
from lmshealth.stage.constants import TYPICAL_DURATION
from lmshealth.stage.planning import Plan
from lmshealth.tracking.smoother import Smoothed
from lmshealth.tracking.track import Track, mode_columns

_KM, _MILLI, _MICRO, _NANO = 1000.0, 1e-3, 1e-6, 1e-9

# Tables of a run: files without their ending.
COLUMNS = {
    "modes": "log stage recorded_at travel_km temperature_c payload_kg position_mm servo_id "
    "delta_e_below_40hz_um mode source channel frequency_hz frequency_std_hz damping_ratio "
    "damping_ratio_std correlation_f_zeta snr dispersion std_factor excitation_mm_s2 flags "
    "sample_rate_hz",
    "modes_cov": "log source_a mode_a source_b mode_b cov_ln_f",
    "track": "stage recorded_at travel_km mode frequency_hz frequency_std_hz damping_ratio "
    "damping_ratio_std drift drift_std nis nis_dof noise_scale widening",
    "track_cov": "stage recorded_at mode_a mode_b cov_drift",
    "effects": "stage mode covariate coefficient std",
    "events": "stage recorded_at travel_km kind mode source size std evidence declared known_at",
    "health": "stage recorded_at travel_km parameter median q05 q25 q75 q95 ess r_hat converged "
    "identifiable at_edge fit prior_width informed ess_bulk ess_tail laplace_shift "
    "laplace_ratio prior_shift prior_ratio judge_shift judge_ratio",
    "prognosis": "stage parameter limit "
    + " ".join(
        f"rul_{unit}_q{100 * level:02.0f}"
        for unit in ("km", "hours", "days")
        for level in RUL_LEVELS
    )
    + " censored_from probability_beyond_horizon probability_already_past service service_by "
    "service_risk inspect_by inspect_every_km earliest_end rul_km_calibrated calibrated_coverage "
    "calibrated_lives",
    "verdict": "stage recorded_at verdict probability",
    "refused": "log channel mode source reason detail",
    "warnings": "stage recorded_at code severity where what what_to_do",
    "changes": "stage what before now recorded_at",
}

# Tables of single logs, of plans and of stage descriptions.
LOG_COLUMNS = {
    "error": "log channel velocity_mm_s duration_s min_um max_um std_um mean_um n_harmonics "
    "bandwidth_hz lowest_hz highest_hz max_magnitude_um strongest_hz share_explained floor_nm "
    "n_above_floor bandwidth_above_floor_hz lowest_above_floor_hz highest_above_floor_hz "
    "share_explained_above_floor",
    "magnitudes": "log stage velocity_mm_s channel band kind low_hz high_hz placed_by "
    "magnitude_mm_s2 strongest_hz line rms_mm_s2 dof slope slope_std p_value grows",
    "frf": "log frequency_hz gain phase_rad gain_std coherence h1_gain h1_phase_rad h2_gain "
    "h2_phase_rad hv_gain hv_phase_rad fit_gain fit_phase_rad",
    "detect": "parameter loss power false_alarm n_baseline seconds_for_one_log",
    "plan": "parameter loss seconds_per_log n_logs hindrance power_of_one_log "
    "smallest_loss_of_one_log smallest_loss value_std_ln",
    "fit": "log input output method note period_s n_averages n_lines low_hz high_hz mean_coherence "
    "chi_square distortion colour",
    "harmonics": "log channel frequency_hz amplitude_um phase_rad above_floor",
    "growth": "stage channel band n_logs n_velocities slope slope_std p_value grows",
    "lines": "frequency_hz amplitude unit kind channel",
    "mac": "log mode_a mode_b mac",
    "std_factors": "log mode cause std_factor",
    "stage": "name model_std n_logs seconds_per_log",
    "stage_modes": "mode frequency_hz searched_low_hz searched_high_hz tracked informs map_hz "
    "map_at_limits_hz surrogate_error_ln_f logs_reach_ln_f",
    "stage_parameters": "parameter baseline limit limit_on_map map_low map_high prior_q005 "
    "prior_q05 prior_q95 prior_q995 prior_below_map prior_above_map prior_std_ln logs_std_ln "
    "endless_logs_std_ln exact_map_std_ln others_known_std_ln change_std_ln informed verdict",
    "sensitivities": "mode parameter at_baseline at_limits",
    "correlations": "parameter_a parameter_b correlation",
}

Row = dict[str, Any]


def frame(columns: str, rows: Sequence[Row]) -> pd.DataFrame:
    """Make a table of rows with some columns; their further ones follow as they appear."""
    order = dict.fromkeys([*columns.split(), *(name for row in rows for name in row)])
    return pd.DataFrame(list(rows), columns=list(order))


def csv_text(table: str, rows: Iterable[Row]) -> str:
    """Write rows of a table (key of `COLUMNS`) as CSV, NaN as a missing value."""
    rows = list(rows)
    columns = dict.fromkeys(COLUMNS[table].split())
    for row in rows:
        columns |= dict.fromkeys(row)
    target = io.StringIO()
    writer = csv.writer(target, lineterminator="\n")
    writer.writerow(columns)
    cells = ([row.get(name) for name in columns] for row in rows)
    writer.writerows([cell if cell == cell else None for cell in own] for own in cells)
    return target.getvalue()


def join_csv(parts: Sequence[Any], read: Callable[[Any], str] = str) -> Iterator[str]:
    """Join tables of `csv_text` to one, in pieces; columns of later ones follow as they appear.

    Each part is read twice, so that only one of them needs to be in memory as text.
    """
    columns: dict[str, None] = {}
    for part in parts:
        columns |= dict.fromkeys(_header(read(part)))
    header = _line(columns)
    yield header
    for part in parts:
        text = read(part)
        if text.startswith(header):
            yield text[len(header) :]
        else:
            target = io.StringIO()
            writer = csv.DictWriter(target, columns, lineterminator="\n")
            writer.writerows(csv.DictReader(io.StringIO(text, newline="")))
            yield target.getvalue()


def _header(text: str) -> list[str]:
    return next(csv.reader(io.StringIO(text, newline="")))


def _line(cells: Iterable[str]) -> str:
    target = io.StringIO()
    csv.writer(target, lineterminator="\n").writerow(cells)
    return target.getvalue()


def log_tables(reading: LogEstimates) -> dict[str, str]:
    """Return the tables of one log as CSV, by name."""
    rows = {"modes": modes_rows(reading), "modes_cov": _modes_cov_rows(reading)}
    return {name: csv_text(name, own) for name, own in rows.items()}


def machine_tables(assessment: Assessment) -> dict[str, list[Row]]:
    """Return the rows of the tables of one machine without those of its logs, by table."""
    rows: dict[str, list[Row]] = {}
    if assessment.track is not None:
        rows["track"] = track_rows(assessment.track)
        rows["track_cov"] = track_cov_rows(assessment.track)
        rows["effects"] = effects_rows(assessment.track)
        rows["events"] = events_rows(assessment.track)
    if assessment.health is not None:
        rows["health"] = health_rows(assessment.health)
    if assessment.prognosis is not None:
        life = summarise_life(assessment.prognosis, assessment.stage, assessment.calibration)
        rows["prognosis"] = prognosis_rows(life, assessment.service())
    found = assessment.judgement
    own = found.stage, _iso(found.recorded_at)
    if assessment.stage.parameters:  # else all that is known is in events.csv and warnings.csv
        rows["verdict"] = _rows("verdict", [(*own, found.verdict, found.probability)])
    rows["refused"] = refused_rows(assessment.refused)
    rows["warnings"] = _rows("warnings", [(*own, *astuple(one)) for one in notices(assessment)])
    return rows


def _rows(table: str, values: Iterable[Sequence[Any]]) -> list[Row]:
    """Return rows of a table; values in the order of its columns."""
    names = (COLUMNS.get(table) or LOG_COLUMNS[table]).split()
    return [dict(zip(names, one, strict=True)) for one in values]


def _iso(moment: datetime | None) -> str | None:
    return None if moment is None else moment.isoformat()


def modes_rows(reading: LogEstimates) -> list[Row]:
    """Return the estimates of one log, one row per mode, with a column per channel of a shape."""
    metadata, modes, error = reading.metadata, reading.modes, reading.loop_error
    log = (
        reading.log,
        metadata.stage,
        _iso(metadata.recorded_at),
        None if metadata.travel is None else metadata.travel / _KM,
        *(metadata.covariates.get(name) for name in COVARIATES),
        metadata.servo_id,
        None if error is None else error / _MICRO,
    )
    columns = [np.asarray(one).tolist() for one in modes.to_columns().values()]
    rows = _rows("modes", [(*log, *one, reading.sample_rate) for one in zip(*columns, strict=True)])
    for row, shape in zip(rows, modes.shapes.tolist(), strict=True):
        channels = zip(modes.shape_channels, shape, strict=True)
        row |= {f"shape_{channel}": part for channel, part in channels}
    return rows


def factor_rows(log: str, modes: Modes) -> list[Row]:
    """Return the factors on the standard deviation of each mode, one row per mode and cause."""
    each = zip(modes.names, modes.credibility, strict=True)
    return _rows("std_factors", [(log, name, *one) for name, own in each for one in own.factors])


def shapes_rows(log: str, shapes: ModeShapes) -> tuple[list[Row], list[Row]]:
    """Return complex shapes, one row per mode, and the MAC of each pair of modes.

    Amplitudes and phases in degrees are relative to the largest component; None where the channel
    does not show the mode.
    """
    rows = []
    if not shapes.channels:
        return [], []
    amplitude, phase = np.abs(shapes.shapes), np.angle(shapes.shapes, deg=True)
    for i, complexity in enumerate(shapes.complexity):
        row: Row = {"log": log, "mode": shapes.names[i], "mpc": _or_none(complexity)}
        for part, values in (("amplitude", amplitude[i]), ("phase_deg", phase[i])):
            pairs = zip(shapes.channels, values, strict=True)
            row |= {f"{part}_{channel}": _or_none(value) for channel, value in pairs}
        rows.append(row)
    pairs_ = combinations(range(len(shapes.names)), 2)
    mac = [(log, shapes.names[i], shapes.names[j], _or_none(shapes.mac[i, j])) for i, j in pairs_]
    return rows, _rows("mac", mac)


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _modes_cov_rows(reading: LogEstimates) -> list[Row]:
    modes = reading.modes
    names = list(zip(modes.sources, modes.names, strict=True))
    values = [
        (reading.log, *names[a], *names[b], float(modes.cov[a, b]))
        for a, b in combinations(range(len(names)), 2)
        if modes.cov[a, b] != 0
    ]
    return _rows("modes_cov", values)


def refused_rows(refused: Iterable[Refusal]) -> list[Row]:
    """Return refusals, one row each."""
    names = COLUMNS["refused"].split()
    return [{name: getattr(refusal, name) for name in names} for refusal in refused]


def track_rows(
    track: Track, smoothed: Smoothed | None = None, *, epochs: Iterable[int] | None = None
) -> list[Row]:
    """Return a track, one row per epoch (of `epochs`) and mode, with columns of smoothed values."""
    columns, m = track.to_columns(), len(track.modes)
    if smoothed is not None:
        later = mode_columns(smoothed)
        columns |= {f"{name}_smoothed": values for name, values in later.items()}
    return [
        {name: values[m * k + i] for name, values in columns.items()}
        for k in (range(len(track.logs)) if epochs is None else epochs)
        for i in range(m)
    ]


def track_cov_rows(track: Track) -> list[Row]:
    """Return the covariances of the drifts of one epoch, one row per pair of modes."""
    values = [
        (track.stage, _iso(moment), track.modes[a], track.modes[b], cov[a, b])
        for moment, cov in zip(track.recorded_at, track.drift_cov, strict=True)
        for a, b in combinations(range(len(track.modes)), 2)
    ]
    return _rows("track_cov", values)


def effects_rows(track: Track) -> list[Row]:
    """Return effects other than wear, one row per mode and cause."""
    effects = [(track.stage, e.mode, e.covariate, e.coefficient, e.std) for e in track.effects]
    return _rows("effects", effects)


def events_rows(track: Track) -> list[Row]:
    """Return the events of a machine, one row per event and mode."""
    values = [
        (
            *(track.stage, _iso(track.recorded_at[one.epoch]), track.travel[one.epoch] / _KM),
            *(one.kind, one.mode, one.source, one.size, one.std, one.evidence, one.declared),
            _iso(track.recorded_at[one.found_at]),
        )
        for one in track.events
    ]
    return _rows("events", values)


def health_rows(health: Health) -> list[Row]:
    """Return a posterior of the health parameters, one row per epoch and parameter."""
    rows = pd.DataFrame(health.to_columns()).to_dict("records")
    return [{str(name): value for name, value in row.items()} for row in rows]


def prognosis_rows(
    life: Life, service: Service, before: tuple[date, ProbabilityBounds] | None = None
) -> list[Row]:
    """Return a remaining life, one row per limit and one for any, which has the service.

    ``before`` is a day with the probabilities that a limit is reached before it: extra columns.
    """
    fleet = life.calibration
    of_any = (
        *(service.kind, service.by, service.risk, service.inspect_by),
        *(_or_none(service.inspect_every / _KM), service.earliest_end),
        *((_or_none(fleet.travel / _KM), fleet.coverage, fleet.n_lives) if fleet else [None] * 3),
    )
    rows = []
    for j, one in enumerate(life.limits):
        days = np.array(one.days)
        quantiles = np.concatenate([np.array(one.travel) / _KM, 24 * days, days]).tolist()
        pairs = zip(RUL_LEVELS, one.days, strict=True)
        values = (
            *(life.stage, one.parameter, one.limit),
            *(None if np.isinf(value) else value for value in quantiles),
            next((level for level, wait in pairs if np.isinf(wait)), None),
            *(one.beyond_horizon, one.already_past),
            *(of_any if one.parameter == "any" else [None] * len(of_any)),
        )
        (row,) = _rows("prognosis", [values])
        if before is not None:
            day, reached = before
            at_least, at_most = reached.at_least[j], reached.at_most[j]
            row |= {"before": day, "probability_at_least": at_least, "probability_at_most": at_most}
        rows.append(row)
    return rows


def error_row(log: str, error: FollowingError) -> Row:
    """Return the analysis of the following error of one log; bandwidth: highest minus lowest."""
    harmonics, above = error.harmonics, error.above
    (low, high), (low_above, high_above) = harmonics.span(error.kept), harmonics.span(above)
    values = (
        log,
        error.channel,
        error.velocity / _MILLI,
        error.duration,
        *(v / _MICRO for v in (error.lowest, error.highest, error.std, error.mean)),
        *(error.kept.size, high - low, low, high),
        error.max_magnitude / _MICRO,
        float(harmonics.frequency[error.kept[0]]),
        harmonics.share(error.kept),
        error.floor / _NANO,
        *(above.size, high_above - low_above, low_above, high_above),
        harmonics.share(above),
    )
    return _rows("error", [values])[0]


def harmonics_rows(log: str, error: FollowingError) -> list[Row]:
    """Return the kept harmonics of one log, strongest first: A cos(2πft + φ)."""
    found, above = error.harmonics, set(error.above.tolist())
    values = [
        (
            *(log, error.channel, float(found.frequency[i])),
            *(float(found.amplitude[i]) / _MICRO, float(found.phase[i]), i in above),
        )
        for i in error.kept.tolist()
    ]
    return _rows("harmonics", values)


def frf_rows(log: str, reading: FrfReading) -> list[Row]:
    """Return a frequency response, one row per line, in SI units of output per input."""
    frf, fit = reading.frf, reading.fit
    f, lines, response = frf.frequency, fit.ordinates.frequency, fit.response
    fitted = np.interp(f, lines, response.real) + 1j * np.interp(f, lines, response.imag)
    columns = [f, np.abs(frf.response), np.angle(frf.response), frf.std, frf.coherence]
    for one in (frf.h1, frf.h2, frf.hv, fitted):
        columns += [np.abs(one), np.angle(one)]
    values = zip(*(column.tolist() for column in columns), strict=True)
    return _rows("frf", [(log, *row) for row in values])


def fit_row(log: str, reading: FrfReading) -> Row:
    """Return how a frequency response was measured, and the quality of its modal fit."""
    frf, fit = reading.frf, reading.fit
    values = (
        *(log, frf.input, frf.output, frf.method, frf.note, frf.period, float(frf.n_averages)),
        *(frf.frequency.size, float(frf.frequency[0]), float(frf.frequency[-1])),
        *(float(frf.coherence.mean()), fit.chi_square, fit.distortion, fit.colour),
    )
    return _rows("fit", [values])[0]


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
    values = []
    for m in magnitudes:
        own = grown[m.stage, m.channel, m.band.name]
        lines_there = found.get((m.log, m.channel), ())
        near = [x.kind for x in lines_there if abs(x.frequency - m.frequency) <= m.resolution]
        values.append(
            (
                *(m.log, m.stage or None, m.velocity / _MILLI, m.channel),
                *(m.band.name, m.band.kind, m.band.low, m.band.high, m.band.placed_by or None),
                *(m.magnitude / _MILLI, m.frequency, near[0] if near else None),
                *(m.rms / _MILLI, m.dof, own.slope, own.slope_std, own.p_value, own.grows),
            )
        )
    return _rows("magnitudes", values)


def growth_rows(growth: Iterable[Growth]) -> list[Row]:
    """Return the growth of accelerations with velocity, one row per machine, channel and band."""
    names = LOG_COLUMNS["growth"].split()
    return [{n: getattr(g, n) for n in names} | {"stage": g.stage or None} for g in growth]


def lines_rows(lines: Iterable[Line]) -> list[Row]:
    """Return spectral lines, one row each."""
    return _rows("lines", map(astuple, lines))


def plan_rows(plans: Sequence[Plan]) -> dict[str, list[Row]]:
    """Return the questions of plans (``detect``), and their answers per length of log."""
    asked = ["parameter", "loss", "power", "false_alarm", "n_baseline", "duration_of_one"]
    questions = [[getattr(plan, name) for name in asked] for plan in plans]
    efforts = [(p.parameter, p.loss, *astuple(effort)) for p in plans for effort in p.efforts]
    return {"detect": _rows("detect", questions), "plan": _rows("plan", efforts)}


def stage_rows(examined: StageCheck, found: Sequence[Diagnostic]) -> dict[str, list[Row]]:
    """Return the results of a check of a stage description, by table."""
    names = [check.name for check in examined.parameters]
    stage = examined.name, examined.model_std, examined.n_logs, TYPICAL_DURATION
    modes = [
        (
            *(one.mode.name, one.mode.frequency_hz, *one.searched, one.mode.tracked, one.informs),
            *(one.map_frequency, one.limit_frequency, one.surrogate_error, one.reached),
        )
        for one in examined.modes
    ]
    parameters = []
    for one in examined.parameters:
        limit = one.spec.limit
        limits = (limit.below, one.has_limit_on_map) if limit else (None, None)
        values = (
            *(one.name, one.spec.baseline, *limits, one.low, one.high),
            *(*one.quantiles, one.below, one.above, one.prior_std, one.usual_std),
            *(one.endless_std, one.exact_map_std, one.known_std, one.change_std),
            *(one.variance_removed(one.usual_std), one.verdict),
        )
        parameters.append(values)
    sensitivities = [
        (mode, name, float(examined.slopes[i, j]), float(examined.limit_slopes[i, j]))
        for i, mode in enumerate(examined.informative)
        for j, name in enumerate(names)
    ]
    correlations = [
        (names[i], names[j], float(examined.correlation[i, j]))
        for i, j in combinations(range(len(names)), 2)
    ]
    return {
        "stage": _rows("stage", [stage]),
        "modes": _rows("stage_modes", modes),
        "parameters": _rows("stage_parameters", parameters),
        "sensitivities": _rows("sensitivities", sensitivities),
        "correlations": _rows("correlations", correlations),
        "findings": [asdict(finding) for finding in found],
    }
