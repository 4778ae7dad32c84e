"""What is stated about exports: column names and units, column maps, and layouts of text.

A column name of the log contract gives the quantity by its prefix and the unit by its suffix.
A column map translates the names of one export, a layout states how a program writes its text.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct, ValidationError, convert
from msgspec.structs import asdict

from lmshealth._private.files import read_table
from lmshealth._private.toml import decode, within
from lmshealth.errors import BadTable
from lmshealth.io import constants
from lmshealth.io.log import as_text, metadata_keys
from lmshealth.io.refusal import Unusable, listed, repeated

Role = Literal[
    "displacement", "acceleration", "current", "reference_velocity", "reference_position", "time"
]

SI_TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_TIMES = ("time", *(f"time_{unit}" for unit in SI_TIMES))
_FACTORS = {
    "length": {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9},
    "velocity": {"m_s": 1.0, "mm_s": 1e-3},
    "acceleration": {"m_s2": 1.0, "mm_s2": 1e-3, "g": 9.80665},
    "current": {"a": 1.0, "ma": 1e-3},
    "time": SI_TIMES,
}
# `_m_s2` must be tried before `_s`, or an acceleration would be read as a time.
_LONGEST_FIRST = sorted((unit for own in _FACTORS.values() for unit in own), key=len, reverse=True)
# "Â" is left of a superscript or a micro sign that some exporter encoded twice.
_SPELLINGS = str.maketrans(
    {"/": "_", "^": None, "*": None, "µ": "u", "μ": "u", "²": "2", " ": None, "Â": None}
)
_ALIASES = {"A": "a", "mA": "ma", "gn": "g", "m_s_s": "m_s2", "m_sec2": "m_s2"}
_ALIASES |= dict.fromkeys(("sec", "second", "seconds", "Second", "S"), "s")

# By prefix of a column: its role, and the dimension of its units.
_PREFIXES: dict[str, tuple[Role, str]] = {
    "delta_e": ("displacement", "length"),
    "acc": ("acceleration", "acceleration"),
    "current": ("current", "current"),
    "reference_velocity": ("reference_velocity", "velocity"),
    "reference_position": ("reference_position", "length"),
}
# Columns of a table of measured frequency responses, which `frf` reads.
RESPONSE_COLUMN = re.compile(
    r"frequency_(?P<axis>hz|khz|rad_s)|"
    r"(?:(?P<name>.+)_)?(?P<part>real|imag|magnitude|db|phase_deg|phase_rad|coherence)"
)
_DIMENSIONS: dict[Role, str] = {**dict(_PREFIXES.values()), "time": "time"}


@dataclass(frozen=True, slots=True)
class Signal:
    """Content of a column: its name without unit, its role, and the SI value of one in its unit.

    The role is the physical quantity, and whether it is measured or a set point.
    """

    name: str
    role: Role
    factor: float


def role_of(column: str) -> Role | None:
    """Return the quantity of a column by its prefix; None for a column outside the contract.

    ``time`` alone is no prefix: a column such as ``time_of_day`` is no time axis.
    """
    if column in _TIMES:
        return "time"
    fitting = (
        role for prefix, (role, _) in _PREFIXES.items() if f"{column}_".startswith(f"{prefix}_")
    )
    return next(fitting, None)


def unit_key(text: str, dimension: str | None = None) -> str | None:
    """Return a unit as the contract writes it (``m/s²`` is ``m_s2``); None for any other unit."""
    word = text.strip().translate(_SPELLINGS)
    word = _ALIASES.get(word, word)
    kinds = [dimension] if dimension else [*_FACTORS]
    return word if any(word in _FACTORS[kind] for kind in kinds) else None


def parse_column(column: str, unit: str | float | None = None) -> Signal:
    """Read quantity, name and unit from a column name that `role_of` recognises.

    A unit, or the SI value of one count, is given for a column whose name carries no unit.
    `Unusable`: ``unit`` for a missing, unknown or contradicting unit, ``columns`` for a column
    outside the contract or an unprintable or very long name.
    """
    role = role_of(column)
    if role is None:
        raise Unusable("columns", f"{column!r} is no column of the log contract")
    if not column.isprintable() or len(column) > constants.LONGEST_NAME:
        needed = f"printable text of at most {constants.LONGEST_NAME} characters"
        raise Unusable("columns", f"a column is called {column[:80]!r}, needed {needed}")
    suffix = next((word for word in _LONGEST_FIRST if column.endswith("_" + word)), "")
    name = column.removesuffix(f"_{suffix}")
    factors = _FACTORS[_DIMENSIONS[role]]
    choices = ", ".join(f"_{word}" for word in factors)
    if unit is None:
        if suffix not in factors:
            found = f"the unit {suffix}" if suffix else "no known unit"
            needed = f"needed one of {choices} as suffix"
            raise Unusable("unit", f"column {column!r} carries {found}; {needed}")
        return Signal(name, role, factors[suffix])
    if suffix in factors:
        found = f"column {column!r} carries the unit {suffix} and is given {unit!r} as well"
        raise Unusable("unit", f"{found}; name it {name!r} to read it by the latter")
    if isinstance(unit, str):
        if (key := unit_key(unit) or "") not in factors:
            detail = f"column {column!r} is given the unit {unit!r}; needed {choices}"
            raise Unusable("unit", detail)
        return Signal(column, role, factors[key])
    least, most = constants.SCALES
    if not least <= abs(unit) <= most:
        needed = f"a number of magnitude {least:g} to {most:g}"
        raise Unusable("unit", f"column {column!r} is given the scale {unit:g}; needed {needed}")
    return Signal(column, role, float(unit))


class CsvLayout(Struct, frozen=True, forbid_unknown_fields=True):
    """Layout of a delimited text file; what is None is found in the file.

    ``skip_rows`` lines before the metadata lines and the names are skipped unread. A blank as
    delimiter is any run of blanks and tabs. ``header`` is whether a line names the columns (else
    they are called ``"0"``, ``"1"``, ...), or the names for a file without such a line.
    """

    skip_rows: Annotated[int, within(0, constants.MOST_ROWS)] | None = None
    delimiter: Annotated[str, Meta(min_length=1, max_length=1)] | None = None
    decimal: Literal[".", ","] | None = None
    header: bool | list[str] | None = None
    encoding: str | None = None


class MatLayout(Struct, frozen=True, forbid_unknown_fields=True):
    """Variable of a MAT file that holds the log; None for all variables."""

    variable: str | None = None


# A text that is taken as it is, or a regular expression, of which the last group is the value.
Pattern = Annotated[str, Meta(min_length=1, max_length=500)]
# Where it finds a row, DELIMITER stands for the delimiter.
DELIMITER = "{d}"
# Beginnings of tables that belong to no vendor: no layout may recognise them.
_PLAIN_TABLES = (
    "",
    "0,1\n0.001,2.5\n0.002,-1\n",
    "time;a;b\n0,1;2\n0,2;3\n",
    "Time\tPosition\ns\tmm\n0.001\t0.1\n",
    "# stage: A-1\ntime_s,delta_e_um,acc_x_g\n0.001,0.1,0.2\n",
)


class TimeColumns(Struct, frozen=True, forbid_unknown_fields=True):
    """Columns of times in a layout; of several each belongs to the columns up to the next.

    A column that is empty in the first row holds no times.
    """

    name: Annotated[str, Meta(examples=["Time"])]  # of the column
    unit: Literal["s", "ms", "us", "ns"] = "s"


class StartMoment(Struct, frozen=True, forbid_unknown_fields=True):
    """Moment of the first sample in a layout.

    What the patterns find is joined by blanks and read by ``format``: ``filetime`` (ticks of 100 ns
    since 1601), ``unix`` (s since 1970), directives of `strptime`, or ISO 8601.
    """

    find: Annotated[list[Pattern], Meta(min_length=1)]
    format: str = "iso"


class Segments(Struct, frozen=True, forbid_unknown_fields=True):
    """Further headers between the rows of a layout, which are left out.

    Their lines that begin with a key of ``same`` must be those of the first header. Without one
    column of times, which places the rows, there may be no more of them than the largest number in
    the line that begins with the key ``rows``; ``needed`` names the setting of the program that
    writes one.
    """

    same: Annotated[list[str], Meta(min_length=1, examples=[["Channels"]])]
    rows: Annotated[str, Meta(min_length=1, examples=["Samples"])]
    needed: Annotated[str, Meta(min_length=1, examples=["X values"])]


class Layout(Struct, frozen=True, forbid_unknown_fields=True):
    """How a program writes its text: a header of its own, and rows.

    Every pattern of ``recognise`` is found in the first lines of such a file, and not all in
    others. The rows begin behind the line in which the first match of ``rows_after`` ends; the
    lines before them are the header, in which the last match of each pattern counts. ``names``,
    ``units``, ``interval`` (between samples) and ``offset`` (in s, of the first sample) find a row
    with a field for each column, or one field for all; with a group ``column``, all matches count,
    each for the column of that number. The README of this folder has an example.
    """

    name: Annotated[str, Meta(min_length=1, max_length=60, examples=["ACME recorder"])]
    recognise: Annotated[list[Pattern], Meta(min_length=1, examples=[["\\AACME recorder"]])]
    rows_after: Annotated[Pattern, Meta(examples=["^Data:"])]
    # The number of its character is also found; blanks where nothing is.
    delimiter: Annotated[Pattern, Meta(examples=[","])]
    required: list[str] = []  # beginnings of lines, without which a header is damaged
    decimal: Pattern | None = None  # found in the first rows where nothing is
    names: Pattern | None = None  # by default columns are called "0", "1", ...
    units: Pattern | None = None  # by default in brackets behind the names
    interval: Pattern | None = None
    interval_unit: Literal["s", "ms", "us", "ns"] = "s"
    offset: Pattern | None = None
    time: TimeColumns | None = None
    start: StartMoment | None = None
    metadata: dict[str, Pattern] = {}  # keys of the contract
    segments: Segments | None = None

    def __post_init__(self) -> None:
        """Check what the types do not state; the error lists every fault."""
        keys = ("recognise", "rows_after", "delimiter", "decimal", "names", "units", "interval")
        given = {key: getattr(self, key) for key in (*keys, "offset")}
        given |= {f"metadata.{key}": pattern for key, pattern in self.metadata.items()}
        given["start.find"] = self.start and self.start.find
        each = [(key, one) for key, own in given.items()
                for one in (own if isinstance(own, list) else [own or ""])]  # fmt: skip
        faults = [f"{key}: {fault}" for key, pattern in each if (fault := _fault(pattern))]
        if not faults:
            marks = {"delimiter": self.delimiter, "decimal": self.decimal or "."}
            faults = [f"{key}: got {mark!r}, needed one character, or a group () around it"
                      for key, mark in marks.items()
                      if len(mark) > 1 and not re.compile(mark).groups]  # fmt: skip
            if plain := [text for text in _PLAIN_TABLES if self.recognises(text)]:
                needed = "needed lines that only files of this layout have"
                faults.append(f"recognise: also fits other tables, as {plain[0][:40]!r}; {needed}")
        if unknown := sorted(set(self.metadata) - set(metadata_keys())):
            faults.append(
                f"metadata: got {listed(unknown)}; known keys are {listed(metadata_keys())}"
            )
        if faults:
            raise ValueError("; ".join(faults))

    def recognises(self, text: str) -> bool:
        """Return whether a text begins as files of this layout do."""
        return all(re.search(pattern, text, re.MULTILINE) for pattern in self.recognise)


def _fault(pattern: str) -> str:
    """Return what is wrong with a regular expression; empty where nothing is."""
    try:
        for mark in (DELIMITER, r"\;"):
            re.compile(pattern.replace(DELIMITER, mark), re.MULTILINE)
    except (re.error, OverflowError, RecursionError) as error:
        return f"{pattern!r} is no regular expression: {error}"
    return ""


class _MapFile(Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of the file of a column map."""

    columns: dict[str, str] = {}  # contract name to the name in the file
    # Contract name without unit suffix to its unit, or to the SI value of one count.
    units: dict[str, str | float] = {}
    metadata: dict[str, Any] = {}  # constants that override the metadata of the file
    sample_rate_hz: Annotated[float, within(*constants.RANGES["sample_rate_hz"])] | None = None
    csv: CsvLayout = CsvLayout()
    mat: MatLayout = MatLayout()


