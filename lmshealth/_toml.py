"""Decode TOML into structs, of which every error names the key; write strings of TOML."""

import json
import re
import tomllib
from collections.abc import Iterable, Iterator
from functools import reduce
from operator import getitem
from typing import Any, TypeVar

import msgspec
from msgspec.inspect import StructType, Type, UnionType, VarTupleType, type_info

# A hundred modes take a tenth of it.
_MOST_BYTES = 1 << 17
# Parts of a dotted key; the schemas have four. tomllib takes the square of their number in time.
_MOST_PARTS = 16
# Each word is tried once, and given back by none: the time is linear.
_WORD = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_WORD}(?:[ \t]*+\.[ \t]*+{_WORD}){{{_MOST_PARTS},}}+")
_LONGEST_PLACE, _LONGEST_MESSAGE = 80, 400

Kind = TypeVar("Kind")

_PLACE = re.compile(r" - at `\$(?P<path>.*)`$")
_STEP = re.compile(r"\.([^.\[\]]+)|\[(\d+)\]")
# msgspec does not name the wrong value of a table with free keys.
_ANY_VALUE = "[...]"
_FIELD = re.compile(r"Object (?P<what>contains unknown|missing required) field `(?P<field>.*)`$")


def decode(content: bytes, kind: type[Kind]) -> Kind:
    """Decode TOML into a msgspec struct.

    `ValueError` where it is no TOML, with the line if there is one, or breaks the schema: with the
    key, what was found and what is needed.
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
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        schema = type_info(kind)
        message = _explained(str(error), table, schema).lstrip(".: ")
        lacking = [_short(one.lstrip("."), _LONGEST_PLACE) for one in _missing(schema, table)]
        if message.removesuffix(": missing") in lacking:
            message = f"{', '.join(lacking)}: missing"
        raise ValueError(_short(message, _LONGEST_MESSAGE)) from error


def quoted(text: str) -> str:
    """Return a basic string of TOML."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _short(text: str, most: int) -> str:
    """Keep both ends of a text, and escape what cannot be seen."""
    if len(text) > most:
        text = f"{text[: most // 2]} … {text[-most // 2 :]}"
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def _explained(error: str, table: Any, schema: Type) -> str:
    """Convert msgspec's message into one that begins with the key and has the known names."""
    path = ""
    if found := _PLACE.search(error):
        error, path = error[: found.start()], found["path"]
    if path.endswith(_ANY_VALUE):
        path, error = path.removesuffix(_ANY_VALUE), f"one of its values: {error}"
    keys = [name or int(index) for name, index in _STEP.findall(path)]
    value = reduce(getitem, keys, table)
    if field := _FIELD.match(error):
        name, parts = field["field"], _structs(schema, keys)
        if "missing" in field["what"]:
            tags = [str(part.tag) for part in parts if part.tag_field == name]
            error = f"missing; there are {', '.join(tags)}" if tags else "missing"
        else:
            error = f"unknown key; known are {', '.join(_known_keys(parts, value))}"
        return f"{_short(f'{path}.{name}', _LONGEST_PLACE)}: {error}"
    if error.startswith("Invalid value"):
        tags = [str(part.tag) for part in _structs(schema, keys[:-1]) if part.tag_field == keys[-1]]
        error = f"there are {', '.join(tags)}" if tags else error
    if "matching regex" in error:
        error = "needed printable text"
    if "got" not in error and not isinstance(value, dict | list):
        error = f"{error}, got {_short(repr(value), _LONGEST_PLACE)}"
    return f"{_short(path, _LONGEST_PLACE)}: {error.replace('object', 'table')}"


def _known_keys(parts: list[StructType], own: dict[str, Any]) -> list[str]:
    """List the keys of the struct that a table selects by its tag, or of the only one."""
    selected = (part for part in parts if part.tag_field and part.tag == own.get(part.tag_field))
    part = next(selected, parts[0])
    return [*filter(None, [part.tag_field]), *(field.encode_name for field in part.fields)]


def _missing(schema: Type, value: Any, path: str = "") -> Iterator[str]:
    """Yield the places of all required keys that a table lacks."""
    if isinstance(value, list):
        lists = [part for part in _branches(schema) if isinstance(part, VarTupleType)]
        for k, item in enumerate(value if lists else ()):
            yield from _missing(lists[0].item_type, item, f"{path}[{k}]")
    if not isinstance(value, dict):
        return
    parts = [one for one in _branches(schema) if isinstance(one, StructType)]
    if len(parts) > 1:
        parts = [one for one in parts if one.tag_field and one.tag == value.get(one.tag_field)]
    for field in parts[0].fields if parts else ():
        place = f"{path}.{field.encode_name}"
        if field.encode_name in value:
            yield from _missing(field.type, value[field.encode_name], place)
        elif field.required:
            yield place


def _structs(schema: Type, keys: list[Any]) -> list[StructType]:
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
