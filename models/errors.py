"""Errors of the simulated stages: each states the value found and what is needed."""

from __future__ import annotations

from collections.abc import Iterable


class ModelError(Exception):
    """Base of every error that the package raises on purpose."""


class _Unknown(ModelError):
    """A name that is in no registry; carries the name and the registered ones."""

    noun = "name"

    def __init__(self, got: str, known: Iterable[str]) -> None:
        self.got = got
        self.known = tuple(known)
        super().__init__(f"unknown {self.noun} {got!r}; known: {', '.join(self.known)}")


class UnknownLife(_Unknown):
    """A life that is not in the registry of lives."""

    noun = "life"


class UnknownStage(_Unknown):
    """A stage that is not registered."""

    noun = "stage"


class UnknownReading(_Unknown):
    """A reading of the equations other than printed, corrected or derived."""

    noun = "reading"


class UnknownServo(_Unknown):
    """A servo_id without a tuning of the loop."""

    noun = "servo_id"


class UnknownFault(_Unknown):
    """A fault of a recording that is not in the registry of faults."""

    noun = "fault"


class UnknownFormat(_Unknown):
    """A file format in which no log can be written."""

    noun = "format"


class BadParameter(ModelError):
    """A number outside the range in which the model means anything."""

    def __init__(self, name: str, got: object, needed: str) -> None:
        self.name = name
        self.got = got
        super().__init__(f"{name} is {got}; needed: {needed}")


class MissingLibrary(ModelError):
    """A library of an extra that is not installed."""

    def __init__(self, library: str, extra: str) -> None:
        self.library = library
        super().__init__(
            f"the simulated stages need the library {library}: pip install 'lmshealth[{extra}]'"
        )


class OccupiedFolder(ModelError):
    """A folder with logs that a run would not overwrite."""

    def __init__(self, folder: str, log: str, count: int) -> None:
        self.folder = folder
        self.log = log
        self.count = count
        super().__init__(
            f"{folder} holds {log}: logs that this run would not write again ({count}) would stay; "
            "needed: another folder (or remove them)"
        )


class UnstableLoop(ModelError):
    """The position loop around this structure has poles in the right half plane."""

    def __init__(self, stage: str, growth_per_s: float, frequency_hz: float) -> None:
        self.stage = stage
        self.growth_per_s = growth_per_s
        self.frequency_hz = frequency_hz
        super().__init__(
            f"{stage}: the closed loop is unstable: a pole at {frequency_hz:.2f} Hz grows by "
            f"{growth_per_s:.3g} 1/s; needed: all poles decay (lower the loop gain or keep "
            "stiffness, damping and payload nearer to their commissioning values)"
        )


class AmbiguousModes(ModelError):
    """Mode identities could not be followed from the nominal condition."""

    def __init__(self, where: str, similarity: float) -> None:
        self.similarity = similarity
        super().__init__(
            f"mode identities are lost at {where}: best modal assurance {similarity:.2f}; "
            "needed: at least 0.50 between neighbouring conditions"
        )
