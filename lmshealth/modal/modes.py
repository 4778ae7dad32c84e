"""Modes of one log: estimates with their joint covariance.

Arrays are read-only; NaN marks a missing value. Units are SI.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lmshealth._private.arrays import FloatArray, freeze
from lmshealth._private.result import Result
from lmshealth.io.log import WARNINGS, Refusal
from lmshealth.modal.credibility import Credibility, widened
from lmshealth.signal.spectral_lines import Line

# Fields of `Modes` with one entry per mode.
_TUPLES = ("names", "sources", "channels", "flags", "credibility")
# Beginnings of names of measured channels; other channels are times and set points.
_MEASURED = ("delta_e", "acc", "current")
_ARRAYS = ("ln_frequency", "ln_damping", "snr", "dispersion", "excitation")


class Rejection(NamedTuple):
    """Reason code and detail for which a mode is not published."""

    reason: str
    detail: str
    frequency: float | None = None  # in Hz, at which it was found or sought


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Modes(Result):
    """Modal estimates of one log with their joint covariance; arrays of shape ``(n_modes,)``."""

    names: tuple[str, ...]  # unique per source; empty where there is none
    sources: tuple[str, ...]  # ``acc``, ``delta_e``, ``frf`` or ``joint`` per mode
    channels: tuple[str, ...]  # that show each mode most clearly
    ln_frequency: FloatArray  # natural logarithm of the natural frequency in Hz
    ln_damping: FloatArray  # natural logarithm of the damping ratio
    cov: FloatArray  # of ``[ln_frequency, ln_damping]``, ``(2 n_modes, 2 n_modes)``
    snr: FloatArray  # modal signal-to-noise ratio S / (4 ζ² S_e)
    # Variance of the residual near each mode over that of noise: about one where the model fits;
    # NaN where it was not measured.
    dispersion: FloatArray
    # Of each mode, separated by blanks: ``resolution-limited`` (few Fourier frequencies in the
    # half-power bandwidth), ``at-bound`` (frequency or damping at the end of the search),
    # ``loose-fit`` (dispersion above 1.5), ``cluster`` (represents two close modes), ``unsteady``
    # (the intensity of its excitation varies), ``coloured`` (the spectrum of its excitation is not
    # flat), ``doubtful-name`` (may be another mode), and those of `WARNINGS` about its channels.
    flags: tuple[str, ...]
    shape_channels: tuple[str, ...]  # of the shapes; empty where shapes were not identified
    # Acceleration of each channel in each mode (of a following error its second derivative),
    # ``(n_modes, n_shape_channels)``; unit Euclidean norm, largest component positive, NaN in
    # channels that do not show the mode.
    shapes: FloatArray
    lines: tuple[Line, ...]  # excluded from the likelihood
    refused: tuple[Refusal, ...]  # modes that were sought and are not published, with the reason
    # Root mean square acceleration of the mode in m/s², over time, as a norm over the channels;
    # NaN (the default) where it was not measured.
    excitation: FloatArray = None  # type: ignore[assignment]
    credibility: tuple[Credibility, ...] = ()  # factors of ``cov`` per mode, by default unknown

    def __post_init__(self) -> None:
        n = len(self.names)
        if self.excitation is None:
            object.__setattr__(self, "excitation", np.full(n, np.nan))
        if not self.credibility:
            object.__setattr__(self, "credibility", (Credibility(),) * n)
        named = [pair for pair in zip(self.names, self.sources, strict=True) if pair[0]]
        if len(set(named)) != len(named):
            raise ValueError(f"mode names are not unique per source: {self.names}")
        shapes = "shapes", n, len(self.shape_channels)
        freeze(self, (" ".join(_ARRAYS), n), ("cov", 2 * n, 2 * n), shapes)

    def title(self) -> str:
        """Return the number of modes, lines and refusals."""
        n, lines, refused = len(self.names), len(self.lines), len(self.refused)
        return f"Modes of one log: {n}; {lines} spectral lines, {refused} refused"

    def to_columns(self) -> dict[str, Any]:
        """Return the columns of ``modes.csv`` that a log has by itself, one row per mode."""
        return {
            "mode": list(self.names),
            "source": list(self.sources),
            "channel": list(self.channels),
            "frequency_hz": self.frequency,
            "frequency_std_hz": self.frequency_std,
            "damping_ratio": self.damping_ratio,
            "damping_ratio_std": self.damping_ratio_std,
            "correlation_f_zeta": self.correlation,
            "snr": self.snr,
            "dispersion": self.dispersion,
            "std_factor": np.array([one.total for one in self.credibility]),
            "excitation_mm_s2": self.excitation / 1e-3,
            "flags": list(self.flags),
        }

    def digest_columns(self) -> dict[str, Any]:
        """Return the columns without those of the fit."""
        left_out = ("source", "correlation_f_zeta", "dispersion", "std_factor", "excitation_mm_s2")
        return {k: v for k, v in self.to_columns().items() if k not in left_out}

    @property
    def estimate(self) -> FloatArray:
        """``[ln_frequency, ln_damping]``, shape ``(2 n_modes,)``."""
        return np.concatenate([self.ln_frequency, self.ln_damping])

    @property
    def frequency(self) -> FloatArray:
        """Natural frequency in Hz, shape ``(n_modes,)``."""
        return np.exp(self.ln_frequency)

    @property
    def frequency_std(self) -> FloatArray:
        """Standard deviation of the natural frequency in Hz, shape ``(n_modes,)``."""
        n = len(self.names)
        return self.frequency * np.sqrt(np.diag(self.cov)[:n])

    @property
    def damping_ratio(self) -> FloatArray:
        """Damping ratio, shape ``(n_modes,)``."""
        return np.exp(self.ln_damping)

    @property
    def damping_ratio_std(self) -> FloatArray:
        """Standard deviation of the damping ratio, shape ``(n_modes,)``."""
        n = len(self.names)
        return self.damping_ratio * np.sqrt(np.diag(self.cov)[n:])

    @property
    def correlation(self) -> FloatArray:
        """Correlation between frequency and damping ratio of each mode, shape ``(n_modes,)``."""
        n = len(self.names)
        std = np.sqrt(np.diag(self.cov))
        index = np.arange(n)
        return np.asarray(self.cov[index, index + n] / (std[:n] * std[n:]))

    def select(self, index: Sequence[int]) -> Self:
        """Return some modes, in the order of ``index``; the others are marginalised."""
        both = paired(index, len(self.names))
        rows = both[: len(index)]
        own: dict[str, Any] = {name: getattr(self, name)[rows] for name in (*_ARRAYS, "shapes")}
        for name in _TUPLES:
            own[name] = tuple(getattr(self, name)[i] for i in rows)
        return replace(self, **own, cov=self.cov[np.ix_(both, both)])

    def widened(self, cause: str, cov: FloatArray) -> Self:
        """Replace the covariance, and add what that does to standard deviations to the factors."""
        return replace(self, cov=cov, credibility=widened(self.credibility, cause, self.cov, cov))


def paired(index: ArrayLike, n_modes: int) -> NDArray[np.intp]:
    """Return the places of ln f, then of ln ζ, of some modes in ``[ln f, ln ζ]``."""
    rows = np.asarray(index, dtype=np.intp)
    return np.concatenate([rows, rows + n_modes])


def estimates_only(
    estimate: FloatArray,
    cov: FloatArray,
    snr: FloatArray,
    source: str,
    channels: Sequence[str],
    credibility: tuple[Credibility, ...] = (),
) -> Modes:
    """Return unnamed modes of one source without shapes, dispersion, lines or refusals.

    ``estimate`` is ``[ln f, ln ζ]``, shape ``(2 n_modes,)``, ``cov`` its covariance with the
    factors of ``credibility``.
    """
    n = len(channels)
    return Modes(
        names=("",) * n,
        sources=(source,) * n,
        channels=tuple(channels),
        ln_frequency=estimate[:n],
        ln_damping=estimate[n:],
        cov=cov,
        snr=snr,
        dispersion=np.full(n, np.nan),
        flags=("",) * n,
        shape_channels=(),
        shapes=np.empty((n, 0)),
        lines=(),
        refused=(),
        credibility=credibility,
    )


def merge(
    parts: Sequence[Modes],
    lines: Sequence[Line],
    refused: Sequence[Refusal],
    shape_channels: tuple[str, ...] = (),
) -> Modes:
    """Join independent estimates, ascending in frequency; the joint covariance has their blocks.

    Lines and refusals of the parts are replaced; warnings among these flag the modes that they
    concern. ``shape_channels`` holds those of all parts.
    """
    n, first = sum(len(part.names) for part in parts), 0
    cov, shapes = np.zeros((2 * n, 2 * n)), np.full((n, len(shape_channels)), np.nan)
    for part in parts:
        rows = np.arange(first, first + len(part.names))
        both = paired(rows, n)
        cov[np.ix_(both, both)] = part.cov
        columns = [shape_channels.index(name) for name in part.shape_channels]
        shapes[rows[:, None], columns] = part.shapes
        first += rows.size

    joined: dict[str, Any] = {}
    for name in _TUPLES:
        joined[name] = tuple(chain.from_iterable(getattr(part, name) for part in parts))
    for name in _ARRAYS:
        joined[name] = np.concatenate([np.empty(0), *(getattr(part, name) for part in parts)])
    modes = Modes(
        **joined,
        cov=cov,
        shape_channels=shape_channels,
        shapes=shapes,
        lines=tuple(lines),
        refused=tuple(refused),
    )
    modes = modes.select(np.argsort(modes.ln_frequency, kind="stable").tolist())
    return replace(modes, flags=tuple(_flagged(modes, i) for i in range(n)))


def _flagged(modes: Modes, i: int) -> str:
    """Return the flags of a mode with those of warnings about the channels that show it."""
    shown = {name for name, x in zip(modes.shape_channels, modes.shapes[i], strict=True) if x == x}
    own = dict.fromkeys(modes.flags[i].split())
    for row in modes.refused:
        flag = WARNINGS.get(row.reason, "") if row.channel else ""
        of_log = not row.channel.startswith(_MEASURED)
        if flag and (of_log or row.channel in {*shown, modes.channels[i]}):
            own[flag] = None
    return " ".join(own)


def numbered(modes: Modes) -> Modes:
    """Name modes ``mode_1``, ``mode_2``, … in their order."""
    return replace(modes, names=tuple(f"mode_{k}" for k in range(1, len(modes.names) + 1)))
