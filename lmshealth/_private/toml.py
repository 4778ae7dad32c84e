"""Decode TOML into structs, of which errors name every wrong key; write values of TOML."""

import json
import math
import re
import tomllib
from collections.abc import Iterator
from difflib import get_close_matches
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import msgspec
from msgspec.structs import FieldInfo, fields

# A hundred modes take a tenth of it.
_MOST_BYTES = 1 << 17
# Parts of a dotted key; the schemas have four. tomllib takes the square of their number in time.
_MOST_PARTS = 16
# Each word is tried once, and given back by none: the time is linear.
_WORD = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_WORD}(?:[ \t]*+\.[ \t]*+{_WORD}){{{_MOST_PARTS},}}+")
_LONGEST_PLACE, _LONGEST_MESSAGE, _MOST_MISTAKES = 80, 400, 12

Kind = TypeVar("Kind")

_PLACE = re.compile(r" - at `\$(?P<path>.*)`$")


def decode(content: bytes, kind: type[Kind]) -> Kind:
    """Decode TOML into a msgspec struct.

    `ValueError` where it is no TOML, with the line if there is one, or breaks the schema: with
    every wrong key, what was found and what is needed, and an example of each
    table that lacks keys.
    """
    if len(content) > _MOST_BYTES:
        raise ValueError(f"{len(content)} bytes are too many; needed at most {_MOST_BYTES}")
    try:
        text = content.decode("utf-8-sig")
        if found := _LONG_KEY.search(text):
            line = text.count("\n", 0, found.start()) + 1
            raise ValueError(f"line {line}: a key of more than {_MOST_PARTS} parts")
        table = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"no TOML: {error}") from error
    except RecursionError as error:
        raise ValueError("no TOML that can be read: it is nested too deeply") from error
    for path, value in _not_finite(table):
        got = f"needed a finite number, got {_short(repr(value))}"
        raise ValueError(f"{_short(path.lstrip('.'))}: {got}")
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        raise ValueError(_described(kind, table)) from error


def within(low: float, high: float, *examples: Any) -> msgspec.Meta:
    """Return the annotation of a number by its range, with examples for messages."""
    return msgspec.Meta(ge=low, le=high, examples=list(examples) or None)


def _not_finite(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield place and value of numbers that are infinite, NaN, or integers beyond 64 bits."""
    if isinstance(value, float | int):
        # No key means such integers, which few libraries can store.
        if not abs(value) < (math.inf if isinstance(value, float) else 1 << 63):
            yield path, value
    elif isinstance(value, dict):
        for key, one in value.items():
            yield from _not_finite(one, f"{path}.{key}")
    elif isinstance(value, list):
        for k, one in enumerate(value):
            yield from _not_finite(one, f"{path}[{k}]")


def quoted(text: str) -> str:
    """Return a basic string of TOML."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _described(kind: Any, table: dict[str, Any]) -> str:
    """List the mistakes of a table, and write an example of each part of it that lacks keys."""
    faults = [(path.lstrip("."), text) for path, text in _faults(kind, table, "")]
    lacking = [path for path, text in faults if text == "missing"]
    wrong = [f"{_short(path)}: {text}".lstrip(": ") for path, text in faults if text != "missing"]
    if lacking:
        wrong.insert(0, f"{', '.join(map(_short, lacking))}: missing")
    wrong[_MOST_MISTAKES:] = [f"{len(wrong[_MOST_MISTAKES:])} more"] * (len(wrong) > _MOST_MISTAKES)
    lines = [_short(line, _LONGEST_MESSAGE) for line in wrong]
    message = lines[0] if len(lines) == 1 else "\n  ".join(["several mistakes", *lines])
    names = {re.split(r"[.[]", path)[0] for path in lacking}
    parts = [_part(field) for field in fields(kind) if field.encode_name in names]
    return "\n\n".join([message + "\nTo copy and edit:" * bool(parts), *parts])


def _part(field: FieldInfo) -> str:
    """Write a key of the document with an example of its value, a table under its head."""
    name, value = field.encode_name, _example(field.type)
    table = value[0] if isinstance(value, list) else value
    if not isinstance(table, dict):
        return f"{name} = {_literal(value)}"
    head = f"[[{name}]]" if isinstance(value, list) else f"[{name}]"
    return "\n".join([head, *(f"{key} = {_literal(one)}" for key, one in table.items())])


def _literal(value: Any) -> str:
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, list):
        return f"[{', '.join(map(_literal, value))}]"
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {_literal(one)}' for key, one in value.items())} }}"
    return repr(value)


def _example(kind: Any) -> Any:
    """Return a valid value by the examples of the schema."""
    if stated := _examples(kind):
        return stated[0]
    if item := _item(kind):
        return [_example(item)]
    if not (parts := _structs(kind)):
        return None
    settings = parts[0].__struct_config__
    tagged = {settings.tag_field: settings.tag} if settings.tag_field else {}
    used = (field for field in fields(parts[0]) if field.required or _examples(field.type))
    return tagged | {field.encode_name: _example(field.type) for field in used}


