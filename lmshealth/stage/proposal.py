"""Files proposed from a log: its column map, and a stage description of the modes found in it.

For a column names and units decide first, the samples where neither does, each with the reason.
"""

import glob
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth._files import write_text
from lmshealth._toml import quoted
from lmshealth.errors import BadLog, BadStage
from lmshealth.io import constants
from lmshealth.io.column_map import ColumnMap, parse_column, role_of, unit_key
from lmshealth.io.formats.content import Content
from lmshealth.io.formats.registry import load
from lmshealth.io.formats.text_layouts import LOCAL_TIME
from lmshealth.io.log import Log
from lmshealth.io.reading import content_digest
from lmshealth.io.refusal import Unusable, listed, shown, visible
from lmshealth.stage.description import ModeSpec

# Words in the names of columns, in the languages of exporters, and units of times in names.
_TIME = re.compile(
    r"time|zeit|temps|tiempo|tempo|date|datum|millis|micros|x_value|\bt\b|\.x\.data", re.IGNORECASE
)
_TIME_UNITS = {"ms": r"millis|[_(]ms\b", "us": r"micros|[_(][uµ]s\b", "s": r"[_(]s\b|second"}
_SET_POINT = re.compile(r"ref|\bset|cmd|command|soll|target|demand", re.IGNORECASE)
# By prefix of a signal: words, dimension, SI value of one without a unit, and SI unit.
_SIGNALS = {
    "delta_e": ("follow|error|deviat|lag|delta|schlepp|regelabw|PE|pos_?diff", "length", 1e-6, "m"),
    "acc": ("acc|beschl|vibr", "acceleration", 1.0, "m/s²"),
    "current": ("current(?! *pos| *vel)|strom|courant|i_?q|ampere", "current", 1.0, "A"),
}
# Units in which sensors are recorded without conversion, and samples from which columns are judged.
_RAW_UNITS = ("", "-", "counts", "V", "mV", "Volt", "Volts")
_JUDGED = 1 << 16
# A vibration crosses its mean so often at least: in all, and as a share of its samples.
_CROSSINGS = 50, 0.001
# Columns that only oscillate of which so many are taken, those that do it slowest.
_MOST_GUESSED = 3
# Sample rates in Hz by which the unit of times without one is chosen.
_RATES = {"s": (10.0, 2e5), "ms": (20.0, 2e5), "us": (20.0, 2e6)}
# A date in the name of a file, with or without a time.
_DATE = re.compile(
    r"(?<!\d)(?P<y>20\d\d)(?P<sep>[-_]?)(?P<m>\d\d)(?P=sep)(?P<d>\d\d)"
    r"(?:[-_T ]?(?P<h>[01]\d|2[0-3])[-_.:h]?(?P<min>[0-5]\d)(?:[-_.:]?(?P<s>[0-5]\d))?)?(?!\d)"
)
_DEPTH = 3  # of structs in structs
# Widest search of a mode, in relative distances of neighbouring modes, and its least value.
_NEIGHBOURS, _LEAST_SEARCH = 2.0, 0.02
_UNIT = re.compile(r"(?P<name>.+) \[(?P<unit>[^\]]*)\]")


class Guess(NamedTuple):
    """What a column of a file is: its name in a log, empty where it is left out, and why."""

    source: str
    target: str
    why: str
    unit: str = ""  # TOML of its unit with a comment, where neither name nor file states one


class _Column(NamedTuple):
    name: str
    unit: str
    values: FloatArray  # the first samples, ``(n,)``
    size: int


def propose(
    path: Path, *, rate: float | None = None, max_memory: float = constants.MAX_MEMORY
) -> tuple[str, list[Guess]]:
    """Propose the column map of a file, as TOML with comments; return all guesses too.

    ``rate`` is the sample rate in Hz where the file has none. `BadLog` if the file cannot be read
    or nothing in it may be a signal.
    """
    label = shown(path)
    content_digest(path, name=label)
    try:
        content, columns, guesses = _columns(path, max_memory)
        guesses = [*_guesses(columns), *guesses]
        if not any(g.target.startswith(("delta_e", "acc")) for g in guesses):
            found = "; ".join(f"{g.source}: {g.why}" for g in guesses) or "no columns"
            detail = f"nothing looks like a following error or an acceleration ({found})"
            raise Unusable("columns", f"{detail}; write a column map by hand")
        timed = any(g.target.startswith("time") for g in guesses)
        if not timed and rate is None and "sample_rate_hz" not in content.metadata:
            raise Unusable("time", "no column of times and no sample rate; give --sample-rate HZ")
    except Unusable as error:
        raise BadLog(label, error.reason, error.detail) from error
    return "\n".join(_lines(label, content, guesses, None if timed else rate)), guesses


def moment_of(path: Path, log: Log) -> tuple[str, str]:
    """Return when a log was recorded (ISO 8601), and where that is stated; empty where it is not.

    A moment without a time zone gets that of this computer.
    """
    if log.metadata.recorded_at:
        return log.metadata.recorded_at.isoformat(), "stated in the file"
    local = load(path, ColumnMap(columns={"acc_none": "\0"})).metadata.get(LOCAL_TIME, "")
    where = "header of the file"
    if not local and (date := _DATE.search(path.name)):
        clock = f"{date['h']}:{date['min']}:{date['s'] or '00'}" if date["h"] else "00:00"
        local, where = f"{date['y']}-{date['m']}-{date['d']} {clock}", "name of the file"
    try:
        moment = datetime.fromisoformat(local).astimezone().isoformat()
    except (ValueError, OverflowError):
        return "", ""
    return moment, f"{where}, time zone of this computer"


