"""Content of files: columns as they are in the file and metadata as text, or what holds no log.

Which channels are read, by unit, rate and start; moments in columns of times.
"""

import gzip
import re
import tomllib
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from lmshealth._private.arrays import FloatArray
from lmshealth.io import constants
from lmshealth.io.buffers import Samples, Spool, blocks
from lmshealth.io.column_map import ColumnMap, parse_column, role_of, unit_key
from lmshealth.io.log import Refusal, moment_after
from lmshealth.io.refusal import Unusable, corrupt, listed, repeated

GZIP = b"\x1f\x8b"
_BLOCK = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """Content of a file before the log contract is applied.

    ``columns`` are the wanted ones under their names in the file, ``(n_samples,)`` each; metadata
    are text as in the file; ``present`` are the names of all columns, for messages. Refused are
    wanted channels that cannot go with the others; the name of the log is added later. ``guessed``
    lists what neither the file nor the column map states; ``late`` has the number of samples by
    which a column starts after those that are not in it.
    """

    columns: dict[str, Samples]
    metadata: dict[str, str]
    present: tuple[str, ...]
    refused: tuple[Refusal, ...] = ()
    guessed: tuple[str, ...] = ()
    late: dict[str, int] = field(default_factory=dict)


Load = Callable[[Path, ColumnMap, float], Content]


@dataclass(frozen=True, slots=True)
class Format:
    """One file format.

    ``name`` is for messages; the suffixes are in lower case, with the leading dot; ``sniff``
    returns whether a file has this format from its leading bytes; ``load`` reads a file: path,
    column map, most memory in bytes. It may raise anything: `load_by` turns it into a refusal.
    With a ``library``, native code that can crash or hang, it is called in a process of its own,
    and must be a function of a module.
    """

    name: str
    suffixes: tuple[str, ...]
    sniff: Callable[[bytes], bool]
    load: Load
    library: str = ""


def begins(*marks: bytes, blanks: bytes = b"") -> Callable[[bytes], bool]:
    """Return whether first bytes, without some blanks before them, are one of the marks."""
    return lambda head: head.lstrip(blanks).startswith(marks)


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """Copy a file that gzip compressed to a temporary one as it was; other files are yielded.

    `Unusable`: ``too-large`` for more than the file can hold.
    """
    with path.open("rb") as stream:
        packed = stream.read(len(GZIP)) == GZIP
    if not packed:
        yield path
        return
    with TemporaryDirectory(prefix="lmshealth-") as folder:
        copy = Path(folder) / path.name[: -len(".gz")]
        with gzip.open(path) as whole, copy.open("wb") as target:
            for block in iter(partial(whole.read, _BLOCK), b""):
                target.write(block)
                check_size(target.tell(), path.stat().st_size)
        yield copy


def gzipped(form: Format, others: Iterable[str] = ()) -> Format:
    """Return the format of such files that gzip compressed, also of those with other suffixes."""

    def load(path: Path, columns: ColumnMap, max_memory: float) -> Content:
        with unpacked(path) as copy:
            with copy.open("rb") as stream:
                head = stream.read(_BLOCK >> 8)
                if not form.sniff(head):
                    if foreign := describe(head, copy):
                        raise Unusable("format", foreign)
                    raise corrupt(f"its content does not start as {form.name} does")
            return form.load(copy, columns, max_memory)

    suffixes = tuple(f"{suffix}.gz" for suffix in (*form.suffixes, *others))
    return Format(f"gzipped {form.name}", suffixes, begins(GZIP), load)


def load_by(form: str, load: Load, path: Path, columns: ColumnMap, max_memory: float) -> Content:
    """Read a file by the function of its format; whatever that raises becomes `Unusable`."""
    try:
        return load(path, columns, max_memory)
    except Unusable:
        raise
    except MemoryError as error:
        detail = f"reading it as {form} takes more memory than a log of its size does"
        raise Unusable("too-large", f"{detail}; copy the file again") from error
    except Exception as error:
        # Libraries raise any exception on damaged files; one file must not end a batch.
        text = " ".join(str(error).split())[:200]
        detail = f"cannot be read as {form} ({type(error).__name__}: {text})"
        raise Unusable("corrupt", detail) from error


