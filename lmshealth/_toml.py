"""Decode TOML into structs; every error names line and key."""

from __future__ import annotations

import re
import tomllib
from bisect import bisect_left
from collections.abc import Callable, Iterable
from functools import reduce
from operator import getitem
from typing import Any, TypeVar

import msgspec
from msgspec.inspect import StructType, Type, UnionType, VarTupleType, type_info

# A hundred modes take a tenth of it.
_MOST_BYTES = 1 << 17
# A statement of more lines is a string or an array without end.
_MOST_LINES = 500

Kind = TypeVar("Kind")
Keys = tuple[str | int, ...]

_PLACE = re.compile(r" - at `\$(?P<path>.*)`$")
_STEP = re.compile(r"\.([^.\[\]]+)|\[(\d+)\]")
# msgspec does not name the wrong value of a table with free keys.
_ANY_VALUE = "[...]"
_FIELD = re.compile(r"Object (?P<what>contains unknown|missing required) field `(?P<field>.*)`$")


def decode(content: bytes, kind: type[Kind]) -> Kind:
    """Decode TOML into a msgspec struct.

    `ValueError` where it is no TOML or breaks the schema: with line, key, what was found and what
    is needed.
    """
    text = _text(content)
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        line = _first(text, lambda table: table is None)
        raise ValueError(f"line {line}: no TOML: {error}") from error
    except RecursionError as error:
        raise ValueError("no TOML that can be read: it is nested too deeply") from error
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        keys, message = _explained(str(error), table, type_info(kind))
        raise ValueError(f"{place(content, *keys)}: {message}") from error


def place(content: bytes, *keys: str | int) -> str:
    """Name a key of a TOML file with its line, such as ``line 12: mode[1].damping_ratio``.

    The keys are names of tables and keys, and places in arrays. For a missing key the line is that
    of the table which lacks it.
    """
    shown = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys)
    text = _text(content)
    table, found = tomllib.loads(text), keys
    while found and not _holds(table, found):
        found = found[:-1]
    line = f"line {_first(text, lambda table: _holds(table, found))}: " if found else ""
    return line + shown.lstrip(".")


def _text(content: bytes) -> str:
    if len(content) > _MOST_BYTES:
        raise ValueError(f"{len(content)} bytes are too many; needed at most {_MOST_BYTES}")
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise ValueError(f"line {line}: byte {content[error.start]:#04x} is not UTF-8") from error


def _first(text: str, reached: Callable[[Any], bool]) -> int:
    """Find the line at which the statement begins that satisfies a monotonic condition.

    The condition is called with the file up to the end of a statement, None where that is no TOML.
    """
    lines = text.split("\n")
    # Statements may continue in the next line: their ends are where the lines since are TOML.
    ends = [0]
    for last in range(1, len(lines) + 1):
        if last > ends[-1] + _MOST_LINES:
            break
        if _loaded("\n".join(lines[ends[-1] : last])) is not None:
            ends.append(last)
    k = bisect_left(ends, True, key=lambda last: reached(_loaded("\n".join(lines[:last]))))
    return 1 + ends[k - 1]


def _loaded(text: str) -> dict[str, Any] | None:
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError):
        return None


def _holds(table: Any, keys: Keys) -> bool:
    try:
        _value(table, keys)
    except (KeyError, IndexError, TypeError):
        return False
    return True


def _value(table: Any, keys: Keys) -> Any:
    return reduce(getitem, keys, table)


def _explained(error: str, table: Any, schema: Type) -> tuple[Keys, str]:
    """Convert msgspec's message into keys and a message with the known names."""
    path = ""
    if found := _PLACE.search(error):
        error, path = error[: found.start()], found["path"]
    if path.endswith(_ANY_VALUE):
        error = f"one of its values: {error}"
    keys: Keys = tuple(name or int(index) for name, index in _STEP.findall(path))
    if field := _FIELD.match(error):
        name = field["field"]
        tags = _tags(schema, (*keys, name))
        if "missing" in field["what"]:
            return (*keys, name), f"missing; there are {_listed(tags)}" if tags else "missing"
        return (*keys, name), f"unknown key; known are {_listed(_fields(schema, keys, table))}"
    value = _value(table, keys)
    if error.startswith("Invalid value") and (tags := _tags(schema, keys)):
        error = f"there are {_listed(tags)}"
    if "matching regex" in error:
        error = "needed printable text"
    if "got" not in error and not isinstance(value, dict | list):
        error = f"{error}, got {value!r}"
    return keys, error.replace("object", "table")


def _tags(schema: Type, keys: Keys) -> list[object]:
    """List the values of a key that selects one of several structs."""
    return [part.tag for part in _structs(schema, keys[:-1]) if part.tag_field == keys[-1]]


def _fields(schema: Type, keys: Keys, table: Any) -> list[str]:
    parts = _structs(schema, keys)
    own = _value(table, keys)
    selected = [part for part in parts if part.tag_field and part.tag == own.get(part.tag_field)]
    part = (selected or parts)[0]
    tag = [part.tag_field] if part.tag_field else []
    return [*tag, *(field.encode_name for field in part.fields)]


def _structs(schema: Type, keys: Keys) -> list[StructType]:
    """List the structs that may be at a place of the schema."""
    types = list(_branches(schema))
    for key in keys:
        types = [inner for one in types for inner in _inside(one, key)]
    return [one for one in types if isinstance(one, StructType)]


def _inside(schema: Type, key: str | int) -> Iterable[Type]:
    if isinstance(schema, VarTupleType):
        yield from _branches(schema.item_type)
    for field in schema.fields if isinstance(schema, StructType) else ():
        if field.encode_name == key:
            yield from _branches(field.type)


def _branches(schema: Type) -> Iterable[Type]:
    return schema.types if isinstance(schema, UnionType) else (schema,)


def _listed(names: Iterable[object]) -> str:
    return ", ".join(map(str, names))
