"""Tables of a run, with the columns of the public contract: units stand in the names again.

Tables of what single logs show, as the commands print them; `run` writes no such files.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, astuple
from datetime import date, datetime
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

from lmshealth._arrays import FloatArray
from lmshealth.health.results import Health
from lmshealth.io.log import Refusal
from lmshealth.io.metadata import COVARIATES
from lmshealth.modal.frf.identification import FrfReading
from lmshealth.prognosis.maintenance_decision import ProbabilityBounds, Service
from lmshealth.report.assessment import Assessment, Life, LimitLife, summarise_life
from lmshealth.report.constants import RUL_LEVELS
from lmshealth.signal.acceleration_levels import Growth, Magnitude
from lmshealth.signal.following_error import FollowingError
from lmshealth.signal.spectral_lines import Line
from lmshealth.stage.check import (
    Diagnostic,
    ModeCheck,
    ParameterCheck,
    StageCheck,
)
from lmshealth.stage.constants import TYPICAL_DURATION
from lmshealth.stage.planning import Plan
from lmshealth.tracking.history import LogEstimates
from lmshealth.tracking.smoother import Smoothed
from lmshealth.tracking.track import Track

_KM, _MICRO = 1000.0, 1e-6

COLUMNS = {
    "modes": "log stage recorded_at travel_km temperature_c payload_kg position_mm servo_id "
    "delta_e_below_40hz_um mode source channel frequency_hz frequency_std_hz damping_ratio "
    "damping_ratio_std correlation_f_zeta snr dispersion flags",
    "modes_cov": "log source_a mode_a source_b mode_b cov_ln_f",
    "track": "stage recorded_at travel_km mode frequency_hz frequency_std_hz damping_ratio "
    "damping_ratio_std drift drift_std nis nis_dof noise_scale widening",
    "track_cov": "stage recorded_at mode_a mode_b cov_drift",
    "effects": "stage mode covariate coefficient std",
    "events": "stage recorded_at travel_km kind mode source size std evidence declared known_at",
    "health": "stage recorded_at travel_km parameter median q05 q25 q75 q95 ess r_hat converged "
    "identifiable at_edge fit prior_width informed ess_bulk ess_tail laplace_shift "
    "laplace_ratio prior_shift prior_ratio",
    "prognosis": "stage parameter limit "
    + " ".join(
        f"rul_{unit}_q{100 * level:02.0f}"
        for unit in ("km", "hours", "days")
        for level in RUL_LEVELS
    )
    + " censored_from probability_beyond_horizon probability_already_past service service_by "
    "service_risk",
    "verdict": "stage recorded_at verdict probability",
    "refused": "log channel mode source reason detail",
}

Row = dict[str, Any]


def modes_rows(reading: LogEstimates) -> list[Row]:
    """List the estimates of one log, one row per mode, with a column per channel of a shape."""
    metadata, modes, error = reading.metadata, reading.modes, reading.loop_error
    circumstances = {
        "log": reading.log,
        "stage": metadata.stage,
        "recorded_at": _moment(metadata.recorded_at),
        "travel_km": None if metadata.travel is None else metadata.travel / _KM,
        **{name: metadata.covariates.get(name) for name in COVARIATES},
        "servo_id": metadata.servo_id,
        "delta_e_below_40hz_um": None if error is None else error / _MICRO,
    }
    return [
        {
            **circumstances,
            "mode": modes.names[i],
            "source": modes.sources[i],
            "channel": modes.channels[i],
            "frequency_hz": float(modes.frequency[i]),
            "frequency_std_hz": float(modes.frequency_std[i]),
            "damping_ratio": float(modes.damping_ratio[i]),
            "damping_ratio_std": float(modes.damping_ratio_std[i]),
            "correlation_f_zeta": float(modes.correlation[i]),
            "snr": float(modes.snr[i]),
            "dispersion": float(modes.dispersion[i]),
            "flags": modes.flags[i],
            **{
                f"shape_{channel}": float(own)
                for channel, own in zip(modes.shape_channels, modes.shapes[i], strict=True)
            },
        }
        for i in range(len(modes.names))
    ]


def refused_rows(refused: Iterable[Refusal]) -> list[Row]:
    """List what was not analysed, one row each."""
    return [
        {name: getattr(refusal, name) for name in COLUMNS["refused"].split()} for refusal in refused
    ]


def frame(columns: str, rows: Sequence[Row]) -> pd.DataFrame:
    """Make a table of rows.

    Parameters
    ----------
    columns : str
        Those that every table of its kind has, separated by blanks.
    rows : sequence of dict
        What else they hold is appended, in the order in which it comes.
    """
    order = dict.fromkeys([*columns.split(), *(name for row in rows for name in row)])
    return pd.DataFrame(list(rows), columns=list(order))


def machine_tables(
    readings: Sequence[LogEstimates], assessment: Assessment
) -> dict[str, list[Row]]:
    """List everything about one machine, by the name of the table, which is a file without ending.

    Parameters
    ----------
    readings : sequence of LogEstimates
        Its logs.
    assessment : Assessment
        What they say together.
    """
    rows: dict[str, list[Row]] = {name: [] for name in COLUMNS}
    for reading in readings:
        rows["modes"] += modes_rows(reading)
        rows["modes_cov"] += _modes_cov_rows(reading)
    if assessment.track is not None:
        rows["track"] = track_rows(assessment.track)
        rows["track_cov"] = track_cov_rows(assessment.track)
        rows["effects"] = effects_rows(assessment.track)
        rows["events"] = events_rows(assessment.track)
    if assessment.health is not None:
        rows["health"] = health_rows(assessment.health)
    if assessment.prognosis is not None:
        life = summarise_life(assessment.prognosis, assessment.stage)
        rows["prognosis"] = prognosis_rows(life, assessment.service())
    judgement = assessment.judgement
    verdict = judgement.verdict, judgement.probability
    values = judgement.stage, _moment(judgement.recorded_at), *verdict
    rows["verdict"] = [dict(zip(COLUMNS["verdict"].split(), values, strict=True))]
    rows["refused"] = refused_rows(assessment.refused)
    return rows


def _moment(moment: datetime | None) -> str | None:
    return None if moment is None else moment.isoformat()


def _modes_cov_rows(reading: LogEstimates) -> list[Row]:
    modes = reading.modes
    return [
        {
            "log": reading.log,
            "source_a": modes.sources[a],
            "mode_a": modes.names[a],
            "source_b": modes.sources[b],
            "mode_b": modes.names[b],
            "cov_ln_f": float(modes.cov[a, b]),
        }
        for a, b in combinations(range(len(modes.names)), 2)
        if modes.cov[a, b] != 0
    ]


def track_rows(
    track: Track, smoothed: Smoothed | None = None, *, epochs: Iterable[int] | None = None
) -> list[Row]:
    """Return a track, one row per epoch and mode; smoothed values have columns of their own.

    With `epochs` only these.
    """
    drift_std = np.sqrt(np.einsum("kii->ki", track.drift_cov))
    frequency, damping = np.exp(track.ln_frequency), np.exp(track.ln_damping)
    return [
        {
            "stage": track.stage,
            "recorded_at": _moment(track.recorded_at[k]),
            "travel_km": track.travel[k] / _KM,
            "mode": mode,
            "frequency_hz": frequency[k, i],
            "frequency_std_hz": frequency[k, i] * track.ln_frequency_std[k, i],
            "damping_ratio": damping[k, i],
            "damping_ratio_std": damping[k, i] * track.ln_damping_std[k, i],
            "drift": track.drift[k, i],
            "drift_std": drift_std[k, i],
            "nis": track.nis[k],
            "nis_dof": track.nis_dof[k],
            "noise_scale": track.noise_scale[k].max(),
            "widening": track.widening[k],
            **({} if smoothed is None else _smoothed_columns(smoothed, k, i)),
        }
        for k in (range(len(track.logs)) if epochs is None else epochs)
        for i, mode in enumerate(track.modes)
    ]


def track_cov_rows(track: Track) -> list[Row]:
    """List the covariances between drifts of one epoch, one row per pair of modes."""
    return [
        {
            "stage": track.stage,
            "recorded_at": _moment(track.recorded_at[k]),
            "mode_a": track.modes[a],
            "mode_b": track.modes[b],
            "cov_drift": track.drift_cov[k, a, b],
        }
        for k in range(len(track.logs))
        for a, b in combinations(range(len(track.modes)), 2)
    ]


def effects_rows(track: Track) -> list[Row]:
    """List what moves modes without wear, one row per mode and cause."""
    return [
        {
            "stage": track.stage,
            "mode": effect.mode,
            "covariate": effect.covariate,
            "coefficient": effect.coefficient,
            "std": effect.std,
        }
        for effect in track.effects
    ]


def events_rows(track: Track) -> list[Row]:
    """List what happened to a machine, one row per event and mode."""
    return [
        {
            "stage": track.stage,
            "recorded_at": _moment(track.recorded_at[event.epoch]),
            "travel_km": track.travel[event.epoch] / _KM,
            "kind": event.kind,
            "mode": event.mode,
            "source": event.source,
            "size": event.size,
            "std": event.std,
            "evidence": event.evidence,
            "declared": event.declared,
            "known_at": _moment(track.recorded_at[event.found_at]),
        }
        for event in track.events
    ]


def health_rows(health: Health) -> list[Row]:
    """List a posterior of health, one row per epoch and parameter."""
    return [
        {str(name): value for name, value in row.items()}
        for row in health.to_frame().to_dict("records")
    ]


def _smoothed_columns(smoothed: Smoothed, k: int, i: int) -> Row:
    frequency, damping = np.exp(smoothed.ln_frequency[k, i]), np.exp(smoothed.ln_damping[k, i])
    return {
        "frequency_hz_smoothed": frequency,
        "frequency_std_hz_smoothed": frequency * smoothed.ln_frequency_std[k, i],
        "damping_ratio_smoothed": damping,
        "damping_ratio_std_smoothed": damping * smoothed.ln_damping_std[k, i],
        "drift_smoothed": smoothed.drift[k, i],
        "drift_std_smoothed": smoothed.drift_std[k, i],
    }


def prognosis_rows(
    life: Life, service: Service, before: tuple[date, ProbabilityBounds] | None = None
) -> list[Row]:
    """Return a remaining life, one row per limit and one for any of them.

    Parameters
    ----------
    life : Life
        Its quantiles and probabilities.
    service : Service
        When to service; in the row of any limit.
    before : tuple of date and ProbabilityBounds, optional
        A day, and the probabilities that a limit is reached before it: in extra columns.
    """
    rows = []
    for j, one in enumerate(life.limits):
        last = one.parameter == "any"
        row = {
            "stage": life.stage,
            "parameter": one.parameter,
            "limit": one.limit,
            **_rul_columns(one),
            "probability_beyond_horizon": one.beyond_horizon,
            "probability_already_past": one.already_past,
            "service": service.kind if last else None,
            "service_by": service.by if last else None,
            "service_risk": service.risk if last else None,
        }
        if before is not None:
            day, reached = before
            row |= {
                "before": day,
                "probability_at_least": reached.at_least[j],
                "probability_at_most": reached.at_most[j],
            }
        rows.append(row)
    return rows


def _rul_columns(one: LimitLife) -> Row:
    """Return the quantiles of a remaining life; empty beyond the horizon."""
    hours = [24 * days for days in one.days]
    row: Row = {}
    for unit, values in (
        ("km", [metres / _KM for metres in one.travel]),
        ("hours", hours),
        ("days", one.days),
    ):
        for level, value in zip(RUL_LEVELS, values, strict=True):
            row[f"rul_{unit}_q{100 * level:02.0f}"] = None if np.isinf(value) else value
    censored = [level for level, days in zip(RUL_LEVELS, one.days, strict=True) if np.isinf(days)]
    row["censored_from"] = censored[0] if censored else None
    return row


_MICRO, _MILLI, _NANO = 1e-6, 1e-3, 1e-9

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
    "smallest_loss_of_one_log smallest_loss",
    "fit": "log input output period_s n_averages n_lines low_hz high_hz mean_coherence "
    "chi_square distortion colour",
}


def error_row(log: str, error: FollowingError) -> Row:
    """Give the reading of the following error of one log; a bandwidth is highest minus lowest."""
    (low, high), (low_above, high_above) = error.band, error.band_above
    return {
        "log": log,
        "channel": error.channel,
        "velocity_mm_s": error.velocity / _MILLI,
        "duration_s": error.duration,
        "min_um": error.lowest / _MICRO,
        "max_um": error.highest / _MICRO,
        "std_um": error.std / _MICRO,
        "mean_um": error.mean / _MICRO,
        "n_harmonics": error.kept.size,
        "bandwidth_hz": high - low,
        "lowest_hz": low,
        "highest_hz": high,
        "max_magnitude_um": error.max_magnitude / _MICRO,
        "strongest_hz": float(error.harmonics.frequency[error.kept[0]]),
        "share_explained": error.share_explained,
        "floor_nm": error.floor / _NANO,
        "n_above_floor": error.above.size,
        "bandwidth_above_floor_hz": high_above - low_above,
        "lowest_above_floor_hz": low_above,
        "highest_above_floor_hz": high_above,
        "share_explained_above_floor": error.share_explained_above,
    }


def harmonics_rows(log: str, error: FollowingError) -> list[Row]:
    """List the kept harmonics of one log, strongest first: A cos(2πft + φ)."""
    harmonics, above = error.harmonics, set(error.above.tolist())
    return [
        {
            "log": log,
            "channel": error.channel,
            "frequency_hz": float(harmonics.frequency[i]),
            "amplitude_um": float(harmonics.amplitude[i]) / _MICRO,
            "phase_rad": float(harmonics.phase[i]),
            "above_floor": i in above,
        }
        for i in error.kept.tolist()
    ]


def frf_rows(log: str, reading: FrfReading) -> list[Row]:
    """List a frequency response, one row per line, in SI units of the output per the input's."""
    frf, fit = reading.frf, reading.fit
    lines = fit.ordinates.frequency
    fitted = np.interp(frf.frequency, lines, fit.response.real) + 1j * np.interp(
        frf.frequency, lines, fit.response.imag
    )
    columns: dict[str, FloatArray] = {"frequency_hz": frf.frequency}
    for name, response in (
        ("", frf.response),
        ("h1_", frf.h1),
        ("h2_", frf.h2),
        ("hv_", frf.hv),
        ("fit_", fitted),
    ):
        columns |= {f"{name}gain": np.abs(response), f"{name}phase_rad": np.angle(response)}
    columns |= {"gain_std": frf.std, "coherence": frf.coherence}
    names = LOG_COLUMNS["frf"].split()[1:]
    rows = zip(*(columns[name].tolist() for name in names), strict=True)
    return [{"log": log, **dict(zip(names, row, strict=True))} for row in rows]