def _columns(path: Path, max_memory: float) -> tuple[Content, list[_Column], list[Guess]]:
    """Read all columns as they are; those that hold no such series of numbers are left out."""
    content = load(path, ColumnMap(), max_memory)
    left_out: list[str] = []
    read: dict[str, _Column] = {}
    for _ in range(_DEPTH):
        pairs = [(text, _UNIT.fullmatch(text)) for text in content.present]
        units = {m["name"] if m else text: m["unit"] if m else "" for text, m in pairs}
        for name in (name for name in units if name not in [*left_out, *read]):
            own = unit_key(units[name], "time") or _time_unit(name)
            key = f"time_{own or 's'}" if own or _TIME.search(name) else "acc_probed"
            try:
                found = load(path, ColumnMap(columns={key: name}), max_memory)
                # A struct is opened by its name.
                there = max(content.present, found.present, key=len)
                content = replace(
                    content, metadata=content.metadata | found.metadata, present=there
                )
                samples = found.columns[name]
                values = np.asarray(samples[:_JUDGED], dtype=np.float64)
                read[name] = _Column(name, units[name], values, samples.size)
            except (Unusable, KeyError):
                left_out.append(name)
    sizes = [one.size for one in read.values() if one.size > 1]
    size = max(sizes, key=lambda n: (sizes.count(n), n), default=0)
    others = [*left_out, *(one.name for one in read.values() if one.size != size)]
    rest = [Guess(listed(others), "", f"text, or not {size} numbers")] if others else []
    return content, [one for one in read.values() if one.size == size], rest


def _guesses(columns: list[_Column]) -> list[Guess]:
    """Guess what each column is; what only oscillates is taken where nothing else is a signal."""
    guesses = [_time(one) or _by_name(one) for one in columns]
    if not any(g.target.startswith(("delta_e", "acc")) for g in guesses):
        n = {k: _crossings(columns[k].values) for k, g in enumerate(guesses) if not g.target}
        least = max(_CROSSINGS[0], _CROSSINGS[1] * max((c.values.size for c in columns), default=0))
        fits = [k for k in n if columns[k].unit in _RAW_UNITS and n[k] >= least]
        for k in sorted(fits, key=n.__getitem__)[:_MOST_GUESSED]:
            why = f"looks like an accelerometer: crosses its mean {n[k]} times"
            guesses[k] = _signal("acc", columns[k], f"{why} in {columns[k].values.size} samples")
    kept: set[str] = set()
    for k, guess in enumerate(guesses):
        what = guess.target.partition("_")[0] if guess.target.startswith("time") else guess.target
        if what in kept:
            guesses[k] = guess._replace(target="", why=f"{guess.why}, as another column")
        kept |= {what} - {""}
    return guesses


def _time(one: _Column) -> Guess | None:
    """Guess a column of times: ascending, with the name or unit of times, or unnamed."""
    unit, steps = unit_key(one.unit, "time") or _time_unit(one.name), np.diff(one.values)
    if steps.size < 1 or not (steps > 0).all():
        return None
    step = float(np.median(steps))
    if even := bool(np.ptp(steps) < step / 2):
        step = float(steps.mean())  # of rounded times
    # Steps of 1 count rows.
    unnamed = one.name.isdecimal() and even and step != 1
    if not (_TIME.search(one.name) or unit or unnamed):
        return None
    rates = {u: 1 / (step * parse_column(f"time_{u}").factor) for u in _RATES}
    fits = (u for u, (low, high) in _RATES.items() if low <= rates[u] <= high)
    taken = unit or next(fits, None)
    if taken is None:
        return None
    how = f"in {unit}" if unit else f"in steps of {step:.6g}, taken as {taken}"
    return Guess(one.name, f"time_{taken}", f"times {how}: {rates[taken]:.6g} Hz")


def _time_unit(name: str) -> str | None:
    """Return the unit of times that the name of a column holds."""
    return next((unit for unit, words in _TIME_UNITS.items() if re.search(words, name, re.I)), None)


def _by_name(one: _Column) -> Guess:
    """Guess the quantity of a column from its name and unit."""
    finite = one.values[np.isfinite(one.values)]
    if not finite.size or np.ptp(finite) == 0:
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


def _crossings(values: FloatArray) -> int:
    """Count crossings of the mean by values that are no switch or counter of few levels."""
    values = values[np.isfinite(values)]
    if np.unique(values).size < constants.FEWEST_LEVELS:
        return 0
    return int(np.count_nonzero(np.diff(values > values.mean())))


def _lines(label: str, content: Content, guesses: list[Guess], rate: float | None) -> Iterator[str]:
    """Write the column map."""
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
    path: Path, source: str, stage: str | None, modes: Sequence[tuple[ModeSpec, str]]
) -> None:
    """Write a description of modes, each with a comment, that `load_stage` reads as it is.

    ``stage`` is the machine of the log, ``source`` a note on the origin of the modes. A file that
    exists is replaced. `BadStage` if there is no mode, `BadTable` if it cannot be written.
    """
    if not modes:
        raise BadStage(f"{path} is not written: a description needs at least one mode; none found")
    from jinja2 import Template  # late: only this needs it

    layout = (Path(__file__).parent / "descriptions" / "skeleton.toml.j2").read_text("utf-8")
    template = Template(layout, trim_blocks=True, keep_trailing_newline=True)
    machines = glob.escape(stage) if stage else "*"
    given = {"name": path.stem, "source": source, "stage": machines, "modes": modes}
    write_text(path, template.render(given, quoted=quoted))
