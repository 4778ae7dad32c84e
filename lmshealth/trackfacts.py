"""What a page says of a track: modes, events, effects, and whether the filter is believed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from lmshealth.trackplots import chi_square_band
from lmshealth.tracks import Effect, Event, Track
from lmshealth.wording import GAP, change, km, signed, spell

_UNITS = {"c": "°C", "kg": "kg", "mm": "mm"}


@dataclass(frozen=True, slots=True)
class Fit:
    """A chi-square beside its 95 % band: ``side`` is ``inside``, ``above`` or ``below`` it."""

    value: float
    dof: float
    low: float
    high: float
    side: str


def mode_rows(track: Track) -> Iterator[tuple[str, ...]]:
    """Name, baseline, present value, change and damping of each mode."""
    for k, mode in enumerate(track.modes):
        level, drift = track.ln_frequency[-1, k], track.drift[-1, k]
        drift_std = np.sqrt(track.drift_cov[-1, k, k])
        std = np.exp(level) * track.ln_frequency_std[-1, k]
        zeta = 100 * np.exp(track.ln_damping[-1, k])
        told = f"{zeta:.2f} ± {zeta * track.ln_damping_std[-1, k]:.2f}{GAP}%"
        if np.isfinite([level, drift]).all():
            yield (
                spell(mode),
                f"{np.exp(level - drift):.2f}{GAP}Hz",
                f"{np.exp(level):.2f} ± {std:.2f}{GAP}Hz",
                _change(drift, drift_std),
                told if np.isfinite(zeta) else "–",
            )


def _change(ln: float, std: float) -> str:
    value, spread = change(ln, std)
    return f"{signed(value, 2)} ± {spread:.2f}{GAP}%"


def surprise(track: Track) -> tuple[int, int, Fit] | None:
    """Count epochs inside the band of their NIS, all epochs, and judge their sum."""
    seen = (track.nis_dof > 0) & np.isfinite(track.nis)
    nis, dof = track.nis[seen], track.nis_dof[seen]
    low, high = chi_square_band(dof)
    total = fit(float(nis.sum()), float(dof.sum()))
    inside = int(np.sum((nis >= low) & (nis <= high)))
    return None if total is None else (inside, nis.size, total)


def fit(value: float, dof: float) -> Fit | None:
    """Judge a chi-square by its band; None without degrees of freedom."""
    if dof <= 0:
        return None
    low, high = chi_square_band(np.array(dof, dtype=float)).tolist()
    side = "above" if value > high else "below" if value < low else "inside"
    return Fit(value, dof, low, high, side)


def happened(track: Track) -> Iterator[dict[str, Any]]:
    """Tell each event once, with what it did to every mode."""
    groups: dict[tuple[str, int, str], list[Event]] = {}
    for event in track.events:
        groups.setdefault((event.kind, event.epoch, event.source), []).append(event)
    for (kind, epoch, source), events in groups.items():
        first, of = events[0], ", damping" if kind == "regreasing" else ""
        yield {
            "kind": kind,
            "source": source,
            "since": track.recorded_at[epoch],
            "travel": km(track.travel[epoch]) if np.isfinite(track.travel[epoch]) else "–",
            "known": track.recorded_at[first.found_at],
            "declared": first.declared,
            "sizes": [
                f"{spell(event.mode)}{of} {_change(event.size, event.std)}" for event in events
            ],
            "evidence": f"{first.evidence:.1f}".replace("-", "−"),
        }


def filter_health(track: Track) -> dict[str, Any]:
    """Say whether the filter agrees with its logs, and how far it is widened."""
    found = track.consistency()
    return {
        "holds": found.holds,
        "autocorrelation": signed(found.autocorrelation, 2),
        "p_value": f"{found.autocorrelation_p_value:.2g}",
        "widening": float(track.widening[-1]),
    }


def effect_row(effect: Effect) -> tuple[str, str, str, bool]:
    """Mode, covariate, coefficient in ‰ per unit, and whether it differs from zero."""
    name, _, unit = effect.covariate.rpartition("_")
    kind, colon, which = effect.covariate.partition(":")
    if kind == "scale":
        value = f"{effect.coefficient:.2f} ± {effect.std:.2f} times"
        return "–", f"standard deviations of {which}", value, abs(effect.coefficient - 1) > 0.05
    if colon:
        told = {"bias": "offset of", "servo": "tuning", "sensor": "sensor since"}
        name, per = f"{told.get(kind, kind)} {which}", ""
    elif name and unit in _UNITS:
        per = f" per {_UNITS[unit]}"
    else:
        name, per = effect.covariate, " per unit"
    value = f"{signed(1e3 * effect.coefficient, 3)} ± {1e3 * effect.std:.3f}{GAP}‰{per}"
    return spell(effect.mode), spell(name), value, abs(effect.coefficient) > 2 * effect.std
