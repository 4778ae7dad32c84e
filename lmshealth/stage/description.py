"""Stage descriptions: what to look for in a machine's logs and what it means.

The TOML file carries units in its keys; this module is the door where it is checked.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import date
from fnmatch import fnmatchcase
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from lmshealth._arrays import FloatArray
from lmshealth._toml import Keys, decode, place
from lmshealth.errors import BadStage
from lmshealth.io.log import Metadata
from lmshealth.stage.degradation_laws import AnyLaw, Unchanging
from lmshealth.stage.modal_map import ModalMap, read_map
from lmshealth.stage.priors import JointPrior, Prior

Positive = Annotated[float, Meta(gt=0, le=sys.float_info.max)]
Share = Annotated[float, Meta(gt=0, lt=1)]
# Names reach terminals, tables and pages: no control characters, nothing that turns the writing.
Name = Annotated[
    str,
    Meta(
        max_length=200,
        pattern="^[^\x00-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u206f]*\\Z",
    ),
]
CostRatio = Annotated[float, Meta(gt=1, le=sys.float_info.max)]

_MAX_RISK = 0.05
# Words of verdict.csv for the parameters of lms-x and lms-y, and those that name no parameter.
_WORDS = {"guide_preload": "preload", "mount_stiffness": "mount"}
_RESERVED = ("healthy", "both", "step", "not-enough-data")


class _Part(Struct, frozen=True, forbid_unknown_fields=True):
    """Part of a stage description: unknown keys are errors, so that typing slips are seen."""


class Match(_Part, frozen=True):
    """Which logs belong to this description."""

    stage: str = "*"


class ModeSpec(_Part, frozen=True):
    """A mode to look for."""

    name: Name
    frequency_hz: Positive
    damping_ratio: Share
    direction: Name = ""
    snr: Positive = 100.0
    search: Share = 0.15
    tracked: bool = True


class Watch(_Part, frozen=True):
    """A narrow band followed without physics."""

    low_hz: Positive
    high_hz: Positive


class Limit(_Part, frozen=True):
    """Where a health parameter ends its life."""

    below: Positive


class ParameterSpec(_Part, frozen=True):
    """A health parameter to infer.

    ``law`` may list several laws, of which the parameter follows one. ``verdict`` overrides the
    word by which verdict.csv names its loss.
    """

    name: Name
    prior: Prior
    baseline: Positive = 1.0
    unit: Name = ""
    limit: Limit | None = None
    law: AnyLaw | Annotated[tuple[AnyLaw, ...], Meta(min_length=1)] = Unchanging()
    verdict: Name = ""

    @property
    def laws(self) -> tuple[AnyLaw, ...]:
        """Laws that it may follow, at least one."""
        return self.law if isinstance(self.law, tuple) else (self.law,)

    @property
    def word(self) -> str:
        """Word of verdict.csv for a loss of this parameter: by default its name."""
        return self.verdict or _WORDS.get(self.name, self.name)


class MapSpec(_Part, frozen=True):
    """Where the modal map is, and how far its sensitivities are believed."""

    file: str
    model_std: Annotated[float, Meta(ge=0, lt=1)] = 0.05


class Order(_Part, frozen=True):
    """A line whose frequency is velocity over wavelength."""

    name: Name
    wavelength_mm: Positive


class Covariate(_Part, frozen=True):
    """A measured number that moves frequencies without wear.

    ``curvature_std`` is the prior standard deviation of what its square does, per unit squared.
    """

    name: Name
    reference: float
    prior_std: Positive
    curvature_std: Annotated[float, Meta(ge=0)] = 0.0


class Loop(_Part, frozen=True):
    """Rigid open loop of one tuning, descending powers of s in rad/s."""

    id: Name
    numerator: tuple[float, ...]
    denominator: tuple[float, ...]


class Baseline(_Part, frozen=True):
    """How many logs make the baseline where the manifest does not say."""

    logs: Annotated[int, Meta(ge=1)] = 5


class Decision(_Part, frozen=True):
    """What the service date is chosen for.

    Either for a risk, of having reached a limit, or for least costs: ``cost_ratio`` is the cost of
    a failure over that of a planned service.
    """

    max_risk: Share | None = None
    cost_ratio: CostRatio | None = None
    next_service: date | None = None

    @property
    def accepted(self) -> float | None:
        """The accepted risk, 5 % where nothing is said; None where costs decide."""
        if self.cost_ratio is not None:
            return None
        return _MAX_RISK if self.max_risk is None else self.max_risk


class Usage(_Part, frozen=True):
    """Travel per day, and how far ahead is looked."""

    km_per_day: Positive | None = None
    horizon_km: Positive = 20000.0


class Description(_Part, frozen=True):
    """The stage description as written."""

    name: Name
    mode: Annotated[tuple[ModeSpec, ...], Meta(min_length=1)]
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


@dataclass(frozen=True, slots=True)
class ScatterPrior:
    """How probable each value is that the scatter of logs about a life may have, in proportion.

    Weights of the values of the life's grid, in its order: of the random walk of ln
    frequency, of the factor on reported standard deviations, and of the deviation of ln health
    from its law.
    """

    walk: tuple[float, ...]
    noise_scale: tuple[float, ...]
    deviation: tuple[float, ...]


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
    scatter : ScatterPrior or None
        What is believed of scatter beforehand; None for what every stage is believed to have.
    """

    description: Description
    modal_map: ModalMap | None
    digest: str
    scatter: ScatterPrior | None = None

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
        return JointPrior(names, priors, self.modal_map.low, self.modal_map.high)

    def matches(self, metadata: Metadata) -> bool:
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
    folder = resources.files("lmshealth") / "stage" / "descriptions"
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

    Examples
    --------
    >>> import lmshealth
    >>> stage = lmshealth.load_stage("lms-y")
    >>> [(mode.name, mode.frequency_hz) for mode in stage.modes]
    [('roll', 126.4), ('pitch', 136.6), ('yaw', 155.0)]
    >>> [(parameter.name, parameter.limit.below) for parameter in stage.parameters]
    [('guide_preload', 0.6), ('mount_stiffness', 0.7)]

    By how much a fifth of the preload lost lowers roll and pitch, by its modal map:

    >>> import numpy as np
    >>> np.exp(stage.drift(np.log([[0.8, 1.0]]), ("roll", "pitch"))).round(3)
    array([[0.979, 0.97 ]])
    """
    if reference.endswith(".toml"):
        path = Path(reference)
    elif reference in shipped():
        path = Path(
            str(resources.files("lmshealth") / "stage" / "descriptions" / f"{reference}.toml")
        )
    else:
        raise BadStage(
            f"no stage description {reference!r}: give a path ending in .toml, "
            f"or one of {', '.join(shipped())}"
        )
    try:
        content = path.read_bytes()
        description = decode(content, Description)
    except OSError as error:
        raise BadStage(f"{path}: cannot read the stage description: {error.strerror}") from error
    except ValueError as error:
        raise BadStage(f"{path}: {error}") from error
    _refuse(path, content, _troubles(description))
    digest = hashlib.sha256(content)
    modal_map = None
    if description.map is not None and description.parameter:
        map_path = path.parent / description.map.file
        names = tuple(parameter.name for parameter in description.parameter)
        if not map_path.is_file():
            _refuse(path, content, [(("map", "file"), f"there is no file {map_path}")])
        modal_map = read_map(str(map_path), names)
        digest.update(map_path.read_bytes())
        _refuse(path, content, _map_troubles(description, modal_map))
    return Stage(description=description, modal_map=modal_map, digest=digest.hexdigest())


def _refuse(path: Path, content: bytes, troubles: Iterable[tuple[Keys, str]]) -> None:
    """Refuse a description for the first of its troubles, if it has any."""
    for keys, trouble in troubles:
        raise BadStage(f"{path}: {place(content, *keys)}: {trouble}")


def _troubles(description: Description) -> Iterator[tuple[Keys, str]]:
    """Say what is wrong between the parts of a description, and by which key."""
    bands: list[tuple[Keys, tuple[float, float]]] = [
        (("watch", k), (band.low_hz, band.high_hz)) for k, band in enumerate(description.watch)
    ]
    if description.health_band_hz is not None:
        bands.append((("health_band_hz",), description.health_band_hz))
    for keys, (low, high) in bands:
        if not low < high:
            yield keys, f"reaches from {low:g} to {high:g} Hz: needed low < high"
    for kind in ("mode", "parameter", "covariate"):
        names = [part.name for part in getattr(description, kind)]
        for k, name in enumerate(names):
            if name in names[:k]:
                yield (kind, k, "name"), f"[[{kind}]] names must be unique, twice: {name!r}"
    if description.parameter and description.map is None:
        yield ("parameter", 0), "[[parameter]] needs a [map] that says what it does to the modes"
    yield from _decision_troubles(description.decision)
    for k, parameter in enumerate(description.parameter):
        yield from _parameter_troubles(k, parameter)


def _parameter_troubles(k: int, parameter: ParameterSpec) -> Iterator[tuple[Keys, str]]:
    """Say what is wrong within a parameter, the k-th."""
    if parameter.word in _RESERVED or "+" in parameter.word:
        yield (
            ("parameter", k, "verdict" if parameter.verdict else "name"),
            f"{parameter.word!r} cannot name a lost parameter in verdict.csv: no "
            f"{', '.join(_RESERVED)} and no '+'; choose another name, or set verdict",
        )
    kinds = [law.kind for law in parameter.laws]
    for j, kind in enumerate(kinds):
        if kind in kinds[:j]:
            yield ("parameter", k, "law", j), f"{parameter.name}: two laws of the kind {kind!r}"
    if parameter.limit is not None and parameter.limit.below >= parameter.baseline:
        yield (
            ("parameter", k, "limit", "below"),
            f"{parameter.name}: limit {parameter.limit.below:g} must lie below the baseline "
            f"{parameter.baseline:g}",
        )


def _decision_troubles(decision: Decision) -> Iterator[tuple[Keys, str]]:
    """Say whether two things would choose the service date."""
    if decision.max_risk is not None and decision.cost_ratio is not None:
        yield (
            ("decision", "cost_ratio"),
            f"cost_ratio = {decision.cost_ratio:g} and max_risk = {decision.max_risk:g} would each "
            "choose a service date: give one of them",
        )


def _map_troubles(description: Description, modal_map: ModalMap) -> Iterator[tuple[Keys, str]]:
    """Say in what a description does not fit its map, and by which key."""
    ends = np.array([modal_map.low, modal_map.high])
    for k, parameter in enumerate(description.parameter):
        low, high = ends[:, k]
        if not low <= np.log(parameter.baseline) <= high:
            yield (
                ("parameter", k, "baseline"),
                f"the baseline {parameter.baseline:g} of {parameter.name} lies outside the modal "
                f"map, which reaches from {np.exp(low):.4g} to {np.exp(high):.4g}",
            )
        try:
            JointPrior((parameter.name,), (parameter.prior,), *ends[:, [k]])
        except BadStage as error:
            yield ("parameter", k, "prior"), str(error)
    if not any(mode.tracked and mode.name in modal_map.modes for mode in description.mode):
        yield (
            ("map", "file"),
            f"the map has modes {list(modal_map.modes)}, but none of them is a tracked [[mode]] "
            f"({[mode.name for mode in description.mode]})",
        )
