"""Stage descriptions: schema, loading and checks of the TOML file (README.md is its reference)."""

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from difflib import get_close_matches
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from msgspec import Meta, Struct, structs

from lmshealth._private.arrays import FloatArray
from lmshealth._private.files import escapes, read_table
from lmshealth._private.toml import decode, within
from lmshealth.errors import BadStage
from lmshealth.io.constants import FIRST_MOMENT, LAST_MOMENT, LONGEST_NAME
from lmshealth.io.log import INVISIBLE, MOMENTS, Metadata
from lmshealth.io.refusal import repeated
from lmshealth.stage import constants
from lmshealth.stage.degradation_laws import AnyLaw, Free, Unchanging
from lmshealth.stage.modal_map import ModalMap, read_map
from lmshealth.stage.priors import JointPrior, Prior

_SHIPPED = Path(__file__).parent / "descriptions"
_LEAST_MAP_ERROR = 1e-4  # far below what any estimate of a drift shows
_ONE_SIGMA = (0.1587, 0.8413)  # levels of a normal distribution one standard deviation about
Value = Annotated[float, within(*constants.VALUE)]
Frequency = Annotated[float, within(*constants.FREQUENCY_HZ)]
Component = Annotated[float, within(-constants.COMPONENT, constants.COMPONENT)]
Place = Annotated[float, within(-constants.PLACE_M, constants.PLACE_M)]
# Names appear on terminals, in tables and pages.
Name = Annotated[str, Meta(max_length=LONGEST_NAME, pattern=f"^[^{INVISIBLE}]*\\Z")]


class _Part(Struct, frozen=True, forbid_unknown_fields=True):
    """A table of a stage description; unknown keys are errors."""


class Match(_Part, frozen=True):
    """Pattern of the machines that the description applies to."""

    stage: str = "*"


class ModeSpec(_Part, frozen=True):
    """A mode to identify; ``direction`` is accepted, not used.

    ``shape`` holds the acceleration of channels by name, in any unit.
    """

    name: Annotated[Name, Meta(examples=["pitch"])]
    frequency_hz: Annotated[Frequency, Meta(examples=[136.4])]
    damping_ratio: Annotated[float, within(*constants.DAMPING_RATIO, 0.015)]
    direction: Name = ""
    snr: Annotated[float, within(*constants.SNR)] = 100.0
    search: Annotated[float, within(*constants.SEARCH)] = 0.15
    tracked: bool = True
    shape: dict[str, Component] = {}

    def __post_init__(self) -> None:
        if self.shape:
            _expect_length(f"the shape of {self.name}", self.shape.values())

    def __hash__(self) -> int:
        return hash((self.name, self.frequency_hz))

    @property
    def searched(self) -> tuple[float, float]:
        """Band in Hz in which the mode is searched."""
        return self.frequency_hz / (1 + self.search), self.frequency_hz * (1 + self.search)


def search_offset(
    frequency: FloatArray | float, described: FloatArray | float, search: FloatArray | float
) -> FloatArray:
    """Return the shift of ln f from the described frequency as a share of the search.

    From -1 to 1 a resonance lies in the search: at most by the factor 1 + search lower or higher.
    Frequencies are in Hz; arguments are broadcast.
    """
    return np.asarray(np.log(frequency / described) / np.log1p(search))


def _expect_length(name: str, components: Iterable[float]) -> None:
    if max(map(abs, components)) < constants.LEAST_COMPONENT:
        needed = f"needed a component of at least {constants.LEAST_COMPONENT:g}"
        raise ValueError(f"{name} has no length; {needed}")


def _expect_ascending(name: str, low: float, high: float) -> None:
    if not low < high:
        raise ValueError(f"{name} reaches from {low:g} to {high:g} Hz: needed low < high")


class WatchedBand(_Part, frozen=True):
    """A narrow band of which only the acceleration level is reported."""

    low_hz: Annotated[Frequency, Meta(examples=[1950])]
    high_hz: Annotated[Frequency, Meta(examples=[2050])]

    def __post_init__(self) -> None:
        _expect_ascending("the band", self.low_hz, self.high_hz)


