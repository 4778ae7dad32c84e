"""Column maps: how a controller's or analyser's export is read as the log contract."""

from __future__ import annotations

from datetime import date, datetime
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct

from lmshealth._toml import decode
from lmshealth.errors import BadTable
from lmshealth.io.metadata import KEYS
from lmshealth.io.refusal import Unusable, listed
from lmshealth.io.units import Signal, parse_column, role_of


class CsvLayout(Struct, frozen=True, forbid_unknown_fields=True):
    """How a delimited text file is laid out.

    Attributes
    ----------
    skip_rows : int
        Lines before the metadata lines and the header, skipped unread.
    delimiter : str
        One character.
    header : bool or list of str
        Whether a header line names the columns (else they are called ``"0"``, ``"1"``, ...), or
        the names for a file without a header line.
    """

    skip_rows: Annotated[int, Meta(ge=0)] = 0
    delimiter: Annotated[str, Meta(min_length=1, max_length=1)] = ","
    header: bool | list[str] = True


class MatLayout(Struct, frozen=True, forbid_unknown_fields=True):
    """Which variable of a MAT file holds the log."""

    variable: str | None = None


class ColumnMap(Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """How an export is read as the log contract; the default reads the contract itself.

    Attributes
    ----------
    columns : dict of str to str
        Contract name to the name in the file.
    units : dict of str to str or float
        Contract name without unit suffix to its unit, or to the SI value of one count.
    metadata : dict of str to object
        Constants that override what the file says.
    sample_rate_hz : float or None
        In Hz.
    csv : CsvLayout
        Layout of delimited text.
    mat : MatLayout
        Where a MAT file holds the log.
    """

    columns: dict[str, str] = {}
    units: dict[str, str | float] = {}
    metadata: dict[str, Any] = {}
    sample_rate_hz: Annotated[float, Meta(gt=0)] | None = None
    csv: CsvLayout = CsvLayout()
    mat: MatLayout = MatLayout()

    @cached_property
    def _targets(self) -> dict[str, str]:
        return {source: target for target, source in self.columns.items()}

    def target(self, source: str) -> str | None:
        """Find the contract name of a column of the file; None if the column is not to be read.

        Without ``[columns]`` everything that looks like a signal is read, so that a missing unit
        is an error and not a lost channel. An export described by ``[columns]`` may hold columns
        that only look like signals: beside the named ones it gives those that keep the contract.
        """
        if source in self._targets:
            return self._targets[source]
        if role_of(source) is None or source in self.columns:
            return None
        if not self.columns:
            return source
        try:
            parse_column(source, self.units.get(source))
        except Unusable:
            return None
        return source

    def signal(self, target: str) -> Signal:
        """Read quantity, name and unit of a contract name.

        Raises
        ------
        Unusable
            Where the name carries no usable unit and the map gives none.
        """
        return parse_column(target, self.units.get(target))

    def constants(self) -> dict[str, str]:
        """Give the metadata of the map as text, with the keys of the contract."""
        text = {key: _as_text(value) for key, value in self.metadata.items()}
        if self.sample_rate_hz is not None:
            text["sample_rate_hz"] = repr(self.sample_rate_hz)
        return text


def load_columns(path: str | Path) -> ColumnMap:
    """Read a column map from a TOML file.

    Parameters
    ----------
    path : str or Path
        The file given to ``--columns``.

    Raises
    ------
    BadTable
        If the file cannot be read, has unknown keys, or names columns, units or metadata that
        are not in the log contract.
    """
    try:
        columns = decode(Path(path).read_bytes(), ColumnMap)
        _check(columns)
    except (OSError, ValueError) as error:
        raise BadTable(f"column map {path}: {error}") from error
    except Unusable as error:
        raise BadTable(f"column map {path}: {error.detail}") from error
    return columns


def _check(columns: ColumnMap) -> None:
    """Check names, units and metadata keys, so that slips are seen before any log is read."""
    signals = [columns.signal(target) for target in columns.columns]
    names = [signal.name for signal in signals]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"[columns] names one signal twice: {listed(sorted(twice))}")
    sources = list(columns.columns.values())
    if twice := {source for source in sources if sources.count(source) > 1}:
        raise ValueError(f"[columns] reads one column twice: {listed(sorted(twice))}")
    for target in columns.units:
        columns.signal(target)
    if unknown := sorted(set(columns.metadata) - set(KEYS)):
        raise ValueError(f"[metadata] has {listed(unknown)}; known keys are {listed(KEYS)}")
    if columns.sample_rate_hz is not None and "sample_rate_hz" in columns.metadata:
        raise ValueError("sample_rate_hz is given twice, at the top and in [metadata]")
    for key, value in columns.metadata.items():
        if not isinstance(value, str | int | float | datetime):
            raise ValueError(f"[metadata] {key} is a {type(value).__name__}, needed one value")
    delimiter = columns.csv.delimiter
    if not delimiter.isascii() or delimiter in '\r\n"#':
        raise ValueError(f"[csv] delimiter is {delimiter!r}, needed one ASCII separator")


def _as_text(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return value.isoformat() if isinstance(value, date) else str(value)
