"""Channels and modes that an identification uses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lmshealth._private.arrays import ComplexArray, FloatArray
from lmshealth.errors import BadLog, BadStage
from lmshealth.io.channel_checks import independent
from lmshealth.io.log import Channel, Log, Refusal
from lmshealth.modal import constants
from lmshealth.stage.description import Stage


@dataclass(frozen=True, slots=True)
class Target:
    """A mode to search for."""

    name: str
    frequency: float  # start value in Hz
    damping_ratio: float  # start value
    search: float  # searched up to the factor 1 + search lower and higher
    narrow: bool = False  # whether it may be as narrow as a line, as one is described there
    # Described acceleration of channels by name, in any unit; empty where it is not described.
    shape: Mapping[str, float] = field(default_factory=dict, compare=False)
    # Root of the PSD of the modal force in each channel of the log, with the signs of the shape.
    amplitude: ComplexArray | None = field(default=None, compare=False)
    # Shifts of ln f over the states of wear on the modal map, ``(n_states,)``; equally many of all
    # targets of a description, none where the map does not have the mode.
    wear: FloatArray = field(default_factory=lambda: np.empty(0), compare=False)

    @property
    def bandwidth(self) -> float:
        """Half-power bandwidth in Hz."""
        return 2 * self.damping_ratio * self.frequency

    @property
    def is_light(self) -> bool:
        """Whether the mode may look like a spectral line."""
        return self.damping_ratio < constants.LIGHT

    def band(self, widths: float) -> tuple[float, float]:
        """Return the band in Hz within so many damping ratios of the frequency."""
        half = widths * self.damping_ratio
        return self.frequency * (1 - min(half, 0.5)), self.frequency * (1 + half)


def choose_channels(log: Log, names: Sequence[str] | None = None) -> tuple[Channel, ...]:
    """Return the displacement and acceleration channels, by default all, sorted by name.

    The order of the channels in a log has no effect on results, not even on rounding. `BadLog` if
    a name is no such channel, or none is left.
    """
    usable = tuple(c for c in log.channels if c.kind in ("displacement", "acceleration"))
    if names is not None:
        available = sorted(channel.name for channel in usable)
        unknown = sorted(set(names) - set(available))
        if unknown:
            raise BadLog(log.name, "channel", f"no usable channel {unknown}; available {available}")
        usable = tuple(channel for channel in usable if channel.name in names)
    if not usable:
        raise BadLog(log.name, "no-signal", "no delta_e or acc channel is left to analyse")
    return tuple(sorted(usable, key=lambda channel: channel.name))


def limit_channels(log: Log, names: Sequence[str] | None = None) -> Log:
    """Refuse (``surplus``) the channels beyond those that can be fitted together.

    The channels of the log that is returned are those of `choose_channels` with these names, or of
    these the ones that add most to each other.
    """
    used = choose_channels(log, names)
    if len(used) <= constants.MOST_CHANNELS:
        return replace(log, channels=used)
    order = independent([c.values for c in used], log.pieces, constants.MOST_CHANNELS)
    kept = tuple(used[k] for k in sorted(order))
    detail = f"{len(used)} channels, of which {len(kept)} are used; choose others with --channels"
    surplus = tuple(
        Refusal(log.name, "surplus", detail, channel=c.name) for c in used if c not in kept
    )
    return replace(log, channels=kept, refused=(*log.refused, *surplus))


def check_band(log: Log, band: tuple[float, float] | None) -> None:
    """Refuse (``sample-rate``) a band in Hz that begins above what a log can show."""
    top = constants.USABLE * log.sample_rate
    if band is not None and band[0] >= top:
        asked = f"the band is {band[0]:g} to {band[1]:g} Hz"
        found = f"a log of {log.sample_rate:g} Hz shows nothing above {top:.4g} Hz; {asked}"
        raise BadLog(log.name, "sample-rate", f"{found}: choose a lower one, or check the rate")


def choose_targets(stage: Stage, band: tuple[float, float] | None = None) -> tuple[Target, ...]:
    """Return the modes of a description in a band in Hz, ascending; `BadStage` if none is left."""
    low, high = band or (0.0, np.inf)
    wear = _wear(stage)
    targets = tuple(
        Target(
            mode.name, mode.frequency_hz, mode.damping_ratio, mode.search,
            shape=mode.shape, wear=wear.get(mode.name, np.empty(0)),
        )
        for mode in sorted(stage.modes, key=lambda mode: mode.frequency_hz)
        if low <= mode.frequency_hz <= high
    )  # fmt: skip
    if not targets:
        raise BadStage(f"{stage.name}: no [[mode]] lies between {low:g} and {high:g} Hz")
    return targets


def _wear(stage: Stage) -> dict[str, FloatArray]:
    """Return the shifts of ln f of each mode on the map, over states that searches hold."""
    if stage.modal_map is None or not (names := stage.informative):
        return {}
    low, high = stage.modal_map.low, stage.modal_map.high
    # States that fill the map evenly: multiples of powers of the root of x^(d + 1) = x + 1.
    d = low.size
    powers = np.roots([1, *[0] * (d - 1), -1, -1]).real.max() ** -np.arange(1.0, d + 1)
    points = low + (high - low) * ((0.5 + np.outer(np.arange(constants.WEAR_STATES), powers)) % 1)
    search = {mode.name: mode.search for mode in stage.modes}
    drift = stage.drift(points, names)
    held = (np.abs(drift) <= np.log1p([search[name] for name in names])).all(axis=1)
    return dict(zip(names, drift[held].T, strict=True))
