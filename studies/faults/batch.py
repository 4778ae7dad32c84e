"""The batch that is disturbed: short logs of several small machines, some of them damaged."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import h5py
import numpy as np
from scipy.signal import lfilter

_MODES = (("roll", 62.0, 0.02, 0.25), ("pitch", 105.0, 0.02, 0.4))
_RATE_HZ, _SECONDS = 500.0, 4.0


def write_stages(folder: Path) -> tuple[Path, Path]:
    """Write two descriptions of the same modes: of machines with health, and to be watched only."""
    folder.mkdir(parents=True, exist_ok=True)
    grid = np.geomspace(0.2, 2.0, 12)
    lines = [
        f"{p!r},{name},{f * p**slope!r}" for p in grid.tolist() for name, f, _, slope in _MODES
    ]
    (folder / "worn.map.csv").write_text("\n".join(["guide_preload,mode,frequency_hz", *lines]))
    modes = "".join(
        f'[[mode]]\nname = "{name}"\nfrequency_hz = {f}\ndamping_ratio = {zeta}\n'
        for name, f, zeta, _ in _MODES
    )
    worn, watched = folder / "worn.toml", folder / "watched.toml"
    watched.write_text(f'name = "watched"\n[match]\nstage = "WATCHED-*"\n{modes}')
    worn.write_text(
        f"""name = "worn"
[match]
stage = "WORN-*"
{modes}[[parameter]]
name = "guide_preload"
limit = {{ below = 0.6 }}
prior = {{ kind = "lognormal", median = 1.0, sigma = 0.3 }}
law = {{ kind = "linear", rate_per_km = {{ kind = "normal", mean = 1e-4, std = 3e-5 }} }}
[map]
file = "worn.map.csv"
[decision]
max_risk = 0.05
"""
    )
    return worn, watched


def write_machine(folder: Path, machine: str, n_logs: int) -> None:
    """Write the logs of a wearing machine; one is damaged, one a copy, one of an unknown machine.

    Parameters
    ----------
    folder : Path
        Where to; a folder of the machine's name is made there.
    machine : str
        Its identity.
    n_logs : int
        How many, at least four.
    """
    own = folder / machine
    own.mkdir(parents=True)
    for number in range(n_logs):
        stage = "UNKNOWN" if number == 1 else machine
        _write_log(own / f"log-{number:03d}.h5", stage, [*machine.encode(), number])
    first, broken, copy = (own / f"log-{number:03d}.h5" for number in (0, 2, 3))
    content = first.read_bytes()
    broken.write_bytes(content[: len(content) // 2] + machine.encode())
    copy.write_bytes(content)


def _write_log(path: Path, stage: str, seed: list[int]) -> None:
    """Write one log of a machine that loses preload: modes that white noise excites."""
    rng = np.random.default_rng([20261122, *seed])
    number, n = seed[-1], round(_RATE_HZ * _SECONDS)
    preload = 1 - 0.005 * number
    values = rng.standard_normal(n)
    for _, f, zeta, slope in _MODES:
        turn = 2 * np.pi * f * preload**slope / _RATE_HZ
        pole = np.exp(turn * (1j * np.sqrt(1 - zeta**2) - zeta))
        values += lfilter([1, -2, 1], [1, -2 * pole.real, abs(pole) ** 2], rng.standard_normal(n))
    moment = datetime(2026, 1, 1, 8, tzinfo=UTC) + timedelta(days=5 * number)
    with h5py.File(path, "w") as file:
        file["acc_feed_m_s2"] = values
        file.attrs.update(
            stage=stage,
            recorded_at=moment.isoformat(),
            travel_km=f"{50 * number}",
            sample_rate_hz=f"{_RATE_HZ:g}",
        )