class ColumnMap(_MapFile, frozen=True, forbid_unknown_fields=True, dict=True):
    """Translation of an export into the log contract; by default its columns are the contract's.

    ``layouts`` are the user's; one with the name of a shipped layout replaces it. They travel with
    the map because a log that is read by another layout is another log.
    """

    layouts: tuple[Layout, ...] = ()

    @cached_property
    def _targets(self) -> dict[str, str]:
        return {source: target for target, source in self.columns.items()}

    def target(self, source: str) -> str | None:
        """Return the contract name of a column of the file; None if it is not to be read.

        Without ``[columns]`` every column with a prefix of the contract is read, so that a missing
        unit is an error and not a lost channel. An export with ``[columns]`` may have other columns
        with such a prefix: only those with a unit of the contract are read as well.
        """
        if source in self._targets:
            return self._targets[source]
        if role_of(source) is None or source in self.columns:
            return None
        if not self.columns:
            return source
        try:
            self.signal(source)
        except Unusable:
            return None
        return source

    def is_time(self, source: str) -> bool:
        """Return whether a column of the file holds times."""
        return role_of(self.target(source) or "") == "time"

    def signal(self, target: str) -> Signal:
        """Read quantity, name and unit of a contract name, as `parse_column` does."""
        return parse_column(target, self.units.get(target))

    def constants(self) -> dict[str, str]:
        """Return the metadata of the map as text, with the keys of the contract."""
        text = {key: as_text(value) for key, value in self.metadata.items()}
        if self.sample_rate_hz is not None:
            text["sample_rate_hz"] = repr(self.sample_rate_hz)
        return text


