"""Reading one log, whatever its format: the only place where a file becomes a `Log`."""

from __future__ import annotations

import hashlib
import stat
from collections.abc import Mapping
from pathlib import Path

from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.constants import MAX_MEMORY
from lmshealth.io.formats.registry import load
from lmshealth.io.log import Log
from lmshealth.io.log_contract import to_log
from lmshealth.io.refusal import Unusable, shown


def read_log(
    path: str | Path,
    *,
    columns: ColumnMap | None = None,
    overrides: Mapping[str, str] | None = None,
    name: str | None = None,
    max_memory: float = MAX_MEMORY,
) -> Log:
    """Read a log.

    Parameters
    ----------
    path : str or Path
        The file; its suffix names the format and its content must agree.
    columns : ColumnMap, optional
        How an export is read; by default the columns are those of the log contract.
    overrides : mapping of str to str, optional
        Metadata that override what the file and the column map say, as a manifest gives them.
    name : str, optional
        The log as the user knows it; by default the path.
    max_memory : float, optional
        Most memory in bytes that one variable (MAT), data set (UFF58) or segment (TDMS) may take;
        what needs more is refused with reason ``too-large``.

    Returns
    -------
    Log
        In SI units, with the channels that were refused.

    Raises
    ------
    BadLog
        Whatever is wrong with the file; see `lmshealth.io` for the reasons.

    Examples
    --------
    A log is a table with units in the names of its columns:

    >>> import lmshealth
    >>> rows = ["# sample_rate_hz: 1000", "# stage: AX-3-Y", "delta_e_um,acc_pitch_g"]
    >>> rows += [f"{0.01 * (k % 7)},{0.002 * (k % 5)}" for k in range(2000)]
    >>> with open("log.csv", "w") as file:
    ...     print(*rows, sep=chr(10), file=file)
    >>> log = lmshealth.read_log("log.csv")
    >>> log.metadata.stage, log.sample_rate
    ('AX-3-Y', 1000.0)
    >>> [(channel.name, channel.kind) for channel in log.channels]
    [('delta_e', 'displacement'), ('acc_pitch', 'acceleration')]
    >>> print(f"{log.channels[0].values.max():.2g} m, {log.channels[1].values.max():.3g} m/s²")
    6e-08 m, 0.0785 m/s²
    """
    file = Path(path)
    label = shown(path) if name is None else name
    try:
        digest = _digest(file)
        used = ColumnMap() if columns is None else columns
        return to_log(
            load(file, used, max_memory), used, overrides or {}, name=label, digest=digest
        )
    except Unusable as error:
        raise BadLog(label, error.reason, error.detail) from error


def content_digest(path: str | Path) -> str:
    """Hash a file's content with SHA-256, block by block.

    Raises
    ------
    BadLog
        With reason ``missing-file`` when there is nothing that can be read, ``empty`` for 0 bytes:
        empty files are no copies of each other.
    """
    try:
        return _digest(Path(path))
    except Unusable as error:
        raise BadLog(shown(path), error.reason, error.detail) from error


def require_identity(log: Log) -> None:
    """Insist on the metadata that following a stage over its life needs.

    Raises
    ------
    BadLog
        With reason ``metadata``, naming the missing keys.
    """
    known = {
        "stage": log.metadata.stage,
        "recorded_at": log.metadata.recorded_at,
        "travel_km": log.metadata.travel,
    }
    if absent := [key for key, value in known.items() if value is None]:
        raise BadLog(
            log.name,
            "metadata",
            f"{', '.join(absent)} not given; needed in the file's metadata or in manifest.csv",
        )


def _digest(file: Path) -> str:
    """Hash a regular file block by block.

    Raises
    ------
    Unusable
        With the reasons ``missing-file`` and ``empty``.
    """
    try:
        found = file.stat()
        # A named pipe would be waited for until somebody writes to it.
        if not stat.S_ISREG(found.st_mode):
            raise Unusable("missing-file", "is no regular file")
        if not found.st_size:
            raise Unusable("empty", "0 bytes; copy the file again")
        with file.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise Unusable("missing-file", f"cannot be opened: {why}") from error
