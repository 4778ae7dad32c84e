"""The other measurements: how each is read, and what is known of it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from lmshealth import identify, read_log
from lmshealth.io.log import Channel, Log, Metadata
from lmshealth.modal.modes import Modes
from lmshealth.stage.description import Description, ModeSpec, Stage
from studies.harness.study import Row

Z95 = float(norm.isf(0.025))

# Estimated once by another method: lowest and highest frequency in Hz, and how far off is right.
SHAKE = {
    "Flexible": ((3.63, 3.75, 0.15), (11.1, 11.25, 0.3), (16.6, 16.8, 0.3)),
    "Stiff": ((7.73, 7.98, 0.15), (25.0, 25.0, 0.3)),
}
FLOORS, KOMA_RATE = ("1st", "2nd", "3rd"), 12.0
# Channels 3 and 4 are accelerations; the set's own description drops channel 5.
WEIMAR_RATE, WEIMAR_CHANNELS = 256.0, (3, 4)
WEIMAR = (4.018, 4.771, 6.682, 7.616, 9.665, 12.167, 12.598)
WEIMAR_DAMPING = 0.0019
MPSTD = "uff58_samples/MPSTD#Set001_2024_10_08_10_27_07.uff"
MPSTD_BAND, MPSTD_MODE, MAINS = (20.0, 80.0), (40.5, 0.015), 50.0


def to_log(values: np.ndarray[Any, Any], rate: float) -> Log:
    """Make a log of accelerations, shape ``(n_samples, n_channels)``."""
    channels = tuple(
        Channel(f"acc_{k}", "acceleration", np.array(column, dtype=float))
        for k, column in enumerate(values.T)
    )
    return Log("record", "0" * 64, Metadata(), rate, channels, None, ((0, len(values)),), ())


def identify_known(
    log: Log,
    frequency: Iterable[float],
    damping: Iterable[float],
    channels: Sequence[str] | None = None,
) -> list[Row]:
    """Identify modes that a description names; those refused have their reason instead."""
    pairs = enumerate(zip(frequency, damping, strict=True))
    specs = tuple(ModeSpec(str(k), f, z) for k, (f, z) in pairs)
    stage = Stage(Description(name="known", mode=specs), None, "0" * 64)
    modes = identify(log, stage, channels=channels)
    why = {refusal.mode: refusal.reason for refusal in modes.refused}
    return [
        describe(modes, modes.names.index(spec.name))
        if spec.name in modes.names
        else {"refused": why[spec.name]}
        for spec in specs
    ]


def describe(modes: Modes, i: int) -> Row:
    """Return the estimates of one mode."""
    return {
        "f_hz": float(modes.frequency[i]),
        "f_std_hz": float(modes.frequency_std[i]),
        "zeta": float(modes.damping_ratio[i]),
        "zeta_std": float(modes.damping_ratio_std[i]),
    }


def holds(row: Row, what: str, truth: float) -> bool:
    """Whether the 95 % interval of f or ζ, which is one of its logarithm, holds a value."""
    if "refused" in row:
        return False
    value, std = (row["f_hz"], row["f_std_hz"]) if what == "f" else (row["zeta"], row["zeta_std"])
    return bool(abs(np.log(value / truth)) < Z95 * std / value)


def study_koma(data: Path) -> list[Row]:
    """Identify the simulated shear frame; with its parameters those of what was integrated.

    Steps of the trapezoidal rule of length h turn the pole λ into ln((1 + λh/2) / (1 - λh/2)) / h.
    """
    folder = data / "SIMULATED_koma_shearframe"
    omega, zeta = np.load(folder / "omega_n.npy"), np.load(folder / "xi_ref.npy")
    pole = omega * (-zeta + 1j * np.sqrt(1 - zeta**2)) / (2 * KOMA_RATE)
    stepped = np.log((1 + pole) / (1 - pole)) * KOMA_RATE
    known = {
        "documented": (omega / (2 * np.pi), zeta),
        "stepped": (np.abs(stepped) / (2 * np.pi), -stepped.real / np.abs(stepped)),
    }
    log = to_log(np.load(folder / "data_shearframe.npy"), KOMA_RATE)
    rows = identify_known(log, *known["documented"])
    for k, row in enumerate(rows):
        for name, (f, damping) in known.items():
            row[f"{name}_f_hz"], row[f"{name}_zeta"] = float(f[k]), float(damping[k])
            row[f"holds_{name}_f"] = holds(row, "f", f[k])
            row[f"holds_{name}_zeta"] = holds(row, "zeta", damping[k])
    return rows


def study_weimar(data: Path) -> list[Row]:
    """Identify the simulated frame of the lowest damping."""
    record = np.load(data / "SIMULATED_weimar_frame/measurement_2.npy")
    log = to_log(record[:, WEIMAR_CHANNELS], WEIMAR_RATE)
    rows = identify_known(log, WEIMAR, [WEIMAR_DAMPING] * len(WEIMAR))
    for f, row in zip(WEIMAR, rows, strict=True):
        row |= {"known_f_hz": f, "holds_zeta": holds(row, "zeta", WEIMAR_DAMPING)}
        # Half-power bandwidth of one Fourier step, as a damping ratio.
        row["resolution"] = WEIMAR_RATE / len(record) / (2 * f)
    return rows


def study_mpstd(data: Path) -> Row:
    """Search for a weak mode beside the mains, without a description."""
    modes = identify(read_log(data / MPSTD), band=MPSTD_BAND)
    f, damping = MPSTD_MODE
    row = describe(modes, int(np.argmin(np.abs(modes.frequency - f))))
    lines = [line for line in modes.lines if abs(line.frequency - MAINS) < 1]
    return row | {
        "holds_f": holds(row, "f", f),
        "holds_zeta": holds(row, "zeta", damping),
        "modes_at_mains": int(np.sum(np.abs(modes.frequency - MAINS) < 1)),
        "lines": [{"frequency_hz": line.frequency, "kind": line.kind} for line in lines],
    }
