"""Files proposed from a log: its column map, and a stage description of the modes found in it.

For a column names and units decide first, the samples where neither does, each with the reason.
"""

import glob
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lmshealth._private.arrays import FloatArray
from lmshealth._private.files import write_text
from lmshealth._private.toml import decode, quoted
from lmshealth.errors import BadLog, BadStage
from lmshealth.io import constants
from lmshealth.io.buffers import MINUTE, Samples, Spool, blocks, in_unit
from lmshealth.io.column_map import SI_TIMES, ColumnMap, Layout, parse_column, role_of, unit_key
from lmshealth.io.formats.content import SINCE_EPOCH, Content, frequency_column, over_frequency
from lmshealth.io.formats.dialect import LOCAL_TIME
from lmshealth.io.formats.registry import load
from lmshealth.io.log import Log, parse_metadata
from lmshealth.io.reading import content_digest
from lmshealth.io.refusal import Unusable, listed, shown, visible
from lmshealth.io.time_axis import time_axis
from lmshealth.stage.description import Description, ModeSpec

# Words in the names of columns, in the languages of exporters, and units of times in names.
_TIME = re.compile(
    r"time|zeit|temps|tiempo|tempo|date|datum|millis|micros|x_value|\bt\b|\.x\.data", re.IGNORECASE
)
_TIME_UNITS = {
    "ms": r"milli|[_(]ms(ec)?\b",
    "us": r"micro|[_(][uµμ]s(ec)?\b",
    "ns": r"nano|[_(]ns(ec)?\b",
    "s": r"(?<!m)(?<!deg)(?<!rad)[_(]s(ec)?\b|second",
}
_SET_POINT = re.compile(r"ref|\bset|cmd|command|soll|target|demand", re.IGNORECASE)
# By prefix of a signal: words, dimension, SI value of one without a unit, and SI unit.
_SIGNALS = {
    "delta_e": (
        "follow|error|deviat|lag|delta|schlepp|regelabw|PE|pos_?(?:diff|err)"
        "|(?<![a-z0-9][_ ])err(?![a-z])",  # alone: crc_err and the like are flags
        *("length", 1e-6, "m"),
    ),
    "acc": ("acc|beschl|vibr", "acceleration", 1.0, "m/s²"),
    "current": ("current(?! *pos| *vel)|strom|courant|i_?q|ampere", "current", 1.0, "A"),
}
# Units in which sensors are recorded without conversion, and words of quantities that are none.
_RAW_UNITS = ("", "-", "counts", "V", "mV", "Volt", "Volts")
_OTHERS = re.compile(r"temp|humid|press|druck|speed|torque|moment|pos(?!t)|vel|status", re.I)
# A vibration crosses its mean so often at least: in all, and as a share of its samples. A spectrum
# or a magnitude rises so much further above its mean than it falls below.
_CROSSINGS, _ONE_SIDED = (50, 0.001), 10.0
_ONE_SIGN = "has one sign, as a spectrum or a magnitude"
# SI values of units of time that are no suffix, and the sample rate in Hz from which on times are
# taken in s without a witness: in ms it would be that of a recorder of 100 kHz.
_LONG_UNITS = {"min": 60.0, "h": 3600.0}
_CERTAIN_RATE = 100.0
# Sample rates in Hz of records of vibrations. Even numbers without a name are times if the rate
# that they give in a unit is so near to that of another source.
_RATES, _NEAR = (1.0, 1e7), 0.1
# A date in the name of a file, with or without a time.
_DATE = re.compile(
    r"(?<!\d)(?P<y>20\d\d)(?P<sep>[-_]?)(?P<m>\d\d)(?P=sep)(?P<d>\d\d)"
    r"(?:[-_T ]?(?P<h>[01]\d|2[0-3])[-_.:h]?(?P<min>[0-5]\d)(?:[-_.:]?(?P<s>[0-5]\d))?)?(?!\d)"
)
_DEPTH = 3  # of structs in structs
# Widest search of a mode, in relative distances of neighbouring modes, and its least value.
_NEIGHBOURS, _LEAST_SEARCH = 2.0, 0.02
# Columns of a map that reads the header only, and function that reads others, with their units.
_NO_COLUMN = {"acc_none": "\0"}
_Load = Callable[..., Content]
_UNIT = re.compile(r"(?P<name>.+) \[(?P<unit>[^\]]*)\]")


