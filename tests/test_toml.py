"""TOML: mistakes are named by line and key, wherever and however the key is written."""

from __future__ import annotations

from typing import Annotated

import pytest
from msgspec import Meta, Struct

from lmshealth._toml import decode, place

TEXT = """# a comment

title = "one"
text = '''
[part]
size = 1
'''
limits = [
    1.0,
    2.0,
]
point = { x = 1, y = { z = 2 } }
dotted.key = 5

[[part]]
size = 1

[part.inner]
depth = 1

[[part]]
size = 2
[part.inner]   # of the second
"depth" = 2

[a.b]
c = 3
"""


class _Leaf(Struct, forbid_unknown_fields=True, tag="leaf", tag_field="kind"):
    size: Annotated[float, Meta(gt=0)]


class _Branch(Struct, forbid_unknown_fields=True, tag="branch", tag_field="kind"):
    leaves: tuple[_Leaf, ...] = ()


class _Tree(Struct, forbid_unknown_fields=True):
    name: str
    part: tuple[_Leaf | _Branch, ...] = ()


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize(
    ("keys", "shown"),
    [
        (("title",), "line 3: title"),
        (("text",), "line 4: text"),
        (("limits", 1), "line 8: limits[1]"),
        (("point", "y", "z"), "line 12: point.y.z"),
        (("dotted", "key"), "line 13: dotted.key"),
        (("part", 0), "line 15: part[0]"),
        (("part", 0, "size"), "line 16: part[0].size"),
        (("part", 0, "inner"), "line 18: part[0].inner"),
        (("part", 0, "inner", "depth"), "line 19: part[0].inner.depth"),
        (("part", 1, "inner", "depth"), "line 24: part[1].inner.depth"),
        (("a", "b", "c"), "line 27: a.b.c"),
    ],
)
def test_a_key_is_found_on_its_line(keys: tuple[str | int, ...], shown: str, newline: str) -> None:
    """Strings and arrays of several lines count from their first; inline tables have one line."""
    assert place(TEXT.replace("\n", newline).encode(), *keys) == shown


@pytest.mark.parametrize(
    ("keys", "shown"),
    [
        (("part", 1, "weight"), "line 21: part[1].weight"),
        (("point", "y", "w"), "line 12: point.y.w"),
        (("title", "more"), "line 3: title.more"),
        (("name",), "name"),
    ],
)
def test_a_key_that_is_missing_is_named_by_its_table(
    keys: tuple[str | int, ...], shown: str
) -> None:
    """The line is that of the table which lacks it; the file itself has none."""
    assert place(TEXT.encode(), *keys) == shown


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("size = 1", "line 1: size: unknown key; known are name, part"),
        ("part = []", "name: missing"),
        ("name = 3", "line 1: name: Expected `str`, got `int`"),
        ('name = "a"\npart = 3', "line 2: part: Expected `array`, got `int`"),
        ('name = "a"\npart = [3]', "line 2: part[0]: Expected `table`, got `int`"),
        (
            'name = "a"\n[[part]]\nkind = "leaf"\nsize = -1',
            "line 4: part[0].size: Expected `float` > 0.0, got -1",
        ),
        ('name = "a"\n[[part]]\nsize = 1', "line 2: part[0].kind: missing; there are leaf, branch"),
        (
            'name = "a"\n[[part]]\nkind = "root"',
            "line 3: part[0].kind: there are leaf, branch, got 'root'",
        ),
        (
            'name = "a"\n[[part]]\nkind = "branch"\nsize = 1',
            "line 4: part[0].size: unknown key; known are kind, leaves",
        ),
        (
            'name = "a"\n[[part]]\nkind = "branch"\n[[part.leaves]]\nkind = "leaf"\n',
            "line 4: part[0].leaves[0].size: missing",
        ),
        ("name = ", "line 1: no TOML: "),
        ("name = 1\nname = 2", "line 2: no TOML: "),
        ("# a\nname = [\n1,\n}\n]\nx = 2", "line 2: no TOML: "),
        ('name = """\nno end\n\nx = 2\n', "line 1: no TOML: "),
        ("name = " + 9999 * "[", "no TOML that can be read: it is nested too deeply"),
    ],
)
def test_mistakes_are_named(text: str, message: str) -> None:
    """The message has line, key, found and needed value."""
    with pytest.raises(ValueError) as caught:
        decode(text.encode(), _Tree)
    assert str(caught.value).startswith(message)


def test_text_that_is_not_utf_8_is_named_by_its_line() -> None:
    """A file of another encoding names the byte."""
    with pytest.raises(ValueError, match="line 2: byte 0xfc is not UTF-8"):
        decode('# a\nname = "Stü"'.encode("latin-1"), _Tree)


def test_a_byte_order_mark_is_no_slip() -> None:
    """Some editors begin a file with one."""
    assert decode(b'\xef\xbb\xbfname = "a"', _Tree) == _Tree("a")