class Limit(_Part, frozen=True):
    """Value below which a health parameter is worn out."""

    below: Annotated[Value, Meta(examples=[0.6])]


class ParameterSpec(_Part, frozen=True):
    """A health parameter to infer.

    ``law`` may list several laws, of which the parameter follows one; without it the parameter
    keeps its value or changes without a law, by as much as its prior allows. ``verdict`` overrides
    the word by which verdict.csv names its loss.
    """

    name: Annotated[Name, Meta(examples=["guide_preload"])]
    prior: Prior
    baseline: Value = 1.0
    unit: Name = ""
    limit: Annotated[Limit | None, Meta(examples=[{"below": 0.6}])] = None
    law: AnyLaw | Annotated[tuple[AnyLaw, ...], Meta(min_length=1)] | None = None
    verdict: Name = ""

    def __post_init__(self) -> None:
        if self.word in constants.RESERVED_WORDS or "+" in self.word:
            reserved = f"'+' or {', '.join(constants.RESERVED_WORDS)}"
            raise ValueError(
                f"{self.word!r} cannot name a parameter in verdict.csv, nor can anything with "
                f"{reserved}: choose another name, or set verdict"
            )
        if twice := repeated(law.kind for law in self._stated):
            raise ValueError(f"{self.name}: two laws of the kind {twice[0]!r}")
        if self.limit is not None and self.limit.below >= self.baseline:
            wrong = f"limit {self.limit.below:g} must lie below the baseline {self.baseline:g}"
            raise ValueError(f"{self.name}: {wrong}")

    @property
    def laws(self) -> tuple[AnyLaw, ...]:
        """Candidate laws, at least one."""
        if self.law is not None:
            return self._stated
        # Of the prior above 0, as parameters are.
        below = self.prior.probability(np.zeros(()))
        low, high = self.prior.quantile(below + (1 - below) * np.array(_ONE_SIGMA)).tolist()
        return Unchanging(), Free(std=float(np.log(high / low) / 2))

    @property
    def _stated(self) -> tuple[AnyLaw, ...]:
        if self.law is None:
            return ()
        return self.law if isinstance(self.law, tuple) else (self.law,)

    @property
    def word(self) -> str:
        """Word of verdict.csv for a loss of this parameter: by default its name."""
        return self.verdict or constants.VERDICT_WORDS.get(self.name, self.name)


class MapSpec(_Part, frozen=True):
    """File of the modal map and relative standard deviations of its sensitivities."""

    file: Annotated[Name, Meta(examples=["my-stage.map.csv"])]
    # Of each parameter and mode, and of each parameter what all modes have in common.
    model_std: Annotated[float, within(0, 1)] = 0.05
    common_std: Annotated[float, within(0, 1)] = 0.0


class Order(_Part, frozen=True):
    """A spectral line at velocity / wavelength."""

    name: Annotated[Name, Meta(examples=["ball pass"])]
    wavelength_mm: Annotated[float, within(*constants.WAVELENGTH_MM, 4.0)]


class ChannelSpec(_Part, frozen=True):
    """Place of a sensor in m and the direction that it measures, for drawings of mode shapes."""

    name: Annotated[Name, Meta(examples=["acc_pitch"])]
    position_m: Annotated[tuple[Place, Place, Place], Meta(examples=[[0.1, 0.0, 0.25]])]
    # Of any length but 0.
    direction: Annotated[tuple[Component, Component, Component], Meta(examples=[[0, 0, 1]])]

    def __post_init__(self) -> None:
        _expect_length(f"the direction of {self.name}", self.direction)


