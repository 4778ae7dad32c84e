"""Simulated stops: decays that begin at random phases, ambient responses, white noise."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lmshealth import identify_decays, load_stage, read_log
from lmshealth.io.log import Log
from models.dynamics.plant import closed_loop_modes
from models.dynamics.stages import STAGES
from models.recordings.velocities import Experiment, drive_velocities
from studies.harness.data.cramer_rao import Recording, Vibration, decay_bound
from studies.harness.data.logs import make_log
from studies.harness.study import Row

VELOCITIES = (0.1, 0.4)

RATE = 400.0


@dataclass(frozen=True)
class Case:
    """Stops of a machine."""

    name: str
    modes: tuple[tuple[float, float], ...]  # Natural frequency in Hz and damping ratio
    n_stops: int = 1  # Decays in a log
    seconds: float = 1.0  # Length of each
    ambient: float = 0.03  # Standard deviation of the response over the amplitude after a stop
    noise: float = 0.02  # The same of the noise of a sample
    n_channels: int = 1  # Channels with independent noise; shapes alternate in sign

    def vibration(self) -> Vibration:
        """Return the true modes."""
        f, zeta = np.array(self.modes).T
        shapes = [
            [(-1.0) ** (i * c) * (1 - 0.2 * c) for i in range(f.size)]
            for c in range(self.n_channels)
        ]
        return Vibration(f, zeta, np.array(shapes))

    def bound(self) -> np.ndarray:
        """Bound standard deviations of ln f and ln ζ, shape ``(2, n_modes)``.

        Decays begin at random phases; the bound hardly depends on them, and has them spread evenly.
        """
        modes = self.vibration()
        f, zeta = modes.frequency, modes.damping_ratio
        phase = np.linspace(0, np.pi, self.n_stops, endpoint=False)[:, None] + np.arange(f.size)
        reach = max(20.0, 8 * float(np.max(zeta * f)))
        band = (float(f.min()) - reach, min(float(f.max()) + reach, 0.48 * RATE))
        noise = np.full(self.n_channels, self.noise**2 * 2 / RATE)
        ambient = self.ambient**2 * 4 * zeta / (np.pi * f)
        cov = decay_bound(modes, np.exp(1j * phase), ambient, Recording(noise, self.seconds, band))
        return np.asarray(np.sqrt(np.diag(cov)).reshape(2, -1))


GUIDE = ((105.0, 0.015), (120.0, 0.02), (135.0, 0.025))
CLOSE = ((60.37, 0.005), (62.4, 0.005))
CASES = (
    Case("0.1 %, one stop", ((60.37, 0.001),)),
    Case("1 %, one stop", ((60.37, 0.01),)),
    Case("3 %, one stop", ((60.37, 0.03),)),
    Case("1 %, one stop, loud noise", ((60.37, 0.01),), noise=0.1),
    Case("1 %, one stop, faint noise", ((60.37, 0.01),), noise=0.002),
    Case("0.1 %, five stops", ((60.37, 0.001),), n_stops=5, ambient=0.1),
    Case("1 %, five stops", ((60.37, 0.01),), n_stops=5, ambient=0.1),
    Case("2 Hz apart, four stops", CLOSE, n_stops=4, n_channels=2),
    Case("guide modes, eight stops", GUIDE, n_stops=8, seconds=0.5, n_channels=2),
)
# Without an ambient response: one stop cannot rule it out, and intervals may be too wide.
QUIET = (
    Case("1 %, one stop, quiet", ((60.37, 0.01),), ambient=0.0),
    Case("1 %, five stops, quiet", ((60.37, 0.01),), n_stops=5, ambient=0.0),
)


def simulate(case: Case, rng: np.random.Generator) -> np.ndarray:
    """Make the accelerations after each stop, shape ``(n_stops, n_channels, n_samples)``."""
    n = round(case.seconds * RATE)
    t = np.arange(n) / RATE
    x = case.noise * rng.standard_normal((case.n_stops, case.n_channels, n))
    for shape, (f, zeta) in zip(case.vibration().shapes.T, case.modes, strict=True):
        omega = 2 * np.pi * f
        for stop in x:
            phase = rng.uniform(0, 2 * np.pi)
            wave = np.exp(-zeta * omega * t)
            wave *= np.cos(omega * np.sqrt(1 - zeta**2) * t + phase)
            stop += np.outer(shape, wave + _shaken(rng, f, zeta, case.ambient, n))
    return x


def _shaken(rng: np.random.Generator, f: float, zeta: float, std: float, n: int) -> np.ndarray:
    """Make the response of a mode to a white force, cut from a circle longer than its memory."""
    size = 1 << int(np.ceil(np.log2(3 * n + 2 * RATE / (zeta * f))))
    hertz = np.arange(size // 2 + 1) * RATE / size
    response = hertz**2 / (f**2 - hertz**2 + 2j * zeta * f * hertz)
    force = rng.standard_normal((2, hertz.size))
    circle = np.fft.irfft(response * (force[0] + 1j * force[1]), size)
    # The variance of the part around the resonance is π f S / (4 ζ).
    psd = 2 * 2 / (size * RATE)
    return np.asarray(circle[:n] * std / np.sqrt(np.pi * f * psd / (4 * zeta)))


def to_log(x: np.ndarray) -> Log:
    """Join stops to a log whose pieces are one decay each."""
    n_stops, n_channels, n = x.shape
    signals = {f"acc_{c}": x[:, c].ravel() for c in range(n_channels)}
    return make_log(signals, RATE, [(k * n, (k + 1) * n) for k in range(n_stops)])


def one_machine(name: str, seed: int) -> list[Row]:
    """Identify the modes after strokes at two velocities; one row per tracked mode and log."""
    truth = {mode.name: mode for mode in closed_loop_modes(STAGES[name])}
    stage = load_stage(name)
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        drive_velocities(Experiment(STAGES[name], seed=seed), folder, "hdf5", velocities=VELOCITIES)
        for path in sorted(folder.glob("*.h5")):
            found = identify_decays(read_log(path), stage)
            std = np.sqrt(np.diag(found.cov)).reshape(2, -1)
            for mode in stage.modes:
                row: Row = {"stage": name, "seed": seed, "log": path.stem}
                row |= {"mode": mode.name, "f_hz": None, "refused": ""}
                if mode.name not in found.names:
                    row["refused"] = next(r.reason for r in found.refused if r.mode == mode.name)
                else:
                    i, true = found.names.index(mode.name), truth[mode.name]
                    f, zeta = float(found.frequency[i]), float(found.damping_ratio[i])
                    row["f_hz"] = f
                    row["z_f"] = float(np.log(f / true.frequency_hz) / std[0, i])
                    row["z_zeta"] = float(np.log(zeta / true.damping_ratio) / std[1, i])
                    row["nearest"] = min(truth, key=lambda m: abs(truth[m].frequency_hz - f))
                rows.append(row)
    return rows