ColumnsGiven = ColumnMap | Mapping[str, Any] | str | Path
"""A column map, its tables as a mapping, or its file."""


def column_map(given: ColumnsGiven | None) -> ColumnMap:
    """Return the column map that was given: itself, a mapping of its tables, or its TOML file.

    None is that of the log contract. `BadTable` as `load_columns`.
    """
    if given is None:
        return ColumnMap()
    if isinstance(given, ColumnMap):
        return given
    if not isinstance(given, Mapping):
        return load_columns(given)
    return _checked(lambda: convert(given, _MapFile), "column map")


def load_columns(path: str | Path) -> ColumnMap:
    """Read a column map from the TOML file given to ``--columns``.

    `BadTable` if the file cannot be read, has unknown keys, or names columns, units or metadata
    that are not in the log contract.
    """
    return _checked(lambda: decode(read_table(Path(path)), _MapFile), f"column map {path}")


def _checked(read: Callable[[], _MapFile], name: str) -> ColumnMap:
    """Return a column map that agrees with the log contract; `BadTable` for another."""
    try:
        columns = ColumnMap(**asdict(read()))
        _check(columns)
    except (OSError, ValidationError, ValueError, Unusable) as error:
        raise BadTable(f"{name}: {getattr(error, 'detail', error)}") from error
    return columns