class Covariate(_Part, frozen=True):
    """A measured quantity that shifts ln f without wear.

    ``prior_std`` is the prior standard deviation of its linear coefficient per unit,
    ``curvature_std`` that of its quadratic coefficient per unit squared.
    """

    name: Annotated[Name, Meta(examples=["temperature_c"])]
    reference: Annotated[float, within(-constants.REFERENCE, constants.REFERENCE, 21.0)]
    prior_std: Annotated[float, within(*constants.EFFECT, 0.001)]
    curvature_std: Annotated[float, within(0, constants.EFFECT[1])] = 0.0


class Baseline(_Part, frozen=True):
    """Least number of logs since the baseline for a verdict, and its size in `stage` and `plan`."""

    logs: Annotated[int, within(1, 100 * constants.MOST_LOGS)] = 5


class Decision(_Part, frozen=True):
    """Criterion of the service date: accepted risk of reaching a limit, or least costs.

    ``cost_ratio`` is the cost of a failure over that of a planned service.
    """

    max_risk: Annotated[float, within(*constants.RISK)] | None = None
    cost_ratio: Annotated[float, Meta(gt=1, le=constants.MOST_COST_RATIO)] | None = None
    next_service: date | None = None

    def __post_init__(self) -> None:
        if self.max_risk is not None and self.cost_ratio is not None:
            both = f"cost_ratio = {self.cost_ratio:g} and max_risk = {self.max_risk:g}"
            raise ValueError(f"{both} each choose a service date: state one of them")
        first, end = FIRST_MOMENT.date(), LAST_MOMENT.date()
        if self.next_service is not None and not first <= self.next_service < end:
            raise ValueError(f"next_service is {self.next_service}, needed a day {MOMENTS}")

    @property
    def accepted(self) -> float | None:
        """Accepted risk, `constants.MAX_RISK` by default; None where costs decide."""
        if self.cost_ratio is not None:
            return None
        return constants.MAX_RISK if self.max_risk is None else self.max_risk


class Usage(_Part, frozen=True):
    """Travel per day and horizon of the prognosis."""

    km_per_day: Annotated[float, within(*constants.KM_PER_DAY)] | None = None
    horizon_km: Annotated[float, within(*constants.HORIZON_KM)] = 20000.0


class LifeSpec(_Part, frozen=True):
    """What the posterior of a life allows for beside the laws of the parameters, and its clock.

    ``free`` is the share of a parameter's laws that a change without a law has, ``lone_mode`` the
    prior probability that a mode moves alone, by a cause that the map does not have, and
    ``common_wander`` that all modes wander together. The clock ``days`` takes the time for travel,
    at ``[usage] km_per_day``.
    """

    free: Annotated[float, within(0, 0.9)] = 0.05
    lone_mode: Annotated[float, within(0, 0.2)] = 0.03
    common_wander: Annotated[float, within(0, 0.5)] = 0.1
    clock: Literal["odometer", "days"] = "odometer"


class Description(_Part, frozen=True):
    """The stage description as written; ``source`` and ``loop`` are accepted, not used."""

    name: Annotated[Name, Meta(examples=["my stage"])]
    mode: Annotated[tuple[ModeSpec, ...], Meta(min_length=1)]
    source: str = ""
    match: Match = Match()
    health_band_hz: tuple[Frequency, Frequency] | None = None
    watch: tuple[WatchedBand, ...] = ()
    parameter: tuple[ParameterSpec, ...] = ()
    map: MapSpec | None = None
    order: tuple[Order, ...] = ()
    channel: tuple[ChannelSpec, ...] = ()
    covariate: tuple[Covariate, ...] = ()
    loop: tuple[dict[str, object], ...] = ()
    baseline: Baseline = Baseline()
    decision: Decision = Decision()
    usage: Usage = Usage()
    life: LifeSpec = LifeSpec()

    def __post_init__(self) -> None:
        if self.health_band_hz is not None:
            _expect_ascending("health_band_hz", *self.health_band_hz)
        for kind in ("mode", "parameter", "covariate", "channel"):
            if twice := repeated(part.name for part in getattr(self, kind)):
                raise ValueError(f"[[{kind}]] names must be unique, twice: {twice[0]!r}")
        if self.parameter and self.map is None:
            raise ValueError("[[parameter]] needs a [map] of its effect on the modes")
        if self.map is not None and not self.parameter:
            raise ValueError("[map] needs a [[parameter]] of which it states the effect")
        if self.life.clock == "days" and self.usage.km_per_day is None:
            raise ValueError(
                'clock = "days" takes the time for travel and needs [usage] km_per_day; with 1 '
                "all lengths in km of the laws count days"
            )