def check_size(decoded: int, stored: int) -> None:
    """Refuse (``too-large``) what would decode to an unreasonable size, before it does."""
    limit = max(constants.SMALL_ENOUGH, constants.LARGEST_RATIO * stored)
    if decoded > limit:
        found = f"{stored} bytes would swell to {decoded} or more, allowed are {limit}"
        needed = "split the recording, or check where the file comes from"
        raise Unusable("too-large", f"{found}; {needed}")


def check_memory(what: str, needed: float, allowed: float) -> None:
    """Refuse (``too-large``) a part of a file that takes too much memory, before it is read."""
    if needed > allowed:
        found = f"needs {needed / 1e9:.2g} GB of memory, allowed are {allowed / 1e9:.2g} GB"
        step = "convert the file to HDF5 or Parquet, or raise --max-memory"
        raise Unusable("too-large", f"{what} {found}; {step}")


def wanted(names: Iterable[str], columns: ColumnMap) -> list[str]:
    """Choose the columns that contract or column map name; refuse (``columns``) a name twice."""
    chosen = [name for name in names if columns.target(name) is not None]
    if twice := repeated(chosen):
        raise Unusable("columns", f"the file names {listed(twice)} more than once")
    check_number(len(chosen))
    return chosen


def check_number(n_columns: int) -> None:
    """Refuse (``columns``) more columns of signals than a log has."""
    if n_columns > constants.MOST_COLUMNS:
        found = f"{n_columns} columns of signals, at most {constants.MOST_COLUMNS} are read"
        raise Unusable("columns", f"{found}; name those of the log in a column map (--columns)")


def collected(
    sizes: Mapping[str, int],
    parts: Iterable[tuple[str, np.ndarray]],
    times: "Mapping[str, SinceFirst]",
) -> dict[str, Samples]:
    """Join the parts of columns of expected sizes; moments become times."""
    taken = {name: Spool(size) for name, size in sizes.items()}
    for name, values in parts:
        taken[name].append(times[name](values) if name in times else values)
    return {name: spool.samples() for name, spool in taken.items()}


@contextmanager
def library(form: str, name: str) -> Iterator[None]:
    """Import the library of a format, or refuse the file if it is not installed."""
    try:
        yield
    except ImportError as error:
        needed = f"reading {form} needs {name}: pip install 'lmshealth[formats]'"
        raise Unusable("format", needed) from error


def not_numeric(column: str, found: str) -> Unusable:
    """Return the refusal of a wanted column that holds no series of numbers."""
    return Unusable("columns", f"column {column!r} holds {found}, needed one number per sample")


_STL_HEAD, _STL_FACET = 84, 50
_INNER = 4096  # bytes that are unpacked

# Names of a column of frequencies.
_FREQUENCY = re.compile(
    r"(?:freq(?:uency|uenz|\.)?|fréquence|frequenza|frecuencia)[\W_]*(?:in\W*)?(?:k?hz)?\W*"
    r"|f[\W_]*(?:in\W*)?k?hz\W*|k?hz",
    re.IGNORECASE,
)


@cache
def foreign(table: str) -> Any:
    """Return a table of ``foreign.toml``: how files that hold no log are recognised and named."""
    return tomllib.loads((Path(__file__).parent / "foreign.toml").read_text("utf-8"))[table]