class Guess(NamedTuple):
    """What a column of a file is: its name in a log, empty where it is left out, and why."""

    source: str
    target: str
    why: str
    unit: str = ""  # TOML of its unit with a comment, where neither name nor file states one


class _Column:
    """A column of the file: name, unit, samples, and what the first minute of them shows.

    ``moments`` is whether they are moments, read as times in s since the first. Extremes and steps
    are the least value, the mean and the largest value; NaN where no sample is a number.
    """

    def __init__(self, name: str, unit: str, samples: Samples, *, moments: bool = False) -> None:
        self.name, self.unit, self.samples, self.moments = name, unit, samples, moments
        self.first = samples[:MINUTE]
        self._finite = self.first[np.isfinite(self.first)]
        self.extremes = _extremes(self._finite)
        self.steps = _extremes(np.diff(np.where(np.isfinite(self.first), self.first, np.nan)))

    @property
    def is_even(self) -> bool:
        """Whether the samples ascend in equal steps, rounded or not, that do not count rows."""
        low, mean, high = self.steps
        return low > 0 and high - low < mean / 2 and not low == high == 1

    @property
    def n_crossings(self) -> int:
        """Crossings of the mean by values that are no switch or counter of few levels."""
        n_levels = np.unique(self._finite).size
        n = int(np.count_nonzero(np.diff(self._finite > self.extremes[1])))
        return n if n_levels >= constants.FEWEST_LEVELS else 0


def _extremes(x: FloatArray) -> tuple[float, float, float]:
    return (float(x.min()), float(x.mean()), float(x.max())) if x.size else (np.nan,) * 3


def propose(
    path: Path,
    *,
    rate: float | None = None,
    max_memory: float = constants.MAX_MEMORY,
    latest: datetime | None = None,
    layouts: tuple[Layout, ...] = (),
) -> tuple[str, list[Guess]]:
    """Propose the column map of a file, as TOML with comments; return all guesses too.

    Times are read by the functions of `read_log`, with the layouts of the user. ``rate`` is the
    sample rate in Hz where the file has none. `BadLog` if the file cannot be read, nothing in it
    may be a signal, or its sample rate is unknown, contradicted or depends on a unit that nothing
    states.
    """
    label = shown(path)

    def read(columns: dict[str, str], units: dict[str, str | float] | None = None) -> Content:
        how = ColumnMap(columns=columns, units=units or {}, layouts=layouts)
        return load(path, how, max_memory)

    content_digest(path, name=label)
    try:
        content, columns, rest = _columns(read)
        axis = frequency_column(content.present)
        if axis and all(one.is_even for one in columns[:1]):
            raise over_frequency(axis)
        stated = parse_metadata(content.metadata, latest)[1]
        if rate and stated and abs(rate / stated - 1) > constants.AGREEMENT:
            detail = f"the file states {stated:.8g} Hz, --sample-rate is {rate:.8g} Hz"
            raise Unusable("time", f"{detail}; leave the option out, or correct the file")
        times = _times(read, columns, rate or stated)
        others = [one for one in columns if one.name not in times]
        guesses = [*times.values(), *_guesses(others), *rest]
        if not any(g.target.startswith(("delta_e", "acc")) for g in guesses):
            found = "; ".join(f"{g.source}: {g.why}" for g in guesses) or "no columns"
            detail = f"nothing looks like a following error or an acceleration ({found})"
            is_series = others and not any(g.why == _ONE_SIGN for g in guesses)
            step = "write a column map by hand" if is_series else "needed samples over time"
            raise Unusable("columns", f"{detail}; {step}")
        timed = any(g.target.startswith("time") for g in guesses)
        if not timed and rate is None and stated is None:
            why = "".join(f"; {g.source}: {g.why}" for g in times.values())
            detail = f"no column of times and no sample rate; give --sample-rate HZ{why}"
            raise Unusable("time", detail)
    except Unusable as error:
        raise BadLog(label, error.reason, error.detail) from error
    return "\n".join(_lines(label, content, guesses, None if timed else rate)), guesses


