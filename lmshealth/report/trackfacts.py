"""What a page says of a track: modes, events, effects, and whether the filter is believed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lmshealth.io.log import Refusal
from lmshealth.report.figures import (
    chi_square_band,
)
from lmshealth.report.text import GAP, change, covariate, km, signed, spell
from lmshealth.stage.description import Stage
from lmshealth.tracking.covariate_effects import CovariateEffect
from lmshealth.tracking.history import History
from lmshealth.tracking.track import Effect, Event, Track

# A factor on standard deviations that is nearer to one is not worth a word.
_SCALED = 0.05


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


def mode_use(
    history: History, track: Track | None, stage: Stage, refused: Sequence[Refusal]
) -> Iterator[tuple[str, str, str, str]]:
    """Mode, logs that show it, estimates not believed, and why the others do not, mode by mode."""
    n = len(history.logs)
    doubted = Counter(mode for _, mode in (() if track is None else track.outliers))
    tracked = [mode.name for mode in stage.modes if mode.tracked]
    for mode in dict.fromkeys([*history.modes, *tracked]):
        found = np.isfinite(history.ln_frequency[:, history.columns(mode)]).any(axis=1)
        own = Counter(r.reason for r in refused if r.mode == mode and r.reason != "jump")
        shown = int(found.sum())
        yield (
            spell(mode),
            f"{shown} of {n}" + (f" ({100 * shown / n:.0f}{GAP}%)" if n else ""),
            str(doubted[mode]) if doubted[mode] else "none",
            ", ".join(f"{count} × {reason}" for reason, count in own.most_common()) or "–",
        )


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


@dataclass(frozen=True, slots=True)
class TakenOut:
    """What a covariate did and how it was taken out, as text; `rows` and `modes` go together."""

    name: str
    said: str
    curved: bool
    rows: tuple[tuple[str, ...], ...]
    modes: tuple[str, ...]


def taken_out(influences: Sequence[CovariateEffect]) -> Iterator[TakenOut]:
    """Tell what each covariate was in the logs, and what was taken out of every mode."""
    for column in dict.fromkeys(one.covariate for one in influences):
        own = [one for one in influences if one.covariate == column and one.values.size]
        if not own:
            continue
        name, unit = covariate(column)
        values = np.concatenate([one.values for one in own])
        low, high = float(values.min()), float(values.max())
        unit = f"{GAP}{unit}" if unit else ""
        yield TakenOut(
            name=name,
            said=f"it lay between {low:.4g} and {high:.4g}{unit}; frequencies are told for "
            f"{own[0].reference:.4g}{unit}",
            curved=len(own[0].effects) > 1,
            rows=tuple(_taken_row(one, unit) for one in own),
            modes=tuple(one.mode for one in own),
        )


def _taken_row(one: CovariateEffect, unit: str) -> tuple[str, ...]:
    """Mode, effect, change over the range seen, scatter before and after, whether it is seen."""
    per = f" per {unit.strip(GAP)}" if unit else " per unit"
    effect = "; ".join(
        f"{signed(100 * e.coefficient, 3)} ± {100 * e.std:.3f}{GAP}%{per}{'²' * (power > 1)}"
        for power, e in enumerate(one.effects, 1)
    )
    ends = np.array([one.values.min(), one.values.max()])
    change = 100 * float(np.diff(one.explained(ends))[0])
    return (
        spell(one.mode),
        effect,
        f"{signed(change, 2)}{GAP}%",
        f"{100 * one.measured.std():.2f}{GAP}%",
        f"{100 * one.corrected.std():.2f}{GAP}%",
        "yes" if one.seen else "no different from zero",
    )


def untouched(history: History, stage: Stage) -> list[str]:
    """Say which covariates nothing was taken out for, and why, one sentence each."""
    said = []
    named = {one.name: one.reference for one in stage.description.covariate}
    for column in dict.fromkeys([*named, *history.covariates]):
        name, unit = covariate(column)
        values = history.covariates.get(column, np.empty(0))
        values = values[np.isfinite(values)]
        bounds = f"{values.min():.4g} to {values.max():.4g}{GAP}{unit}" if values.size else ""
        if column in named and not values.size:
            said.append(f"No log tells {name}: what it does cannot be told from wear.")
        elif column in named and (values == named[column]).all():
            said.append(f"{name.capitalize()} was always {named[column]:.4g}{GAP}{unit}.".strip())
        elif column not in named and values.size and np.ptp(values) > 0:
            said.append(
                f"{name.capitalize()} went from {bounds}, but the stage description does not name "
                "it, so that nothing is taken out."
            )
    return said


def other_effects(track: Track) -> Iterator[Effect]:
    """Give the effects of sources, tunings and sensors, and scales that are not one."""
    for effect in track.effects:
        kind, colon, _ = effect.covariate.partition(":")
        if colon and (kind != "scale" or abs(effect.coefficient - 1) > _SCALED):
            yield effect


def effect_row(effect: Effect) -> tuple[str, str, str, bool]:
    """Mode, cause, coefficient in %, and whether it differs from zero."""
    kind, _, which = effect.covariate.partition(":")
    if kind == "scale":
        value = f"{effect.coefficient:.2f} ± {effect.std:.2f} times"
        return "–", f"standard deviations of {which}", value, True
    told = {"bias": "offset of", "servo": "tuning", "sensor": "sensor since"}
    name = f"{told.get(kind, kind)} {which}"
    value = f"{signed(100 * effect.coefficient, 3)} ± {100 * effect.std:.3f}{GAP}%"
    return spell(effect.mode), spell(name), value, abs(effect.coefficient) > 2 * effect.std