def describe(head: bytes, path: Path) -> str:
    """Return what a file is that holds no log, and what is needed; empty where it may be one.

    From its first bytes, also below gzip, and for archives and binary geometries from the file.
    """
    if head.startswith(GZIP):
        with suppress(zlib.error):
            inner = zlib.decompressobj(wbits=31).decompress(head, _INNER)
            return describe(inner, path) if not inner.startswith(GZIP) else ""
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return _zipped(path)
    needed = foreign("needed")
    for pattern, name, key in foreign("files")["beginnings"]:
        if re.match(f"(?s){pattern}".encode("latin-1"), head):
            return f"is {name}{needed[key]}"
    n_facets = int.from_bytes(head[_STL_HEAD - 4 : _STL_HEAD], "little")
    if n_facets and path.stat().st_size == _STL_HEAD + n_facets * _STL_FACET:
        return f"is a geometry (STL){needed['picture']}"
    return ""


def _zipped(path: Path) -> str:
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, ValueError, NotImplementedError):
        names = []
    needed = foreign("needed")
    for pattern, kind, key in foreign("files")["zipped"]:
        if any(re.match(pattern, name) for name in names):
            return f"is {kind}{needed[key]}"
    return f"is a zip archive of {len(names)} files{needed['archive']}"


def frequency_column(names: Iterable[str]) -> str:
    """Return the first column where it holds frequencies, as of a spectrum; else empty."""
    first = next(iter(names), "")
    return first if _FREQUENCY.fullmatch(first.strip()) else ""


def over_frequency(column: str) -> Unusable:
    """Return the refusal of a table over frequency."""
    what = f"is a table over frequency (column {column!r}), as of a spectrum"
    needed = "needed samples over time, of which spectra are estimated"
    step = "`lmshealth frf` reads responses: frequency_hz with real and imag, or with magnitude"
    return Unusable("format", f"{what}; {needed}; {step} and phase_deg")


# Channels