@dataclass(frozen=True, slots=True)
class ScatterPrior:
    """Prior weights of the grid of scatter of a life, in its order.

    Of the random walk of ln f, of the factor on reported standard deviations, and of the deviation
    of ln health from its law.
    """

    walk: tuple[float, ...]
    noise_scale: tuple[float, ...]
    deviation: tuple[float, ...]


@dataclass(frozen=True, repr=False)
class Stage:
    """A checked stage description with its modal map, None when there is no health parameter.

    `digest` is the SHA-256 over both; `scatter` the prior of the scatter of logs, None for the
    common one.
    """

    description: Description
    modal_map: ModalMap | None
    digest: str
    scatter: ScatterPrior | None = None

    def __repr__(self) -> str:
        modes = ", ".join(f"{mode.name} {mode.frequency_hz:g} Hz" for mode in self.modes)
        parameters = ", ".join(parameter.name for parameter in self.parameters)
        return f"Stage {self.name}: modes {modes}; parameters {parameters or 'none'}"

    @property
    def name(self) -> str:
        """Name of the description."""
        return self.description.name

    @property
    def modes(self) -> tuple[ModeSpec, ...]:
        """Described modes."""
        return self.description.mode

    @property
    def parameters(self) -> tuple[ParameterSpec, ...]:
        """Health parameters."""
        return self.description.parameter

    @cached_property
    def informative(self) -> tuple[str, ...]:
        """Tracked modes on the map, from which health is inferred."""
        known = () if self.modal_map is None else self.modal_map.modes
        return tuple(mode.name for mode in self.modes if mode.tracked and mode.name in known)

    @cached_property
    def baseline_point(self) -> FloatArray:
        """Ln parameters at the baseline, shape ``(n_parameters,)``."""
        return np.log([parameter.baseline for parameter in self.parameters])

    @cached_property
    def prior(self) -> JointPrior:
        """Priors of the health parameters, truncated at the ends of the map."""
        if self.modal_map is None:
            raise BadStage(f"{self.name}: no [[parameter]] with a [map]")
        names = tuple(parameter.name for parameter in self.parameters)
        priors = tuple(parameter.prior for parameter in self.parameters)
        return JointPrior(names, priors, self.modal_map.low, self.modal_map.high)

    def map_cov(self, n_modes: int) -> FloatArray:
        """Return the covariance of the map's declared errors, shape ``(n_modes, n_modes)``.

        It is model_std² I + common_std² 1 1ᵀ, of the relative errors of the sensitivities of some
        modes to one parameter; a map that is declared as exact is so to 1e-4.
        """
        assert self.description.map is not None  # whoever asks has a map
        own, common = self.description.map.model_std, self.description.map.common_std
        return np.asarray(max(own, _LEAST_MAP_ERROR) ** 2 * np.eye(n_modes) + common**2)

    def matches(self, metadata: Metadata) -> bool:
        """Return whether the description applies to a log."""
        if metadata.description is not None:
            return metadata.description in (self.name, f"{self.name}.toml")
        pattern = self.description.match.stage
        return metadata.stage is not None and fnmatchcase(metadata.stage, pattern)

    def with_laws(self, laws: Mapping[str, tuple[AnyLaw, ...] | None]) -> Self:
        """Return the stage with other laws of some parameters, by name; its digest stays.

        With None the parameter has those of a description that states none.
        """
        parameters = tuple(
            structs.replace(one, law=laws.get(one.name, one.law)) for one in self.parameters
        )
        description = structs.replace(self.description, parameter=parameters)
        return replace(self, description=description)

    def drift(self, x: FloatArray, modes: tuple[str, ...]) -> FloatArray:
        """Predict the drift of ln f of modes on the map since the baseline.

        From ln parameters ``(n_points, n_parameters)`` inside the map; ``(n_points, n_modes)``.
        """
        if self.modal_map is None:
            raise BadStage(f"{self.name}: no [map], so nothing links health to frequencies")
        columns = [self.modal_map.modes.index(name) for name in modes]
        return (self.modal_map.ln_frequency(x) - self._ln_frequency_at_baseline)[:, columns]

    def drifts(self, x: FloatArray, modes: tuple[str, ...]) -> FloatArray:
        """Predict `drift`, then that of each parameter alone, all others at baseline.

        Shape ``(1 + n_parameters, n_points, n_modes)``.
        """
        assert self.modal_map is not None
        columns = [self.modal_map.modes.index(name) for name in modes]
        found = self.modal_map.ln_frequency_and_alone(x, self._alone)
        return (found - self._ln_frequency_at_baseline)[..., columns]

    @cached_property
    def _alone(self) -> tuple[FloatArray, ...]:
        assert self.modal_map is not None  # drifts() has checked
        return self.modal_map.alone(self.baseline_point)

    @cached_property
    def _ln_frequency_at_baseline(self) -> FloatArray:
        assert self.modal_map is not None  # drift() has checked
        return self.modal_map.ln_frequency(self.baseline_point[None])