def _examples(kind: Any) -> list[Any]:
    """Return the examples that an annotation states itself."""
    notes = get_args(kind)[1:] if get_origin(kind) is Annotated else ()
    return [one for note in notes if isinstance(note, msgspec.Meta) for one in note.examples or ()]


def _short(text: str, most: int = _LONGEST_PLACE) -> str:
    """Keep both ends of a text, and escape what cannot be seen."""
    if len(text) > most:
        text = f"{text[: most // 2]} … {text[-most // 2 :]}"
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def _faults(kind: Any, value: Any, path: str) -> Iterator[tuple[str, str]]:
    """Yield the place and text of each mistake in a value, the innermost only."""
    inner: list[tuple[str, str]] = []
    if isinstance(value, list) and (item := _item(kind)):
        for k, one in enumerate(value):
            inner += _faults(item, one, f"{path}[{k}]")
    elif isinstance(value, dict) and (item := _free(kind)):
        for key, one in value.items():
            inner += _faults(item, one, f"{path}.{key}")
    elif isinstance(value, dict) and (parts := _structs(kind)):
        part, tag = _selected(parts, value)
        if part is None:
            tags = ", ".join(str(one.__struct_config__.tag) for one in parts)
            got = f"there are {tags}, got {value[tag]!r}" if tag in value else ""
            yield f"{path}.{tag}", got or f"missing; there are {tags}"
            return
        known = {field.encode_name: field for field in fields(part)}
        absent = [key for key, field in known.items() if field.required and key not in value]
        inner += [(f"{path}.{key}", "missing") for key in absent]
        for key, one in value.items():
            if key in known:
                inner += _faults(known[key].type, one, f"{path}.{key}")
            elif key != tag:
                inner.append((f"{path}.{key}", _unknown(key, [*filter(None, [tag]), *known])))
    yield from inner or _wrong(kind, value, path)


def _unknown(key: str, known: list[str]) -> str:
    near = [f"; most like it is {one}" for one in get_close_matches(key, known, 1)]
    return "".join([f"unknown key; known are {', '.join(known)}", *near])


def _wrong(kind: Any, value: Any, path: str) -> Iterator[tuple[str, str]]:
    """Yield what msgspec finds wrong with a value as a whole."""
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError as caught:
        error = str(caught)
        if found := _PLACE.search(error):
            error, path = error[: found.start()], path + found["path"]
        if "matching regex" in error:
            error = "needed printable text"
        if bounds := _bounds(kind) if isinstance(value, float | int) else None:
            error = "needed a number from {:g} to {:g}".format(*bounds)
        if "got" not in error and not isinstance(value, dict | list):
            error = f"{error}, got {_short(repr(value))}"
        yield path, error.replace("object", "table")


def _bounds(kind: Any) -> tuple[float, float] | None:
    """Return the range that an annotation, or an alternative of it, states by `within`."""
    if get_origin(kind) is Annotated:
        notes = (one for one in get_args(kind)[1:] if isinstance(one, msgspec.Meta))
        own = next(((m.ge, m.le) for m in notes if m.ge is not None and m.le is not None), None)
        return own or _bounds(get_args(kind)[0])
    if get_origin(kind) in (Union, UnionType):
        return next(filter(None, map(_bounds, get_args(kind))), None)
    return None


def _branches(kind: Any) -> Iterator[Any]:
    """Yield the alternatives of an annotation, without their constraints."""
    if get_origin(kind) is Annotated:
        yield from _branches(get_args(kind)[0])
    elif get_origin(kind) in (Union, UnionType):
        for one in get_args(kind):
            yield from _branches(one)
    else:
        yield kind


def _structs(kind: Any) -> list[Any]:
    return [
        one for one in _branches(kind) if isinstance(one, type) and issubclass(one, msgspec.Struct)
    ]


def _item(kind: Any) -> Any:
    """Return the annotation of the items of an array, all alike; None if it is none."""
    for one in _branches(kind):
        inner = get_args(one)
        if get_origin(one) is list or (get_origin(one) is tuple and len({*inner} - {...}) == 1):
            return inner[0]
    return None


def _free(kind: Any) -> Any:
    """Return the annotation of the values of a table with free keys; None if it is none."""
    tables = (get_args(one)[1] for one in _branches(kind) if get_origin(one) is dict)
    return next(tables, None)


def _selected(parts: list[Any], value: dict[str, Any]) -> tuple[Any, str | None]:
    """Return the struct that a table selects by its tag, or the only one; and the tag's key."""
    tag = parts[0].__struct_config__.tag_field
    if len(parts) == 1:
        return parts[0], tag
    fitting = (one for one in parts if one.__struct_config__.tag == value.get(tag))
    return next(fitting, None), tag