# Names that exporters give to the column of times.
_TIME = re.compile(r"(time|zeit|temps|tiempo|tempo|t|x_value|timestamp)\b", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Described:
    """Name and unit of a channel as in the file, empty where there is none.

    ``rate`` is its sample rate in Hz, ``start`` the time in s of its first sample, None where the
    file has none, and ``size`` its number of samples, 0 where it is not yet there; ``acceleration``
    whether the file calls it one, whatever its unit, and ``moments`` whether it holds moments.
    """

    name: str
    unit: str
    rate: float | None = None
    acceleration: bool = False
    start: float | None = 0.0
    size: int = 0
    moments: bool = False


def choose(channels: Sequence[Described], columns: ColumnMap) -> tuple[dict[str, int], Content]:
    """Choose the channels of one sample rate that the contract or the column map names.

    Return the index in the file of each by its name as a column of the log, and a content that has
    their sample rate, the names of all channels, refusals, and by how many samples they start late,
    but no samples. Channels of another rate are refused, and those whose start is a fraction of a
    sample off, or so late that the others would be used in part only.

    Without ``[columns]`` every channel whose unit is an acceleration is read as ``acc_<name>``;
    with it, the named ones and those that keep the contract. Moments are times where there are no
    others and no rate. Two channels that would be one column are refused as ``columns``, a name
    that contradicts the unit of its channel as ``unit``.
    """
    named = [(column, k) for k, c in enumerate(channels) if (column := _column(c, columns))]
    check_number(len(named))
    # Each group of channels may have times of its own: those of the chosen rate are read.
    signals = [channels[k].rate for column, k in named if role_of(column) != "time"]
    counts = Counter(own for own in signals if own is not None)
    rate = max(counts, key=lambda rate: (counts[rate], rate), default=None)
    # Moments are times where nothing else states the rate.
    moments = [("time_s", k) for k, channel in enumerate(channels) if channel.moments]
    timed = rate or columns.sample_rate_hz or any(columns.is_time(column) for column, _ in named)
    named += moments if len(moments) == 1 and not timed else []
    least = constants.AGREEMENT
    alike = [k for _, k in named if not rate or abs((channels[k].rate or rate) / rate - 1) <= least]
    n_late = _aligned([channels[k] for k in alike], rate)
    samples = {k: n for k, n in zip(alike, n_late, strict=True) if n is not None}
    kept: dict[str, int] = {}
    refused: dict[str, Refusal] = {}
    for column, k in named:
        own = channels[k].rate
        if k in samples:
            if column in kept and (role_of(column) != "time" or own is None):
                both = listed([channels[kept[column]].name, channels[k].name])
                detail = f"{both} would both be read as {column}; rename them or map one of them"
                raise Unusable("columns", detail)
            kept.setdefault(column, k)
        elif role_of(column) != "time":
            detail = f"sampled at {own or rate:.6g} Hz, the log at {rate:.6g} Hz; "
            if k in alike:
                others = min(channels[one].start or 0.0 for one in samples)
                late, common = (round(s or 0.0, 6) for s in (channels[k].start, others))
                detail = f"starts at {late:.12g} s, the others at {common:.12g} s; "
            detail += "keep channels of one rate and start in one log"
            refused[column] = Refusal("", "time", detail, channel=column)
    # 999.9999999999999 Hz is an artefact of the division.
    metadata = {} if rate is None else {"sample_rate_hz": f"{rate:.10g}"}
    present = tuple(f"{c.name} [{c.unit}]" if c.unit else c.name for c in channels)
    first = min((samples[k] for k in kept.values()), default=0)
    delays = {column: n for column, k in kept.items() if (n := samples[k] - first)}
    for column, n in delays.items():
        since = f"{n} samples ({n / (rate or 1.0):.6g} s)"
        detail = f"starts {since} after others; all are used where they have samples"
        refused[column] = Refusal("", "gaps", detail, channel=column)
    return kept, Content({}, metadata, present, tuple(refused.values()), late=delays)


def _aligned(channels: Sequence[Described], rate: float | None) -> list[int | None]:
    """Return by how many samples each channel starts after that to which most others fit."""
    # None for a channel that is a fraction of a sample off, or so far that less than
    # `constants.LEAST_COMMON` of its record would be left.
    starts = [0.0 if channel.start is None else channel.start for channel in channels]
    fits: list[list[int | None]] = []
    for start in dict.fromkeys(starts):
        offsets = [0.0 if c.start is None else (c.start - start) * (rate or 0.0) for c in channels]
        found: list[int | None] = [None] * len(channels)
        low = high = 0
        for k in sorted(range(len(channels)), key=lambda k: abs(offsets[k])):
            n, size = round(offsets[k]), channels[k].size
            span = max(high, n) - min(low, n)
            is_exact = abs(offsets[k] - n) <= constants.START_TOLERANCE
            is_exact &= rate is not None or starts[k] == start
            if is_exact and (size < 1 or span <= (1 - constants.LEAST_COMMON) * size):
                found[k], low, high = n, min(low, n), max(high, n)
        fits.append(found)
    # Most channels start at its start; then, most are aligned to it.
    return max(fits, key=lambda fit: (fit.count(0), -fit.count(None)), default=[])


def rate_of(interval: object) -> float | None:
    """Convert an interval in s to a sample rate in Hz; None for an impossible one."""
    if not isinstance(interval, int | float) or not 1e-12 < interval < 1e9:
        return None
    return 1 / float(interval)


def _column(channel: Described, columns: ColumnMap) -> str | None:
    """Name a channel as a column of the log; None if it is not to be read."""
    if channel.name in columns.columns.values():
        return channel.name
    time, unit = (unit_key(channel.unit, kind) for kind in ("time", "acceleration"))
    if role_of(channel.name) is not None:
        column = _with_unit(channel, columns)
    elif columns.target(channel.name) is not None:
        return channel.name
    elif time and channel.rate is None and _TIME.match(channel.name):
        column = f"time_{time}"
    elif columns.columns or (unit is None and not channel.acceleration):
        return None
    else:
        column = "acc_" + re.sub(r"\W+", "_", channel.name).strip("_")
        if unit is not None and column not in columns.units:
            column = f"{column}_{unit}"
    return column if columns.target(column) is not None else None


def _with_unit(channel: Described, columns: ColumnMap) -> str:
    """Complete a name of the contract by the unit of its channel; the two must agree."""
    unit = unit_key(channel.unit)
    if unit is None or channel.name in columns.units:
        return channel.name
    try:
        own = parse_column(channel.name)
    except Unusable:
        return f"{channel.name}_{unit}"
    if parse_column(own.name, unit).factor != own.factor:
        detail = f"channel {channel.name!r} has the unit {channel.unit!r}; they must agree"
        raise Unusable("unit", detail)
    return channel.name


# Columns of times

# End of the note of what was taken for what.
SINCE_EPOCH = "since an epoch"
# Least magnitude of time stamps that count ticks since an epoch, ticks of a second, and that epoch
# as Unix time in s; the last time in s, of the year 2286, that is read in the unit of its column;
# and Unix times from 2001 to 2039 (those of LabVIEW, since 1904, are later).
_TICKS = (
    *((1e18, 1e9, "ns", 0), (1e16, 1e7, "100 ns", -11644473600)),
    *((1e15, 1e6, "µs", 0), (1e12, 1e3, "ms", 0)),
)
_LATEST, _UNIX_TIMES = 1e10, (1e9, 2.2e9)
# Days since 1900 from 1954 to 2173, which spreadsheets write, and their largest step: in s it would
# be a sample rate of 1 MHz.
_DAYS, _DAY_STEP = (2e4, 1e5), 1e-6
# Least sample rate in Hz of ticks in a coarser unit than the column states: a lower one shows no
# modes, and the times are a large count in their own unit.
_LEAST_TICK_RATE = 100.0
# Dates in which the order of day, month and year is open; with points they begin with the day.
_SHORT_DATE = r"^\s*(\d{1,2}[/-]\d{1,2}[/-](?:\d{4}|\d{2})(?!\d))"


class SinceFirst:
    """Conversion of the moments of a column to times since the first, block by block.

    They are in the unit of the column; ``first`` is the earliest moment of the first block.
    """

    def __init__(self, name: str, columns: ColumnMap) -> None:
        self._unit = columns.signal(columns.target(name) or "").factor
        self.first: np.datetime64 | None = None
        self._dates: set[str] = set()  # of which either number may be the day

    def parse(self, text: Any) -> FloatArray:
        """Return the times of a series of text, ``(n,)``; what is no moment is no time.

        `Unusable` (``time``) for several dates like 05/01/2026 or 26-01-05, of which none shows
        their order.
        """
        import pandas as pd

        words = text.astype(str)
        short = words.str.extract(_SHORT_DATE, expand=False).dropna().unique()
        before = bool(_day_first(self._dates)) if self._dates else None
        self._dates = self._dates.union(short)
        day_first = _day_first(self._dates)
        # A single date of either order gives the same times: it is read with the month first.
        is_open = day_first is None or before not in (None, day_first)
        if len(self._dates) > 1 and is_open:
            found = " and ".join(sorted(self._dates)[:2])
            detail = f"dates like {found} may begin with the day or not"
            raise Unusable("time", f"{detail}; write them as YYYY-MM-DD")
        dotted = bool(words.str.match(r"\d{1,2}\.").any())
        text = words.str.replace(",", ".") if text.dtype == object else text
        first = dotted or bool(day_first)
        found = pd.to_datetime(text, errors="coerce", utc=True, dayfirst=first, format="mixed")
        return self(found.dt.tz_localize(None).to_numpy("datetime64[ns]"))

    def __call__(self, moments: np.ndarray) -> FloatArray:
        """Return the times of moments, ``(n,)`` each, NaN where there is none."""
        moments = moments.astype("datetime64[ns]")
        there = moments[~np.isnat(moments)]
        if self.first is None and there.size:
            self.first = there.min()
        if self.first is None:
            return np.full(moments.shape, np.nan)
        return (moments - self.first) / np.timedelta64(1, "ns") * (1e-9 / self._unit)


def _day_first(dates: Iterable[str]) -> bool | None:
    """Return whether short dates begin with the day; None where none shows it."""
    parts = [re.split("[/-]", date) for date in dates]
    # The first number of a date like 26-01-05 may be its year. No record lasts for one: what
    # differs between dates with the same last number is the day.
    firsts, lasts = {first for first, *_ in parts}, {last for *_, last in parts}
    of_days = len(firsts) > len(lasts) == 1
    if any(int(first) > 12 and (of_days or len(year) == 4) for first, _, year in parts):
        return True
    return False if any(int(second) > 12 for _, second, _ in parts) else None


def without_epoch(content: Content, columns: ColumnMap) -> Content:
    """Convert ticks or days since an epoch in columns of times to times since the first.

    Other times stay as they are. `Unusable` (``time``) for times in a fine unit that may be ticks
    in a coarser one, where no sample rate is stated that only one of both readings gives.
    """
    has_rate = columns.sample_rate_hz is not None or "sample_rate_hz" in content.metadata
    for name, samples in content.columns.items():
        if columns.is_time(name) and samples.size:
            try:
                unit = columns.signal(columns.target(name) or "").factor
            except Unusable:
                continue  # a unit that is not stated is refused with the others
            if not has_rate:
                _check_no_ticks(name, samples, unit)
            content.columns[name], guessed, moment = _since_first(samples, unit)
            metadata, guessed = moment | content.metadata, (*content.guessed, *guessed)
            content = replace(content, metadata=metadata, guessed=guessed)
    return content


def _check_no_ticks(name: str, time: Samples, unit: float) -> None:
    """Refuse times in a unit in s that are also ticks of today, at the rate of a vibration."""
    start, step = _start_and_step(time)
    ticks = next((one[1:] for one in _TICKS if abs(start) >= one[0]), None)
    if ticks is None or start * unit >= _UNIX_TIMES[0] or not step > 0:
        return
    scale, what, epoch = ticks
    is_today = _UNIX_TIMES[0] <= start / scale + epoch < _UNIX_TIMES[1]
    if is_today and scale / step >= _LEAST_TICK_RATE:
        found = f"{1 / (step * unit):.6g} Hz, or {scale / step:.6g} Hz as times in {what}"
        cure = "map it to time_s for the second, or state sample_rate_hz in the file or the map"
        raise Unusable("time", f"{name} gives {found} {SINCE_EPOCH}; {cure}")


def _start_and_step(time: Samples) -> tuple[float, float]:
    """Return the first time and the mean step of the first block."""
    first = next((block for _, block in blocks(time)), np.zeros(1))
    return float(first[0]), float(np.ptp(first)) / max(first.size - 1, 1)


def _since_first(time: Samples, unit: float) -> tuple[Samples, tuple[str, ...], dict[str, str]]:
    """Convert ticks or days since an epoch to times since the first, in a unit in s."""
    # Other times stay as they are. Return what was taken for what, and the moment of the
    # first ticks.
    start, step = _start_and_step(time)
    ticks = (one[1:] for one in _TICKS if abs(start) >= one[0] and abs(start) * unit > _LATEST)
    if _DAYS[0] <= start < _DAYS[1] and step < _DAY_STEP:
        scale, what, epoch = 1 / 86400, "days", None
    elif _UNIX_TIMES[0] <= start * unit < _UNIX_TIMES[1]:
        scale, what, epoch = 1 / unit, "", 0
    elif (found := next(ticks, None)) is not None:
        scale, what, epoch = found
    else:
        return time, (), {}
    spool = Spool()
    for _, block in blocks(time):
        spool.append((block - start) / (scale * unit))
    guessed = (f"times in {what} {SINCE_EPOCH}",) if what else ()
    if epoch is None:
        return spool.samples(), guessed, {}
    moment = moment_after(constants.FIRST_MOMENT, start / scale + epoch)
    return spool.samples(), guessed, {"recorded_at": moment}
