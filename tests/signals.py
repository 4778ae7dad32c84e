"""Synthetic logs with known truth: stationary responses of modes to white forces, lines, noise.

Everything is made in the frequency domain on a circle several times longer than the record, of
which the record is a stretch: it is stationary, not periodic in itself, and has exactly the stated
spectrum. All power spectral densities are one-sided.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import h5py
import numpy as np

from lmshealth.io.log import Channel, ChannelKind, Log, Metadata
from lmshealth.modal.modes import Modes
from lmshealth.signal.segments import Segment
from lmshealth.signal.spectra import CrossSpectrum, ResonanceRange, transform_segment
from lmshealth.stage.description import Description, ModeSpec, Order, Stage

_KINDS: dict[str, ChannelKind] = {"delta": "displacement", "current": "current"}
_CIRCLE = 3  # lengths of the record on the circle it is cut from


@dataclass(frozen=True)
class Mode:
    """A mode and how strongly it moves each channel.

    Attributes
    ----------
    frequency, damping : float
        Natural frequency in Hz and damping ratio.
    psd : float
        Power spectral density of the modal force per mass, (m/s²)²/Hz.
    shape : tuple of float
        Participation in each channel.
    """

    frequency: float
    damping: float
    psd: float = 1.0
    shape: tuple[float, ...] = (1.0,)

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """Acceleration per force per mass: -ω² / (ω_n² - ω² + 2iζω_nω)."""
        w, w_n = 2 * np.pi * frequency, 2 * np.pi * self.frequency
        return -(w**2) / (w_n**2 - w**2 + 2j * self.damping * w_n * w)

    def snr(self, noise: float) -> float:
        """Modal signal-to-noise ratio S / (4 ζ² S_e)."""
        return self.psd / (4 * self.damping**2 * noise)


def density(modes: Sequence[Mode], frequency: np.ndarray, noise: float = 0.0) -> np.ndarray:
    """Power spectral density of the first channel under independent forces."""
    parts = [m.psd * np.abs(m.shape[0] * m.response(frequency)) ** 2 for m in modes]
    return sum(parts, np.full(frequency.shape, noise))


def white(rng: np.random.Generator, psd: float, n: int, rate: float) -> np.ndarray:
    """White noise of a power spectral density, shape ``(n,)``."""
    return rng.standard_normal(n) * np.sqrt(psd * rate / 2)


def accelerations(
    rng: np.random.Generator, modes: Sequence[Mode], n: int, rate: float, noise: float
) -> np.ndarray:
    """Accelerations of all channels with white noise of density ``noise`` in each.

    Shape ``(n_channels, n)``; the modal forces are independent of each other.
    """
    return _responses(rng, modes, n, rate, lambda f: np.ones_like(f)) + np.array(
        [white(rng, noise, n, rate) for _ in modes[0].shape]
    )


def displacements(
    rng: np.random.Generator, modes: Sequence[Mode], n: int, rate: float, noise: float
) -> np.ndarray:
    """Displacements of the same, with white noise of density ``noise`` in m²/Hz."""
    return _responses(rng, modes, n, rate, lambda f: -1 / (2 * np.pi * f) ** 2) + np.array(
        [white(rng, noise, n, rate) for _ in modes[0].shape]
    )


def _responses(
    rng: np.random.Generator,
    modes: Sequence[Mode],
    n: int,
    rate: float,
    turn: Callable[[np.ndarray], np.ndarray],
) -> np.ndarray:
    size = 1 << int(np.ceil(np.log2(_CIRCLE * n)))
    frequency = np.arange(1, size // 2) * rate / size
    spectrum = np.zeros((len(modes[0].shape), size // 2 + 1), dtype=complex)
    for mode in modes:
        force = rng.standard_normal((2, frequency.size)) * np.sqrt(mode.psd * rate * size / 4)
        moved = turn(frequency) * mode.response(frequency) * (force[0] + 1j * force[1])
        spectrum[:, 1:-1] += np.outer(mode.shape, moved)
    return np.fft.irfft(spectrum, size)[:, :n]


def sine(n: int, rate: float, frequency: float, amplitude: float, phase: float = 0.3) -> np.ndarray:
    """Make a line."""
    return amplitude * np.sin(2 * np.pi * frequency * np.arange(n) / rate + phase)


def make_log(
    signals: Mapping[str, np.ndarray],
    rate: float,
    *,
    velocity: np.ndarray | None = None,
    pieces: Sequence[tuple[int, int]] | None = None,
    metadata: Metadata = Metadata(),  # noqa: B008
) -> Log:
    """Make a log; the kind follows from the name, else acceleration."""
    n = len(next(iter(signals.values())))
    return Log(
        name="synthetic.h5",
        digest="0" * 64,
        metadata=metadata,
        sample_rate=rate,
        channels=tuple(
            Channel(name, _KINDS.get(name.split("_")[0], "acceleration"), np.array(values))
            for name, values in signals.items()
        ),
        reference_velocity=velocity,
        pieces=tuple(pieces) if pieces is not None else ((0, n),),
        refused=(),
    )


def acceleration_log(
    rng: np.random.Generator, modes: Sequence[Mode], seconds: float, rate: float, noise: float
) -> Log:
    """Make a log of accelerometers ``acc_0``, ``acc_1`` … without a set point."""
    values = accelerations(rng, modes, round(seconds * rate), rate, noise)
    return make_log({f"acc_{k}": row for k, row in enumerate(values)}, rate)


def make_stage(
    modes: Sequence[tuple[str, float, float]], *, search: float = 0.15, order_mm: float = 0.0
) -> Stage:
    """Make a description that looks for modes (name, Hz, damping ratio) and infers nothing."""
    description = Description(
        name="test",
        mode=tuple(ModeSpec(name, f, zeta, search=search) for name, f, zeta in modes),
        order=(Order("ball pass", order_mm),) if order_mm else (),
    )
    return Stage(description, None, "0" * 64)


@dataclass(frozen=True)
class Spectrum:
    """Periodogram of one channel: Hz, ordinates, duration of a segment in s, segments averaged."""

    frequency: np.ndarray
    periodogram: np.ndarray
    duration: float
    count: int = 1


def of_channel(spectrum: CrossSpectrum, index: int = 0) -> Spectrum:
    """Return the spectrum of one channel."""
    power = spectrum.powers()[:, index].copy()
    return Spectrum(spectrum.frequency, power, spectrum.duration, spectrum.count)


def periodogram(
    channel: Channel, rate: float, top: float = np.inf, *, ceiling: float = np.inf
) -> Spectrum:
    """Return the periodogram of all samples, of which no sinusoid is removed."""
    segment, anywhere = Segment(0, channel.values.size, 0.1), [ResonanceRange(0.0, np.inf, 0.0)]
    own = transform_segment([channel], segment, rate, top, ceiling=ceiling, resonances=anywhere)
    return of_channel(own)


def cut_band(spectrum: Spectrum, low: float, high: float) -> Spectrum:
    """Return the ordinates of a band."""
    own = (spectrum.frequency >= low) & (spectrum.frequency < high)
    return replace(
        spectrum, frequency=spectrum.frequency[own], periodogram=spectrum.periodogram[own]
    )


def mean_ordinate(spectrum: Spectrum, low: float, high: float) -> tuple[float, int]:
    """Return the mean ordinate of a band, and its degrees of freedom."""
    own = cut_band(spectrum, low, high).periodogram
    return float(own.mean()), 2 * spectrum.count * own.size


def deviations(modes: Modes, name: str, frequency: float, damping: float) -> np.ndarray:
    """Return the errors of ln f and ln ζ of a mode in standard deviations, shape (2,)."""
    i, n = modes.names.index(name), len(modes.names)
    std = np.sqrt(np.diag(modes.cov))[[i, n + i]]
    found = np.array([modes.ln_frequency[i], modes.ln_damping[i]])
    return (found - np.log([frequency, damping])) / std


# An archive of one small machine: two modes that depend on its only parameter.

ARCHIVE_MODES = (("roll", 62.0, 0.02, 0.25), ("pitch", 105.0, 0.02, 0.4))
MACHINE = "test-A"
_RATE, _SECONDS = 500.0, 20.0


def write_archive_stage(folder: Path, *, health: bool = True) -> Path:
    """Write the description of the archive's machine, with its map or only its modes."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["guide_preload,mode,frequency_hz"]
    for preload in np.geomspace(0.2, 2.0, 12).tolist():
        for name, frequency, _, slope in ARCHIVE_MODES:
            lines.append(f"{preload!r},{name},{frequency * preload**slope!r}")
    (folder / "small.map.csv").write_text("\n".join(lines) + "\n")
    text = ['name = "small"', "[match]", 'stage = "*-A"']
    for name, frequency, damping, _ in ARCHIVE_MODES:
        text += ["[[mode]]", f'name = "{name}"', f"frequency_hz = {frequency}"]
        text += [f"damping_ratio = {damping}"]
    path = folder / "small.toml"
    if not health:
        path.write_text("\n".join(text) + "\n")
        return path
    text += ["[[parameter]]", 'name = "guide_preload"', "limit = { below = 0.6 }"]
    text += ['prior = { kind = "lognormal", median = 1.0, sigma = 0.3 }']
    text += [
        'law = { kind = "linear", rate_per_km = { kind = "uniform", low = -5e-4, high = 2e-3 } }'
    ]
    text += ["[map]", 'file = "small.map.csv"', "[decision]", "max_risk = 0.05"]
    path.write_text("\n".join(text) + "\n")
    return path


def write_log(path: Path, preload: float, number: int, stage: str = MACHINE) -> Path:
    """Write one log of a machine at some preload as HDF5; the number seeds it and dates it."""
    rng = np.random.default_rng([20261121, number])
    modes = [Mode(f * preload**slope, damping) for _, f, damping, slope in ARCHIVE_MODES]
    values = accelerations(rng, modes, round(_SECONDS * _RATE), _RATE, 1.0)
    moment = datetime(2024, 1, 1, 8, tzinfo=UTC) + timedelta(days=10 * number)
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file["acc_feed_m_s2"] = values[0]
        file.attrs.update(
            stage=stage,
            recorded_at=moment.isoformat(),
            travel_km=f"{100 * number}",
            sample_rate_hz=f"{_RATE:g}",
        )
    return path


def write_archive(folder: Path, n_logs: int = 6) -> Path:
    """Write logs of a wearing machine with the truth beside them."""
    truth = ["file,guide_preload"]
    for number in range(n_logs):
        preload = 1 - 0.02 * number
        write_log(folder / f"log-{number:02d}.h5", preload, number)
        truth.append(f"log-{number:02d}.h5,{preload}")
    (folder / "truth.csv").write_text("\n".join(truth) + "\n")
    return folder
