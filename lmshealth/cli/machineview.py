"""What a terminal shows of a machine over its life: where its modes and its health stand."""

from __future__ import annotations

import math
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from lmshealth.cli.terminal import or_dash, print_table, print_text
from lmshealth.report.text import LEVELS, change

if TYPE_CHECKING:  # so that help comes without pandas and scipy
    from lmshealth.health.results import Health
    from lmshealth.tracking.track import Track

# A posterior this far from its Laplace approximation, in mean and ln width, is worth a word.
_ODD_SHIFT, _ODD_RATIO = 0.5, 0.3


def print_track(track: Track) -> None:
    """Print where the modes of a machine stand, what happened to it, and whether to believe it."""
    std = np.sqrt(np.einsum("kii->ki", track.drift_cov))
    cells: list[tuple[str, ...]] = [
        (
            mode,
            f"{np.exp(level):.3f} ± {np.exp(level) * track.ln_frequency_std[-1, i]:.3f}",
            "{:+.3f} ± {:.3f}".format(*change(track.drift[-1, i], std[-1, i])),
            f"{100 * np.exp(zeta):.2f} ± {100 * np.exp(zeta) * track.ln_damping_std[-1, i]:.2f}"
            if np.isfinite(zeta)
            else "–",
        )
        for i, (mode, level, zeta) in enumerate(
            zip(track.modes, track.ln_frequency[-1], track.ln_damping[-1], strict=True)
        )
    ]
    title = f"{track.stage}: modes after {len(track.logs)} logs (± one standard deviation)"
    print_table(title, ("mode",), ("frequency Hz", "drift %", "damping %"), cells)
    happened = [
        (
            f"{track.recorded_at[event.epoch]:%Y-%m-%d}",
            event.kind,
            event.mode,
            "{:+.2f} ± {:.2f}".format(*change(event.size, event.std)),
            f"{event.evidence:.1f}",
            "declared" if event.declared else "found",
        )
        for event in track.events
    ]
    if happened:
        numbers = ("size %", "ln Bayes factor")
        cells = [(*row[:3], row[5], *row[3:5]) for row in happened]
        print_table("What happened", ("since", "kind", "mode", ""), numbers, cells)
    print_text(_consistent(track))


def _consistent(track: Track) -> str:
    """Say whether the filter's innovations are what it expects."""
    found = track.consistency()
    told = (
        f"normalised innovations squared {found.nis:.2f} (expected 1, p = {found.p_value:.2g}), "
        f"autocorrelation {found.autocorrelation:+.2f} (p = {found.autocorrelation_p_value:.2g})"
    )
    if found.holds:
        how = {"inside": "", "below": ", which vary rather less than it expects",
               "above": ", which vary rather more than it expects"}[found.side]  # fmt: skip
        return f"The filter agrees with its logs{how}: {told}."
    if track.widening[-1] > 1:
        meant = (
            f"its standard deviations are widened {track.widening[-1]:.2f} times. A cause may be "
            "missing: a covariate, a retuning, or standard deviations that are not what they say."
        )
    else:
        meant = "the logs vary less than it expects, so that its own are rather too wide."
    return f"The filter does NOT agree with its logs: {told}; {meant}"


def print_health(health: Health) -> None:
    """Print what is left of each parameter at the last epoch, and on what that rests."""
    low, middle, high = health.latest(LEVELS)
    cells = [
        (
            name,
            f"{middle[j]:.3f}",
            f"{low[j]:.3f} to {high[j]:.3f}" if health.converged[-1] else "not converged",
            f"{100 * health.informed[-1, j]:.0f}",
            "–"
            if math.isnan(health.prior_ratio[-1, j])
            else f"{health.prior_shift[-1, j]:+.2f} σ × {health.prior_ratio[-1, j]:.2f}",
            or_dash(health.ess[-1, j], ".0f"),
            or_dash(health.r_hat[-1, j], ".3f"),
        )
        for j, name in enumerate(health.parameters)
    ]
    numbers = ("median", "90 % interval", "data %", "prior × 2", "ESS", "R-hat")
    title = (
        f"{health.stage}: health at {health.recorded_at[-1]:%Y-%m-%d}, the last of "
        f"{len(health.recorded_at)} epochs"
    )
    print_table(title, ("parameter",), numbers, cells)
    print_text(
        "data: share of the prior's variance that they removed; prior × 2: how far the median "
        "moves, and how much wider the interval gets, with priors twice as wide, as far as the "
        "map reaches."
    )
    for j, k in combinations(range(len(health.parameters)), 2):
        rho = health.correlation[-1, j, k]
        print_text(f"Correlation of {health.parameters[j]} and {health.parameters[k]}: {rho:+.2f}.")
    if not health.explained:
        print_text(
            f"No state of the parameters on the map explains these drifts (p = {health.fit[-1]:.1g}"
            "): nothing is claimed. Look for what else moved the modes, or for a wrong map."
        )
    for j, name in enumerate(health.parameters):
        if health.at_edge[-1, j]:
            print_text(f"{name} stands at the edge of the map: this is a bound; widen the map.")
        shift, ratio = health.laplace_shift[-1, j], health.laplace_ratio[-1, j]
        if abs(shift) > _ODD_SHIFT or abs(np.log(ratio)) > _ODD_RATIO:
            print_text(
                f"{name}: far from normal; Laplace's approximation lies {shift:+.1f} σ lower, and "
                f"the posterior is {ratio:.2f} times as wide."
            )
        if not health.identifiable[-1, j]:
            print_text(f"{name}: not identifiable by the tracked modes; see lmshealth stage.")
        elif health.explained and not health.informed_parameters()[j]:
            print_text(f"{name}: these drifts tell too little of it for a claim.")
    for when in np.flatnonzero(~health.converged):
        print_text(f"The sampler did not converge at {health.recorded_at[when]:%Y-%m-%d}.")