def shipped() -> tuple[str, ...]:
    """List the names of the shipped descriptions."""
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.toml")))


def expect_stages(given: object) -> None:
    """Require a sequence of stage descriptions, or raise `BadStage`: a name is none."""
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise BadStage(f"stages is {_what(given)}; needed a list of results of load_stage")
    for one in given:
        expect_stage(one)


def expect_stage(given: object) -> None:
    """Require a stage description, or raise `BadStage`."""
    if not isinstance(given, Stage):
        named = isinstance(given, str | Path)
        needed = f"load_stage({str(given)!r})" if named else "a result of load_stage"
        raise BadStage(f"stage is {_what(given)}; needed {needed}")


def _what(given: object) -> str:
    return f"{given!r:.80} of type {type(given).__name__}"


def load_stage(reference: str | Path, *, follow_links: bool = False) -> Stage:
    """Load and check a stage description.

    Parameters
    ----------
    reference : str or Path
        A path ending in ``.toml``, or the name of a shipped description.
    follow_links : bool, optional
        Whether its modal map may lie outside the folder of the description.

    Raises
    ------
    BadStage
        If it cannot be found or read, violates the schema, or does not match its map.

    Examples
    --------
    >>> import lmshealth
    >>> stage = lmshealth.load_stage("lms-y")
    >>> [(mode.name, mode.frequency_hz) for mode in stage.modes]
    [('roll', 126.4), ('pitch', 136.6), ('yaw', 155.0)]
    >>> [(parameter.name, parameter.limit.below) for parameter in stage.parameters]
    [('guide_preload', 0.6), ('mount_stiffness', 0.7)]

    Frequencies of roll and pitch after the loss of a fifth of the preload, by the modal map:

    >>> import numpy as np
    >>> np.exp(stage.drift(np.log([[0.8, 1.0]]), ("roll", "pitch"))).round(3)
    array([[0.979, 0.97 ]])
    """
    reference = str(reference)
    if reference.endswith(".toml"):
        path = Path(reference)
    elif reference in shipped():
        path = _SHIPPED / f"{reference}.toml"
    else:
        needed = f"needed is a path ending in .toml, or one of {', '.join(shipped())}"
        raise BadStage(f"no stage description {reference!r}: {needed}")
    try:
        content = read_table(path)
        description = decode(content, Description)
    except OSError as error:
        raise BadStage(f"{path}: cannot read the stage description: {error.strerror}") from error
    except ValueError as error:
        raise BadStage(f"{path}: {error}") from error
    digest = hashlib.sha256(content)
    modal_map = None
    if description.map is not None:
        map_path = path.parent / description.map.file
        names = tuple(parameter.name for parameter in description.parameter)
        if not follow_links and escapes(map_path, path.parent):
            found = "it leaves the folder of the description"
            step = "copy the map into that folder, or set --follow-links"
            raise BadStage(f"{path}: map.file: {found}; {step}")
        if not os.path.isfile(map_path):
            raise BadStage(f"{path}: map.file: there is no file {map_path}")
        modal_map = read_map(str(map_path), names)
        digest.update(map_path.read_bytes())
        _check_map(path, description, modal_map)
    return Stage(description=description, modal_map=modal_map, digest=digest.hexdigest())


