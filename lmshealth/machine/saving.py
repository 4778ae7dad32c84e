"""Save and load results: one file each, with its kind and the version of its format.

A file is a line of JSON (kind, versions, digest), and the result as MessagePack. It is decoded by
the type of its kind, so that nothing in it is executed.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar, overload

import msgspec

from lmshealth._private.files import write_bytes
from lmshealth._private.serialize import VERSION, pack, unpack
from lmshealth.errors import BadTable
from lmshealth.life.health import Health
from lmshealth.life.posterior.fit import LifePosterior
from lmshealth.life.prognosis import Prognosis
from lmshealth.life.verdict import Verdict
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.service import Service
from lmshealth.machine.summary import Summary
from lmshealth.modal.deterministic.frequency_response import FrfReading
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.modes import Modes
from lmshealth.stage.description import Stage
from lmshealth.stage.identifiability import Plan
from lmshealth.tracking.history import History
from lmshealth.tracking.track import Track

SavedResult = (
    Assessment
    | FrfReading
    | Health
    | History
    | LifePosterior
    | LogEstimates
    | Modes
    | Plan
    | Prognosis
    | Service
    | Stage
    | Summary
    | Track
    | Verdict
)
"""Results that can be saved: a log has a file of its own, and a status is JSON."""

KINDS: dict[str, type[SavedResult]] = {kind.__name__: kind for kind in SavedResult.__args__}
"""Their types by the name of their kind in a file."""

Kind = TypeVar("Kind", bound=SavedResult)

_FORMAT = 1
_MOST_HEAD = 1000  # bytes of the first line


@dataclass(frozen=True, slots=True)
class _Head:
    """First line of a file."""

    lmshealth_result: str  # kind
    format: int
    version: str  # of lmshealth, which wrote it
    sha256: str  # of the bytes that follow


def save(result: SavedResult, path: str | Path) -> None:
    """Save a result in a file of its own, completely or not at all.

    Parameters
    ----------
    result : SavedResult
        Any result of the functions of `lmshealth`, and descriptions.
    path : str or Path
        The file, which is replaced. Missing folders are made.

    Raises
    ------
    BadTable
        If the file cannot be written.
    TypeError
        For an object of another type.

    Examples
    --------
    >>> import lmshealth
    >>> from lmshealth import examples
    >>> lmshealth.save(examples.history(), "machine.history")
    >>> len(lmshealth.load("machine.history").logs)
    24
    """
    kind = type(result).__name__
    if type(result) is not KINDS.get(kind):
        raise TypeError(f"a {kind} cannot be saved; possible are {', '.join(sorted(KINDS))}")
    content = pack(result)
    head = _Head(kind, _FORMAT, VERSION, hashlib.sha256(content).hexdigest())
    write_bytes(Path(path), msgspec.json.encode(head) + b"\n" + content)


@overload
def load(path: str | Path, kind: None = None) -> SavedResult: ...
@overload
def load(path: str | Path, kind: type[Kind]) -> Kind: ...
def load(path: str | Path, kind: type[Kind] | None = None) -> SavedResult:
    """Load a result that `save` has written.

    Parameters
    ----------
    path : str or Path
        The file.
    kind : type, optional
        The type of result that is needed, such as `lmshealth.Health`; by default any.

    Returns
    -------
    SavedResult
        With all values of the one that was saved, bit for bit.

    Raises
    ------
    BadTable
        If the file cannot be read, is no saved result, is damaged, is of another kind, or was
        written in a format or with fields that this version does not know.

    Examples
    --------
    >>> import lmshealth
    >>> lmshealth.save(lmshealth.load_stage("lms-y"), "stage.saved")
    >>> lmshealth.load("stage.saved", lmshealth.Stage).name
    'lms-y'
    """
    try:
        line, _, content = Path(path).read_bytes().partition(b"\n")
        head = msgspec.json.decode(line[:_MOST_HEAD], type=_Head)
    except OSError as error:
        raise BadTable(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise BadTable(f"{path}: is no result that lmshealth.save has written") from error
    found = KINDS.get(head.lmshealth_result)
    if head.format != _FORMAT or found is None:
        raise BadTable(
            f"{path}: holds a {head.lmshealth_result} in format {head.format} of lmshealth "
            f"{head.version}; this is {VERSION}, with format {_FORMAT}: install that version"
        )
    if hashlib.sha256(content).hexdigest() != head.sha256:
        raise BadTable(f"{path}: is damaged: its content has another digest; save it again")
    if kind is not None and found is not kind:
        raise BadTable(f"{path}: holds a {found.__name__}, needed a {kind.__name__}")
    try:
        result: SavedResult = unpack(content, found)
    except ValueError as error:
        raise BadTable(
            f"{path}: was written by lmshealth {head.version}, whose {found.__name__} has other "
            f"fields than that of {VERSION}; install that version, or compute it again"
        ) from error
    return result
