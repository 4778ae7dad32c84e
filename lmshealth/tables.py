"""Tables of a run, with the columns of the public contract: units stand in the names again."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import date, datetime
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

from lmshealth.arrays import FloatArray
from lmshealth.decision import Reached, Service, remaining_days
from lmshealth.history import Reading
from lmshealth.logs import Refusal
from lmshealth.readers.metadata import COVARIATES
from lmshealth.results import Health, Prognosis
from lmshealth.summary import Assessment
from lmshealth.tracks import Smoothed, Track

_KM, _MICRO = 1000.0, 1e-6
RUL_LEVELS = (0.05, 0.10, 0.25, 0.50, 0.75, 0.90, 0.95)

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


def modes_rows(reading: Reading) -> list[Row]:
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


def tables_of(readings: Sequence[Reading], assessment: Assessment) -> dict[str, list[Row]]:
    """List everything about one machine, by the name of the table, which is a file without ending.

    Parameters
    ----------
    readings : sequence of Reading
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
        rows["prognosis"] = prognosis_rows(assessment.prognosis, assessment.service())
    judgement = assessment.judgement
    verdict = judgement.verdict, judgement.probability
    values = judgement.stage, _moment(judgement.recorded_at), *verdict
    rows["verdict"] = [dict(zip(COLUMNS["verdict"].split(), values, strict=True))]
    rows["refused"] = refused_rows(assessment.refused)
    return rows


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


def track_rows(track: Track, smoothed: Smoothed | None = None) -> list[Row]:
    """List a track, one row per epoch and mode; what is smoothed has columns of its own."""
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
        for k in range(len(track.logs))
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
    prognosis: Prognosis, service: Service, before: tuple[date, Reached] | None = None
) -> list[Row]:
    """List a remaining life, one row per limit and one for any of them.

    Parameters
    ----------
    prognosis : Prognosis
        The draws.
    service : Service
        What they lead to; told in the row of any limit.
    before : tuple of date and Reached, optional
        A day, and the probabilities to have reached a limit before it: in columns of their own.
    """
    beyond, past = prognosis.beyond_horizon(), prognosis.already_past()
    days = remaining_days(prognosis)
    rows = []
    for j, name in enumerate(prognosis.parameters):
        row = {
            "stage": prognosis.stage,
            "parameter": name,
            "limit": prognosis.limits[j],
            **_rul(prognosis, j, days[:, j]),
            "probability_beyond_horizon": beyond[j],
            "probability_already_past": past[j],
            "service": service.kind if name == "any" else None,
            "service_by": service.by if name == "any" else None,
            "service_risk": service.risk if name == "any" else None,
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


def _rul(prognosis: Prognosis, column: int, days: FloatArray) -> Row:
    """Quantiles of the remaining life; past the horizon they are empty, not numbers."""
    travel = prognosis.claimed()[:, column]
    row: Row = {}
    for unit, values in (("km", travel / _KM), ("hours", days * 24), ("days", days)):
        found = np.quantile(np.maximum(values, 0), RUL_LEVELS, method="inverted_cdf")
        for level, value in zip(RUL_LEVELS, found, strict=True):
            row[f"rul_{unit}_q{100 * level:02.0f}"] = None if np.isinf(value) else float(value)
    censored = [level for level, value in zip(RUL_LEVELS, found, strict=True) if np.isinf(value)]
    row["censored_from"] = censored[0] if censored else None
    return row