def moment_of(path: Path, log: Log, layouts: tuple[Layout, ...] = ()) -> tuple[str, str]:
    """Return when a log was recorded (ISO 8601), and where that is stated; empty where it is not.

    Its header is read with the layouts of the user, too. A moment without a time zone gets that of
    this computer.
    """
    if log.metadata.recorded_at:
        return log.metadata.recorded_at.isoformat(), "stated in the file"
    header = load(path, ColumnMap(columns=_NO_COLUMN, layouts=layouts))
    local = header.metadata.get(LOCAL_TIME, "")
    where = "header of the file"
    if not local and (date := _DATE.search(path.name)):
        clock = f"{date['h']}:{date['min']}:{date['s'] or '00'}" if date["h"] else "00:00"
        local, where = f"{date['y']}-{date['m']}-{date['d']} {clock}", "name of the file"
    try:
        moment = datetime.fromisoformat(local).astimezone().isoformat()
    except (ValueError, OverflowError):
        return "", ""
    return moment, f"{where}, time zone of this computer"


def _columns(load_by: _Load) -> tuple[Content, list[_Column], list[Guess]]:
    """Read all columns as they are; those that hold no such series of numbers are left out."""
    content = load_by(_NO_COLUMN)
    read: dict[str, _Column] = {}
    units: dict[str, str] = {}
    for _ in range(_DEPTH):
        pairs = [(text, _UNIT.fullmatch(text)) for text in content.present]
        every = {m["name"] if m else text: m["unit"] if m else "" for text, m in pairs}
        new, units = [name for name in every if name not in units], every
        for found, moments in _contents(load_by, new):
            # A struct is opened by its name.
            there = max(content.present, found.present, key=len)
            content = replace(content, metadata=content.metadata | found.metadata, present=there)
            for name in set(new) & set(found.columns):
                read[name] = _Column(name, units[name], found.columns[name], moments=moments)
    columns = [read[name] for name in units if name in read]
    sizes = [one.samples.size for one in columns if one.samples.size > 1]
    size = max(sizes, key=lambda n: (sizes.count(n), n), default=0)
    kept = [one for one in columns if one.samples.size == size]
    others = units.keys() - {one.name for one in kept}
    names = listed(name for name in units if name in others)
    rest = [Guess(names, "", f"text, or not {size} numbers")] if others else []
    return content, kept, rest