def fit_row(log: str, reading: FrfReading) -> Row:
    """Give how a frequency response was measured and how well its modes describe it."""
    frf, fit = reading.frf, reading.fit
    return {
        "log": log,
        "input": frf.input,
        "output": frf.output,
        "period_s": frf.period,
        "n_averages": float(frf.n_averages),
        "n_lines": frf.frequency.size,
        "low_hz": float(frf.frequency[0]),
        "high_hz": float(frf.frequency[-1]),
        "mean_coherence": float(frf.coherence.mean()),
        "chi_square": fit.chi_square,
        "distortion": fit.distortion,
        "colour": fit.colour,
    }


def magnitudes_rows(
    magnitudes: Iterable[Magnitude], growth: Iterable[Growth], lines: Iterable[tuple[str, Line]]
) -> list[Row]:
    """List what accelerometers read, one row per log, channel and band, with its growth.

    ``line`` is the kind of the line (given with its log) that the strongest harmonic belongs to.
    """
    seen: dict[tuple[str, str], list[Line]] = {}
    for log, line in lines:
        seen.setdefault((log, line.channel), []).append(line)
    grown = {(g.stage, g.channel, g.band): g for g in growth}
    rows = []
    for m in magnitudes:
        own = grown[m.stage, m.channel, m.band.name]
        near = [
            line.kind
            for line in seen.get((m.log, m.channel), ())
            if abs(line.frequency - m.frequency) <= m.resolution
        ]
        rows.append(
            {
                "log": m.log,
                "stage": m.stage or None,
                "velocity_mm_s": m.velocity / _MILLI,
                "channel": m.channel,
                "band": m.band.name,
                "kind": m.band.kind,
                "low_hz": m.band.low,
                "high_hz": m.band.high,
                "placed_by": m.band.placed_by or None,
                "magnitude_mm_s2": m.magnitude / _MILLI,
                "strongest_hz": m.frequency,
                "line": near[0] if near else None,
                "rms_mm_s2": m.rms / _MILLI,
                "dof": m.dof,
                "slope": own.slope,
                "slope_std": own.slope_std,
                "p_value": own.p_value,
                "grows": own.grows,
            }
        )
    return rows


