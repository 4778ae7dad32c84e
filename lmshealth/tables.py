"""Results as tables with the columns of the public contract: units stand in the names again."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import astuple
from datetime import datetime
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

from lmshealth.arrays import FloatArray
from lmshealth.following import FollowingError
from lmshealth.frf import FrfReading
from lmshealth.history import Reading
from lmshealth.logs import Metadata, Refusal
from lmshealth.magnitudes import Growth, Magnitude
from lmshealth.planning import Plan
from lmshealth.results import Line, Modes, Prognosis
from lmshealth.summary import Assessment

_KM = 1000.0
_MICRO, _MILLI, _NANO = 1e-6, 1e-3, 1e-9
_RUL_LEVELS = (0.05, 0.10, 0.25, 0.50, 0.75, 0.90, 0.95)

COLUMNS = {
    "modes": "log stage recorded_at travel_km temperature_c mode source channel frequency_hz "
    "frequency_std_hz damping_ratio damping_ratio_std correlation_f_zeta snr dispersion "
    "flags",
    "modes_cov": "log source_a mode_a source_b mode_b cov_ln_f",
    "track": "stage recorded_at travel_km mode frequency_hz frequency_std_hz damping_ratio "
    "damping_ratio_std drift drift_std nis nis_dof noise_scale",
    "track_cov": "stage recorded_at mode_a mode_b cov_drift",
    "effects": "stage mode covariate coefficient std",
    "events": "stage recorded_at travel_km kind mode source size std evidence",
    "health": "stage recorded_at travel_km parameter median q05 q25 q75 q95 ess r_hat converged "
    "informed",
    "prognosis": "stage parameter limit "
    + " ".join(
        f"rul_{unit}_q{100 * level:02.0f}"
        for unit in ("km", "hours", "days")
        for level in _RUL_LEVELS
    )
    + " censored_from probability_beyond_horizon probability_already_past service_by",
    "verdict": "stage recorded_at verdict probability",
    "refused": "log channel mode source reason detail",
}

# What looking at single logs prints; `run` writes no such files.
LOOKS = {
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

Row = dict[str, Any]


def modes_rows(log: str, metadata: Metadata, modes: Modes) -> list[Row]:
    """List the estimates of one log, one row per mode."""
    return [
        {
            "log": log,
            "stage": metadata.stage,
            "recorded_at": _moment(metadata.recorded_at),
            "travel_km": None if metadata.travel is None else metadata.travel / _KM,
            "temperature_c": metadata.covariates.get("temperature_c"),
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
        }
        for i in range(len(modes.names))
    ]


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
    names = LOOKS["frf"].split()[1:]
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
        name: [dict(zip(LOOKS[name].split(), row, strict=True)) for row in rows]
        for name, rows in (("detect", asked), ("plan", efforts))
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


def refused_rows(refused: Iterable[Refusal]) -> list[Row]:
    """List what was not analysed, one row each."""
    return [
        {name: getattr(refusal, name) for name in COLUMNS["refused"].split()} for refusal in refused
    ]


def frame(name: str, rows: Sequence[Row]) -> pd.DataFrame:
    """Make one of the tables of the contract, with its columns even when it is empty."""
    return pd.DataFrame(list(rows), columns=(COLUMNS | LOOKS)[name].split())


def all_tables(
    readings: Sequence[Reading], assessments: Sequence[Assessment], refused: Sequence[Refusal]
) -> dict[str, pd.DataFrame]:
    """Make all tables of a run, keyed by file name without ending."""
    rows: dict[str, list[Row]] = {name: [] for name in COLUMNS}
    for reading in readings:
        rows["modes"] += modes_rows(reading.log, reading.metadata, reading.modes)
        rows["modes_cov"] += _modes_cov_rows(reading)
    for assessment in assessments:
        rows["track"] += _track_rows(assessment)
        rows["track_cov"] += _track_cov_rows(assessment)
        rows["effects"] += _effects_rows(assessment)
        rows["health"] += _health_rows(assessment)
        rows["prognosis"] += _prognosis_rows(assessment)
        rows["verdict"].append(
            {
                "stage": assessment.judgement.stage,
                "recorded_at": _moment(assessment.judgement.recorded_at),
                "verdict": assessment.judgement.verdict,
                "probability": assessment.judgement.probability,
            }
        )
    rows["refused"] = refused_rows(refused)
    return {name: frame(name, content) for name, content in rows.items()}


def _moment(moment: datetime | None) -> str | None:
    return None if moment is None else moment.isoformat()


def _modes_cov_rows(reading: Reading) -> list[Row]:
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


def _track_rows(assessment: Assessment) -> list[Row]:
    track = assessment.track
    if track is None:
        return []
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
            "noise_scale": track.noise_scale[k],
        }
        for k in range(len(track.logs))
        for i, mode in enumerate(track.modes)
    ]


def _track_cov_rows(assessment: Assessment) -> list[Row]:
    track = assessment.track
    if track is None:
        return []
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


def _effects_rows(assessment: Assessment) -> list[Row]:
    track = assessment.track
    if track is None:
        return []
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


def _health_rows(assessment: Assessment) -> list[Row]:
    health = assessment.health
    if health is None:
        return []
    q05, q25, median, q75, q95 = health.quantile(np.array([0.05, 0.25, 0.5, 0.75, 0.95]))
    return [
        {
            "stage": health.stage,
            "recorded_at": _moment(health.recorded_at[k]),
            "travel_km": health.travel[k] / _KM,
            "parameter": name,
            "median": median[k, j],
            "q05": q05[k, j],
            "q25": q25[k, j],
            "q75": q75[k, j],
            "q95": q95[k, j],
            "ess": health.ess[k, j],
            "r_hat": health.r_hat[k, j],
            "converged": bool(health.converged[k]),
            "informed": health.informed[k, j],
        }
        for k in range(len(health.recorded_at))
        for j, name in enumerate(health.parameters)
    ]


def _prognosis_rows(assessment: Assessment) -> list[Row]:
    prognosis = assessment.prognosis
    if prognosis is None:
        return []
    beyond, past = prognosis.beyond_horizon(), prognosis.already_past()
    rows = []
    for j, name in enumerate(prognosis.parameters):
        rows.append(
            {
                "stage": prognosis.stage,
                "parameter": name,
                "limit": prognosis.limits[j],
                **_rul(prognosis, prognosis.remaining[:, j]),
                "probability_beyond_horizon": beyond[j],
                "probability_already_past": past[j],
                "service_by": assessment.service_by() if name == "any" else None,
            }
        )
    return rows


def _rul(prognosis: Prognosis, remaining: FloatArray) -> Row:
    """Quantiles of the remaining life; past the horizon they are empty, not numbers."""
    left = np.maximum(remaining, 0)
    days = left / prognosis.usage
    row: Row = {}
    censored = [
        level
        for level in _RUL_LEVELS
        if np.quantile(left, level, method="lower") > prognosis.horizon
    ]
    for unit, values in (("km", left / _KM), ("hours", days * 24), ("days", days)):
        for level in _RUL_LEVELS:
            quantile = None if level in censored else np.quantile(values, level, method="lower")
            row[f"rul_{unit}_q{100 * level:02.0f}"] = quantile
    row["censored_from"] = censored[0] if censored else None
    return row