def _contents(load_by: _Load, names: Sequence[str]) -> Iterator[tuple[Content, bool]]:
    """Yield contents with columns of numbers, as many at once as can be, and with moments."""
    targets = {f"acc_probed_{k}_g": name for k, name in enumerate(names)}
    try:
        if names:
            yield load_by(targets), False
    except Unusable:
        if len(names) > 1:
            for half in (names[: len(names) // 2], names[len(names) // 2 :]):
                yield from _contents(load_by, half)
            return
        with suppress(Unusable):
            found = load_by({"time_s": names[0]})
            if names[0] in found.columns:
                yield found, True


def _times(load_by: _Load, columns: list[_Column], rate: float | None) -> dict[str, Guess]:
    """Guess which column holds the times: the first that states its unit, has a name, or is even.

    Others of them are not read. `Unusable` (``time``) where times contradict the sample rate in Hz,
    or without one may be in several units.
    """
    stated = {one.name: _unit_of(one) for one in columns}
    named = [
        o for o in columns if stated[o.name] or (_TIME.search(o.name) and o.unit in _RAW_UNITS)
    ]
    unnamed = [one for one in columns if one.name.isdecimal() and one.is_even]
    named.sort(key=lambda one: not stated[one.name])
    found: dict[str, Guess] = {}
    open_question = ""
    for one in dict.fromkeys((*named, *unnamed)):
        low, mean, _ = one.steps
        if not (low >= 0 and mean > 0) or role_of(one.name) not in (None, "time"):
            continue
        if any(guess.target for guess in found.values()):
            found[one.name] = Guess(one.name, "", "times, as another column")
            continue
        try:
            found_rate, unit = _rate_of(load_by, one, stated[one.name])
        except Unusable as error:
            found[one.name] = Guess(one.name, "", f"times that cannot be used: {error.detail}")
            continue
        guess = found[one.name] = _in_unit(one, found_rate, unit, rate)
        if rate is None and not guess.target:
            open_question = open_question or guess.why
    if open_question and not any(guess.target for guess in found.values()):
        raise Unusable("time", open_question)
    return found


def _rate_of(load_by: _Load, one: _Column, unit: str) -> tuple[float, str]:
    """Return the sample rate in Hz that `read_log` finds in times, and their unit."""
    target, scale = _time_target(unit or "s")
    content = load_by({target: one.name}, scale)
    factor = parse_column(target, scale.get(target)).factor
    values = in_unit(content.columns[one.name], factor, np.inf)
    is_epoch = any(text.endswith(SINCE_EPOCH) for text in content.guessed)
    rate = time_axis(values, None).sample_rate
    # A counter of another unit may be as large, but not at a rate of vibrations.
    if unit or not is_epoch or rate >= _RATES[0]:
        return rate, unit or ("s" if is_epoch else "")
    since_first = Spool()
    for _, block in blocks(one.samples):
        since_first.append(block - one.first[0])
    return time_axis(since_first.samples(), None).sample_rate, ""


def _time_target(unit: str) -> tuple[str, dict[str, str | float]]:
    """Return the name of times in a unit, and its scale where the name carries none."""
    scale = _LONG_UNITS.get(unit)
    return (f"time_{unit}", {}) if scale is None else ("time", {"time": scale})


def _in_unit(one: _Column, found: float, unit: str, rate: float | None) -> Guess:
    """Guess the unit of times that give a rate in Hz in their unit, or in s if it is not stated."""
    # Where neither decides, the times are not read and the reason asks for the rate; `Unusable`
    # (``time``) where the sample rate of another source does not agree.
    rates = {unit: found} if unit else {u: found / factor for u, factor in SI_TIMES.items()}
    rates = {u: hz for u, hz in rates.items() if _RATES[0] <= hz <= _RATES[1]} or rates
    how = f"in {unit}" if unit else f"in steps of {one.steps[1]:.6g}"
    readings = " or ".join(f"{hz:.6g} Hz in {u}" for u, hz in rates.items())
    fits, witness = [unit] if unit else [], ""
    if rate is not None:
        off = {u: abs(hz / rate - 1) for u, hz in rates.items()}
        fits = [u for u, error in off.items() if error <= constants.AGREEMENT]
        witness = f", as the sample rate is {rate:.6g} Hz"
        if not fits and one.name.isdecimal() and min(off.values()) > _NEAR:
            return Guess(one.name, "", f"ascends {how}, which are no times at {rate:.6g} Hz")
        if not fits:
            detail = f"times {one.name!r} give {readings}, the stated sample rate is {rate:.6g} Hz"
            raise Unusable("time", f"{detail}; correct it, or write a column map by hand")
    elif not unit:
        fits, witness = ["s"] if found >= _CERTAIN_RATE else [], ", taken as s"
    if len(fits) != 1:
        detail = f"column {one.name!r} ascends {how} and nothing states its unit: {readings}"
        step = 'give the right one as --sample-rate HZ, or map it by hand: time_us = "…"'
        return Guess(one.name, "", f"{detail}; {step}")
    target, scale = _time_target(fits[0])
    why = f"times {how}{'' if unit else witness}: {rates[fits[0]]:.6g} Hz"
    factor = "".join(f"{factor!r}  # s per {fits[0]}" for factor in scale.values())
    return Guess(one.name, target, why, factor)


def _unit_of(one: _Column) -> str:
    """Return the unit of times that a column states; empty for another quantity or none."""
    if one.moments:
        return "s"
    own = unit_key(one.unit, "time") or (one.unit if one.unit in _LONG_UNITS else "")
    return own or (_time_unit(one.name) if one.unit in _RAW_UNITS else "")


def _time_unit(name: str) -> str:
    """Return the unit of times that the name of a column holds; empty where it holds none."""
    named = (unit for unit, words in _TIME_UNITS.items() if re.search(words, name, re.I))
    return next(named, "")


def _guesses(columns: list[_Column]) -> list[Guess]:
    """Guess what each column is; all that oscillate are taken where nothing else is a signal."""
    guesses = [_by_name(one) for one in columns]
    if not any(g.target.startswith(("delta_e", "acc")) for g in guesses):
        guesses = [
            _by_samples(one, guess) if one.unit in _RAW_UNITS and not guess.target else guess
            for one, guess in zip(columns, guesses, strict=True)
        ]
    kept: set[str] = set()
    for k, guess in enumerate(guesses):
        target, name = guess.target, guess.target
        for n in range(2, len(guesses) + 2):
            if name not in kept or not target:
                break
            name = _numbered(target, n)
        guesses[k] = guess._replace(target=name)
        kept.add(name)
    return guesses


def _numbered(target: str, n: int) -> str:
    """Write the name of a further signal of the same name, with its number before the unit."""
    try:
        stem = parse_column(target).name
    except Unusable:
        stem = target
    return f"{stem}_{n}{target.removeprefix(stem)}"


def _by_samples(one: _Column, guess: Guess) -> Guess:
    """Guess whether a column without a name or unit of a signal is an accelerometer."""
    low, mean, high = one.extremes
    n, least = one.n_crossings, max(_CROSSINGS[0], _CROSSINGS[1] * one.first.size)
    if low >= 0 and high - mean > _ONE_SIDED * (mean - low):
        return guess._replace(why=_ONE_SIGN)
    if one.moments or n < least or _OTHERS.search(one.name):
        return guess
    why = f"looks like an accelerometer: crosses its mean {n} times in {one.first.size} samples"
    return _signal("acc", one, why)


def _by_name(one: _Column) -> Guess:
    """Guess the quantity of a column from its name and unit."""
    low, _, high = one.extremes
    if not low < high:
        return Guess(one.name, "", "constant")
    if role_of(one.name) is not None:
        return _signal(one.name, one, "named as in a log")
    for what, dimension in (("position", "length"), ("velocity", "velocity")):
        if (unit := unit_key(one.unit, dimension)) and _SET_POINT.search(one.name):
            return Guess(one.name, f"reference_{what}_{unit}", f"set {what} in {one.unit}")
    for prefix, (words, dimension, *_) in _SIGNALS.items():
        known = unit_key(one.unit, dimension) is not None
        # A prefix of lower-case letters may name a type, as in fPosDiff.
        word = re.search(rf"(?<![^\W\d_])(?:[a-z]{{1,2}}(?=[A-Z]))?((?i:{words}))", one.name)
        if known and prefix != "delta_e":
            return _signal(prefix, one, f"its unit is {one.unit}")
        if word and (known or one.unit in _RAW_UNITS):
            return _signal(prefix, one, f"{word[1]!r} is in its name")
    if not one.unit and unit_key(one.name.rpartition("_")[2], "acceleration"):
        return _signal("acc", one, "its name ends in a unit of acceleration")
    return Guess(one.name, "", "neither name nor unit is that of a signal")


def _signal(prefix: str, one: _Column, why: str) -> Guess:
    """Name a signal, with its unit or else the SI value of one."""
    word = re.sub(r"\W+", "_", one.name).strip("_").lower().removeprefix(f"{prefix}_")
    target = prefix if prefix == one.name else f"{prefix}_{word}"
    try:
        parse_column(target)
        return Guess(one.name, target, why)
    except Unusable:
        quantity = next((key for key in _SIGNALS if target.startswith(key)), None)
        if (unit := unit_key(one.unit)) is not None or quantity is None:
            return Guess(one.name, f"{target}_{unit}" if unit else "", why)
    *_, scale, si = _SIGNALS[quantity]
    per = f"{scale:g} {si} per {one.unit or 'count'}"
    assumed = f"{why}; no unit: {per} assumed, on which frequencies and damping do not depend"
    return Guess(one.name, target, assumed, f"{scale!r}  # {visible(per)} is assumed: set it")


def _lines(label: str, content: Content, guesses: list[Guess], rate: float | None) -> Iterator[str]:
    yield f"# Column map proposed by `lmshealth init` from {label}."
    yield "# Check every line: what the file does not state is a guess, with its reason."
    yield "# All keys: lmshealth/io/README.md, Column maps."
    if rate is not None:
        yield f"sample_rate_hz = {rate!r}  # from --sample-rate"
    yield "\n[columns]"
    for g in (g for g in guesses if g.target):
        yield f"{quoted(g.target)} = {quoted(g.source)}  # {visible(g.why)}"
    for g in (g for g in guesses if not g.target):
        yield f"# not read: {quoted(g.source)}: {visible(g.why)}"
    yield "\n[units]"
    for g in (g for g in guesses if g.unit):
        yield f"{quoted(g.target)} = {g.unit}"
    if content.guessed:
        yield f"\n[csv]  # found in the file: {listed(content.guessed)}"
    yield ""


def searches(frequencies: Sequence[float]) -> list[float]:
    """Return the search of each mode, ascending in Hz: the default, less near a neighbour."""
    gaps = [np.inf, *(float(np.log(high / low)) for low, high in pairwise(frequencies)), np.inf]
    nearest = [min(pair) for pair in pairwise(gaps)][: len(frequencies)]
    most = ModeSpec("", 1.0, 0.01).search
    return [min(most, max(_LEAST_SEARCH, _NEIGHBOURS * gap)) for gap in nearest]


def write_skeleton(
    path: Path,
    source: str,
    stage: str | None,
    modes: Sequence[tuple[ModeSpec, str]],
    *,
    odometer: bool = True,
) -> None:
    """Write a description of modes, each with a comment, that `load_stage` reads as it is.

    ``stage`` is the machine of the log, ``source`` a note on the origin of the modes. Without an
    odometer in the logs the clock is the time. A file that exists is replaced. `BadStage` if there
    is no mode, or the name of the file, which the description has too, is too long or has
    characters that cannot be seen; `BadTable` if it cannot be written.
    """
    if not modes:
        raise BadStage(f"{path} is not written: a description needs at least one mode; none found")
    from jinja2 import Template  # late: only this needs it

    layout = (Path(__file__).parent / "descriptions" / "skeleton.toml.j2").read_text("utf-8")
    template = Template(layout, trim_blocks=True, keep_trailing_newline=True)
    machines = glob.escape(stage) if stage else "*"
    given = {"name": path.stem, "source": source, "stage": machines, "odometer": odometer}
    text = template.render(given, modes=modes, quoted=quoted)
    try:
        decode(text.encode(), Description)
    except ValueError as error:
        raise BadStage(f"{path} is not written, as it could not be read: {error}") from error
    write_text(path, text)