def growth_rows(growth: Iterable[Growth]) -> list[Row]:
    """List how magnitudes depend on velocity, one row per machine, channel and band."""
    return [
        {
            "stage": g.stage or None,
            "channel": g.channel,
            "band": g.band,
            "n_logs": g.n_logs,
            "n_velocities": g.n_velocities,
            "slope": g.slope,
            "slope_std": g.slope_std,
            "p_value": g.p_value,
            "grows": g.grows,
        }
        for g in growth
    ]


def plan_rows(plans: Sequence[Plan]) -> dict[str, list[Row]]:
    """List what plans were asked for, and what logs can do, one row per length of log."""
    asked = [
        (p.parameter, p.loss, p.power, p.false_alarm, p.n_baseline, p.duration_of_one)
        for p in plans
    ]
    efforts = [(p.parameter, p.loss, *astuple(effort)) for p in plans for effort in p.efforts]
    return {
        name: [dict(zip(LOG_COLUMNS[name].split(), row, strict=True)) for row in rows]
        for name, rows in (("detect", asked), ("plan", efforts))
    }


def stage_rows(examined: StageCheck, found: Sequence[Diagnostic]) -> dict[str, list[Row]]:
    """List what an examination of a stage description measured, and what it comes to."""
    names = [check.name for check in examined.parameters]
    return {
        "stage": [
            {
                "name": examined.name,
                "model_std": examined.model_std,
                "n_logs": examined.n_logs,
                "seconds_per_log": TYPICAL_DURATION,
            }
        ],
        "modes": [_mode_row(check) for check in examined.modes],
        "parameters": [_parameter_row(check) for check in examined.parameters],
        "sensitivities": [
            {
                "mode": mode,
                "parameter": name,
                "at_baseline": float(examined.slopes[i, j]),
                "at_limits": float(examined.limit_slopes[i, j]),
            }
            for i, mode in enumerate(examined.informative)
            for j, name in enumerate(names)
        ],
        "correlations": [
            {"parameter_a": names[i], "parameter_b": names[j], "correlation": float(value)}
            for i, j in combinations(range(len(names)), 2)
            for value in [examined.correlation[i, j]]
        ],
        "findings": [asdict(finding) for finding in found],
    }