def _check_map(path: Path, description: Description, modal_map: ModalMap) -> None:
    """Refuse a description that contradicts its map."""
    ends = np.array([modal_map.low, modal_map.high])
    for k, parameter in enumerate(description.parameter):
        low, high = ends[:, k]
        if not low <= np.log(parameter.baseline) <= high:
            raise BadStage(
                f"{path}: parameter[{k}].baseline: the baseline {parameter.baseline:g} of "
                f"{parameter.name} lies outside the modal map, which covers {np.exp(low):.4g} to "
                f"{np.exp(high):.4g}"
            )
        try:
            own = JointPrior((parameter.name,), (parameter.prior,), *ends[:, [k]])
            if (std := float(np.sqrt(own.variance[0]))) < constants.LEAST_PRIOR_STD:
                needed = f"at least {constants.LEAST_PRIOR_STD:g} of the value"
                raise BadStage(f"its standard deviation is {std:.2g}, needed {needed}")
        except BadStage as error:
            raise BadStage(f"{path}: parameter[{k}].prior: {error}") from error
    described = [mode.name for mode in description.mode]
    known = [mode for mode in description.mode if mode.tracked and mode.name in modal_map.modes]
    if not known:
        raise BadStage(
            f"{path}: map.file: the map has modes {list(modal_map.modes)}, but none of them is a "
            f"tracked [[mode]] ({described})"
        )
    each, most = description.life.lone_mode, 1 - description.life.common_wander
    if each * len(known) > most + 1e-12:
        raise BadStage(
            f"{path}: life.lone_mode: {len(known)} modes with {each:g} each and the common wander "
            f"have a probability above 1 together; needed is at most {most / len(known):.3g}"
        )
    at = np.exp(modal_map.ln_frequency(np.log([[p.baseline for p in description.parameter]]))[0])
    free = {
        name.casefold(): (name, f)
        for name, f in zip(modal_map.modes, at.tolist(), strict=True)
        if name not in described
    }
    absent = [mode for mode in description.mode if mode.tracked and mode not in known]
    for mode in absent:
        for near in get_close_matches(mode.name.casefold(), free):
            name, f = free[near]
            if abs(search_offset(f, mode.frequency_hz, mode.search)) <= 1:
                raise BadStage(
                    f"{path}: mode[{described.index(mode.name)}].name: {mode.name!r} is not on "
                    f"the map, whose {name!r} at {f:.4g} Hz no [[mode]] describes; write {name!r}, "
                    "or, if these are two modes, describe both"
                )


def why_unmatched(metadata: Metadata, stages: Sequence[Stage]) -> str:
    """Explain why no description matches a log, and the two places to correct that."""
    if metadata.description is not None:
        return (
            f"its description is to be {metadata.description!r}, and --stage gives "
            f"{', '.join(stage.name for stage in stages)}; give that one, or correct column "
            "description of manifest.csv"
        )
    asked = ", ".join(f"{stage.description.match.stage!r} in {stage.name}" for stage in stages)
    return (
        f"no description matches stage {metadata.stage!r}: [match] stage is {asked}; correct it "
        "there, or give by --stage the description of this machine"
    )
