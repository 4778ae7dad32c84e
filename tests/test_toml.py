"""TOML: mistakes are named by their key."""

from __future__ import annotations

from typing import Annotated

import pytest
from msgspec import Meta, Struct

from lmshealth._toml import decode


class _Leaf(Struct, forbid_unknown_fields=True, tag="leaf", tag_field="kind"):
    size: Annotated[float, Meta(gt=0)]


class _Branch(Struct, forbid_unknown_fields=True, tag="branch", tag_field="kind"):
    leaves: tuple[_Leaf, ...] = ()


class _Tree(Struct, forbid_unknown_fields=True):
    name: str
    part: tuple[_Leaf | _Branch, ...] = ()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("size = 1", "size: unknown key; known are name, part"),
        ("part = []", "name: missing"),
        ("name = 3", "name: Expected `str`, got `int`"),
        ('name = "a"\npart = 3', "part: Expected `array`, got `int`"),
        ('name = "a"\npart = [3]', "part[0]: Expected `table`, got `int`"),
        (
            'name = "a"\n[[part]]\nkind = "leaf"\nsize = -1',
            "part[0].size: Expected `float` > 0.0, got -1",
        ),
        ('name = "a"\n[[part]]\nsize = 1', "part[0].kind: missing; there are leaf, branch"),
        (
            'name = "a"\n[[part]]\nkind = "root"',
            "part[0].kind: there are leaf, branch, got 'root'",
        ),
        (
            'name = "a"\n[[part]]\nkind = "branch"\nsize = 1',
            "part[0].size: unknown key; known are kind, leaves",
        ),
        (
            'name = "a"\n[[part]]\nkind = "branch"\n[[part.leaves]]\nkind = "leaf"\n',
            "part[0].leaves[0].size: missing",
        ),
        ("name = ", "no TOML: Invalid value (at end of document)"),
        ("name = 1\nname = 2", "no TOML: "),
        ("# a\nname = [\n1,\n}\n]\nx = 2", "no TOML: Invalid value (at line 4, column 1)"),
        ('name = """\nno end\n\nx = 2\n', "no TOML: Unterminated string"),
        ("name = " + 9999 * "[", "no TOML that can be read: it is nested too deeply"),
    ],
)
def test_mistakes_are_named(text: str, message: str) -> None:
    """The message has key, found and needed value."""
    with pytest.raises(ValueError) as caught:
        decode(text.encode(), _Tree)
    assert str(caught.value).startswith(message)


def test_text_that_is_not_utf_8_is_refused() -> None:
    """A file of another encoding names the byte."""
    with pytest.raises(ValueError, match="no TOML: 'utf-8' codec can't decode byte 0xfc"):
        decode('# a\nname = "Stü"'.encode("latin-1"), _Tree)


def test_a_byte_order_mark_is_no_slip() -> None:
    """Some editors begin a file with one."""
    assert decode(b'\xef\xbb\xbfname = "a"', _Tree) == _Tree("a")