def _mode_row(check: ModeCheck) -> Row:
    low, high = check.searched
    return {
        "mode": check.mode.name,
        "frequency_hz": check.mode.frequency_hz,
        "searched_low_hz": low,
        "searched_high_hz": high,
        "tracked": check.mode.tracked,
        "informs": check.informs,
        "map_hz": check.map_frequency,
        "map_at_limits_hz": check.limit_frequency,
        "surrogate_error_ln_f": check.surrogate_error,
        "logs_reach_ln_f": check.reached,
    }


def _parameter_row(check: ParameterCheck) -> Row:
    spec = check.spec
    levels = ("q005", "q05", "q95", "q995")
    return {
        "parameter": spec.name,
        "baseline": spec.baseline,
        "limit": spec.limit.below if spec.limit else None,
        "limit_on_map": check.has_limit_on_map if spec.limit else None,
        "map_low": check.low,
        "map_high": check.high,
        **{f"prior_{key}": value for key, value in zip(levels, check.quantiles, strict=True)},
        "prior_below_map": check.below,
        "prior_above_map": check.above,
        "prior_std_ln": check.prior_std,
        "logs_std_ln": check.usual_std,
        "endless_logs_std_ln": check.endless_std,
        "exact_map_std_ln": check.exact_map_std,
        "others_known_std_ln": check.known_std,
        "informed": check.informed(check.usual_std),
        "verdict": check.verdict,
    }


def lines_rows(lines: Iterable[Line]) -> list[Row]:
    """List spectral lines that are no modes, one row each."""
    return [
        {
            "frequency_hz": line.frequency,
            "amplitude": line.amplitude,
            "unit": line.unit,
            "kind": line.kind,
            "channel": line.channel,
        }
        for line in lines
    ]
