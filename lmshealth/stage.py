"""Stage descriptions: what to look for in a machine's logs and what it means.

The TOML file carries units in its keys; this module is the door where it is checked.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from datetime import date
from fnmatch import fnmatchcase
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct

from lmshealth.arrays import FloatArray
from lmshealth.errors import BadStage
from lmshealth.laws import AnyLaw, Unchanging
from lmshealth.logs import Metadata
from lmshealth.modalmap import ModalMap, read_map
from lmshealth.priors import JointPrior, Prior

Positive = Annotated[float, Meta(gt=0)]
Share = Annotated[float, Meta(gt=0, lt=1)]


def _check_band(key: str, low: float, high: float) -> None:
    if not low < high:
        raise ValueError(f"{key} reaches from {low:g} to {high:g} Hz: needed low < high")


class _Part(Struct, frozen=True, forbid_unknown_fields=True):
    """Part of a stage description: unknown keys are errors, so that typing slips are seen."""


class Match(_Part, frozen=True):
    """Which logs belong to this description."""

    stage: str = "*"


class ModeSpec(_Part, frozen=True):
    """A mode to look for."""

    name: str
    frequency_hz: Positive
    damping_ratio: Share
    direction: str = ""
    snr: Positive = 100.0
    search: Share = 0.15
    tracked: bool = True


class Watch(_Part, frozen=True):
    """A narrow band followed without physics."""

    low_hz: Positive
    high_hz: Positive

    def __post_init__(self) -> None:
        _check_band("[[watch]]", self.low_hz, self.high_hz)


class Limit(_Part, frozen=True):
    """Where a health parameter ends its life."""

    below: Positive


class ParameterSpec(_Part, frozen=True):
    """A health parameter to infer.

    ``verdict`` is the word of verdict.csv that its loss is told by; by default ``preload`` for a
    parameter with preload in its name and ``mount`` for any other.
    """

    name: str
    prior: Prior
    baseline: Positive = 1.0
    unit: str = ""
    limit: Limit | None = None
    law: AnyLaw = Unchanging()
    verdict: Literal["preload", "mount", ""] = ""

    @property
    def word(self) -> Literal["preload", "mount"]:
        """The word of verdict.csv that stands for a loss of this parameter."""
        return self.verdict or ("preload" if "preload" in self.name else "mount")


class MapSpec(_Part, frozen=True):
    """Where the modal map is, and how far its sensitivities are believed."""

    file: str
    model_std: Annotated[float, Meta(ge=0, lt=1)] = 0.05


class Order(_Part, frozen=True):
    """A line whose frequency is velocity over wavelength."""

    name: str
    wavelength_mm: Positive


class Covariate(_Part, frozen=True):
    """A measured number that moves frequencies without wear.

    ``curvature_std`` is the prior standard deviation of what its square does, per unit squared.
    """

    name: str
    reference: float
    prior_std: Positive
    curvature_std: Annotated[float, Meta(ge=0)] = 0.0


class Loop(_Part, frozen=True):
    """Rigid open loop of one tuning, descending powers of s in rad/s."""

    id: str
    numerator: tuple[float, ...]
    denominator: tuple[float, ...]


class Baseline(_Part, frozen=True):
    """How many logs make the baseline where the manifest does not say."""

    logs: Annotated[int, Meta(ge=1)] = 5


class Decision(_Part, frozen=True):
    """What the service date is chosen for."""

    max_risk: Share = 0.05
    next_service: date | None = None


class Usage(_Part, frozen=True):
    """Travel per day, and how far ahead is looked."""

    km_per_day: Positive | None = None
    horizon_km: Positive = 20000.0


class Description(_Part, frozen=True):
    """The stage description as written."""

    name: str
    mode: tuple[ModeSpec, ...]
    source: str = ""
    match: Match = Match()
    health_band_hz: tuple[Positive, Positive] | None = None
    watch: tuple[Watch, ...] = ()
    parameter: tuple[ParameterSpec, ...] = ()
    map: MapSpec | None = None
    order: tuple[Order, ...] = ()
    covariate: tuple[Covariate, ...] = ()
    loop: tuple[Loop, ...] = ()
    baseline: Baseline = Baseline()
    decision: Decision = Decision()
    usage: Usage = Usage()

    def __post_init__(self) -> None:
        if self.health_band_hz is not None:
            _check_band("health_band_hz", *self.health_band_hz)
        for kind in ("mode", "parameter", "covariate"):
            names = [part.name for part in getattr(self, kind)]
            twice = {name for name in names if names.count(name) > 1}
            if twice:
                raise ValueError(f"[[{kind}]] names must be unique, twice: {sorted(twice)}")
        if self.parameter and self.map is None:
            raise ValueError("[[parameter]] needs a [map] that says what it does to the modes")


@dataclass(frozen=True)
class Stage:
    """A checked stage description with its modal map.

    Attributes
    ----------
    description : Description
        As written.
    modal_map : ModalMap or None
        Surrogate of the map; None when there is no health parameter.
    digest : str
        SHA-256 over description and map: results carry it.
    """

    description: Description
    modal_map: ModalMap | None
    digest: str

    @property
    def name(self) -> str:
        """Name of the description."""
        return self.description.name

    @property
    def modes(self) -> tuple[ModeSpec, ...]:
        """Modes to look for."""
        return self.description.mode

    @property
    def parameters(self) -> tuple[ParameterSpec, ...]:
        """Health parameters."""
        return self.description.parameter

    @cached_property
    def informative(self) -> tuple[str, ...]:
        """Tracked modes that the map knows: the ones health is inferred from."""
        known = () if self.modal_map is None else self.modal_map.modes
        return tuple(mode.name for mode in self.modes if mode.tracked and mode.name in known)

    @cached_property
    def baseline_point(self) -> FloatArray:
        """Ln of the parameters at baseline, shape ``(n_parameters,)``."""
        return np.log([parameter.baseline for parameter in self.parameters])

    @cached_property
    def prior(self) -> JointPrior:
        """Priors of the health parameters, cut where the map ends."""
        if self.modal_map is None:
            raise BadStage(f"{self.name}: no [[parameter]] with a [map]")
        names = tuple(parameter.name for parameter in self.parameters)
        priors = tuple(parameter.prior for parameter in self.parameters)
        try:
            return JointPrior(names, priors, self.modal_map.low, self.modal_map.high)
        except BadStage as error:
            raise BadStage(f"{self.name}: {error}") from error

    def takes(self, metadata: Metadata) -> bool:
        """Tell whether a log belongs to this description."""
        if metadata.description is not None:
            return metadata.description in (self.name, f"{self.name}.toml")
        return metadata.stage is not None and fnmatchcase(
            metadata.stage, self.description.match.stage
        )

    def drift(self, x: FloatArray, modes: tuple[str, ...]) -> FloatArray:
        """Predict the drift of modes from health parameters.

        Parameters
        ----------
        x : ndarray
            ln parameters inside the map, shape ``(n_points, n_parameters)``.
        modes : tuple of str
            Which modes.

        Returns
        -------
        ndarray
            ln frequency minus its value at baseline, shape ``(n_points, n_modes)``.
        """
        if self.modal_map is None:
            raise BadStage(f"{self.name}: no [map], so nothing links health to frequencies")
        columns = [self.modal_map.modes.index(name) for name in modes]
        return (self.modal_map.ln_frequency(x) - self._ln_frequency_at_baseline)[:, columns]

    @cached_property
    def _ln_frequency_at_baseline(self) -> FloatArray:
        assert self.modal_map is not None  # drift() has checked
        return self.modal_map.ln_frequency(self.baseline_point[None])


def shipped() -> tuple[str, ...]:
    """Names of the descriptions that come with the package."""
    folder = resources.files("lmshealth") / "stages"
    names = (item.name for item in folder.iterdir())
    return tuple(sorted(name[:-5] for name in names if name.endswith(".toml")))


def load_stage(reference: str) -> Stage:
    """Load and check a stage description.

    Parameters
    ----------
    reference : str
        A path ending in ``.toml``, or the name of a shipped description.

    Raises
    ------
    BadStage
        If it cannot be found or read, breaks the schema, or its map does not fit.
    """
    if reference.endswith(".toml"):
        path = Path(reference)
    elif reference in shipped():
        path = Path(str(resources.files("lmshealth") / "stages" / f"{reference}.toml"))
    else:
        raise BadStage(
            f"no stage description {reference!r}: give a path ending in .toml, "
            f"or one of {', '.join(shipped())}"
        )
    try:
        text = path.read_bytes()
        description = msgspec.toml.decode(text, type=Description)
    except OSError as error:
        raise BadStage(f"{path}: cannot read the stage description: {error.strerror}") from error
    except (msgspec.MsgspecError, ValueError) as error:
        raise BadStage(f"{path}: {error}") from error
    digest = hashlib.sha256(text)
    modal_map = None
    if description.map is not None and description.parameter:
        map_path = path.parent / description.map.file
        names = tuple(parameter.name for parameter in description.parameter)
        modal_map = read_map(str(map_path), names)
        digest.update(map_path.read_bytes())
        _check_map(path, description, modal_map)
    return Stage(description=description, modal_map=modal_map, digest=digest.hexdigest())


def _check_map(path: Path, description: Description, modal_map: ModalMap) -> None:
    base = np.log([parameter.baseline for parameter in description.parameter])
    if not modal_map.inside(base[None]).all():
        raise BadStage(f"{path}: the baseline of the parameters lies outside the modal map")
    known = [
        mode.name for mode in description.mode if mode.tracked and mode.name in modal_map.modes
    ]
    if not known:
        raise BadStage(
            f"{path}: the map has modes {list(modal_map.modes)}, but none of them is a tracked "
            f"[[mode]] ({[mode.name for mode in description.mode]})"
        )
    for parameter in description.parameter:
        if parameter.limit is not None and parameter.limit.below >= parameter.baseline:
            raise BadStage(
                f"{path}: {parameter.name}: limit {parameter.limit.below} must lie below the "
                f"baseline {parameter.baseline}"
            )