def load_layouts(folder: str | Path) -> tuple[Layout, ...]:
    """Read the layouts of text from a folder: one TOML file each.

    `BadTable` if there is none, one cannot be read or breaks the schema, or two have one name.
    """
    layouts: dict[str, Layout] = {}
    for path in sorted(Path(folder).glob("*.toml")):
        try:
            layout = decode(read_table(path), Layout)
            if layout.name in layouts:
                raise ValueError(f"name: another file of the folder has {layout.name!r}, too")
        except (OSError, ValueError) as error:
            raise BadTable(f"layout {path}: {error}") from error
        layouts[layout.name] = layout
    if not layouts:
        raise BadTable(f"{folder}: holds no layout; needed files *.toml, one for each layout")
    return tuple(layouts.values())


def _check(columns: ColumnMap) -> None:
    """Check names, units and metadata keys before any log is read."""
    names = [name for name in columns.columns if not RESPONSE_COLUMN.fullmatch(name)]
    if twice := repeated(columns.signal(name).name for name in names):
        raise ValueError(f"[columns] names one signal twice: {listed(twice)}")
    if twice := repeated(columns.columns.values()):
        raise ValueError(f"[columns] reads one column twice: {listed(twice)}")
    for target in columns.units:
        columns.signal(target)
    if unknown := sorted(set(columns.metadata) - set(metadata_keys())):
        known = listed(metadata_keys())
        raise ValueError(f"[metadata] has {listed(unknown)}; known keys are {known}")
    if columns.sample_rate_hz is not None and "sample_rate_hz" in columns.metadata:
        raise ValueError("sample_rate_hz is given twice, at the top and in [metadata]")
    for key, value in columns.metadata.items():
        if not isinstance(value, str | int | float | datetime):
            raise ValueError(f"[metadata] {key} is a {type(value).__name__}, needed one value")
    _check_layout(columns.csv)


def _check_layout(layout: CsvLayout) -> None:
    """Check the marks and the encoding of text."""
    delimiter, encoding = layout.delimiter, layout.encoding
    if delimiter is not None and (not delimiter.isascii() or delimiter in '\r\n"#+-'):
        raise ValueError(f"[csv] delimiter is {delimiter!r}, needed one ASCII separator")
    try:
        # Not all codecs of Python are encodings of text.
        b"1;2".decode(encoding or "utf-8", "replace")
    except (LookupError, ValueError) as error:
        needed = "needed a name that Python has, such as cp1252"
        raise ValueError(f"[csv] encoding is {encoding!r}, {needed}") from error
    if delimiter is not None and delimiter == layout.decimal:
        raise ValueError(f"[csv] delimiter and decimal are both {delimiter!r}; set the delimiter")
