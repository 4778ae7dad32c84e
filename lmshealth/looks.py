"""Tables of what single logs show, as the commands print them; `run` writes no such files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, astuple
from itertools import combinations

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.examination import USUAL_DURATION, Coverage, Examination, ModeCheck, Telling
from lmshealth.findings import Finding
from lmshealth.following import FollowingError
from lmshealth.frf import FrfReading
from lmshealth.magnitudes import Growth, Magnitude
from lmshealth.planning import Plan
from lmshealth.results import Line
from lmshealth.tables import Row

_MICRO, _MILLI, _NANO = 1e-6, 1e-3, 1e-9

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


def stage_rows(examined: Examination, found: Sequence[Finding]) -> dict[str, list[Row]]:
    """List what an examination of a stage description measured, and what it comes to."""
    names = [telling.parameter for telling in examined.tellings]
    return {
        "stage": [
            {
                "name": examined.name,
                "model_std": examined.model_std,
                "n_logs": examined.n_logs,
                "seconds_per_log": USUAL_DURATION,
            }
        ],
        "modes": [_mode_row(check) for check in examined.modes],
        "parameters": [
            _parameter_row(coverage, telling)
            for coverage, telling in zip(examined.coverage, examined.tellings, strict=True)
        ],
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


def _parameter_row(coverage: Coverage, telling: Telling) -> Row:
    spec = coverage.parameter
    levels = ("q005", "q05", "q95", "q995")
    return {
        "parameter": spec.name,
        "baseline": spec.baseline,
        "limit": spec.limit.below if spec.limit else None,
        "limit_on_map": coverage.holds_limit if spec.limit else None,
        "map_low": coverage.low,
        "map_high": coverage.high,
        **{f"prior_{key}": value for key, value in zip(levels, coverage.prior, strict=True)},
        "prior_below_map": coverage.below,
        "prior_above_map": coverage.above,
        "prior_std_ln": telling.prior_std,
        "logs_std_ln": telling.usual_std,
        "endless_logs_std_ln": telling.endless_std,
        "exact_map_std_ln": telling.exact_map_std,
        "others_known_std_ln": telling.known_std,
        "informed": telling.informed(telling.usual_std),
        "verdict": telling.verdict,
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
