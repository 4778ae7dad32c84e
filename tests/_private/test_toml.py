"""TOML: mistakes are named by their key."""

from __future__ import annotations

import time
from typing import Annotated

import pytest
from msgspec import Meta, Struct

from lmshealth._private.toml import decode
from lmshealth.stage.description import Description


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
        ('name = "a"\nsize = 1', "size: unknown key; known are name, part"),
        (
            'nme = "a"\npart = 3',
            "several mistakes\n  name: missing\n  nme: unknown key; known are name, part; "
            "most like it is name\n"
            "  part: Expected `array`, got `int`\nTo copy and edit:\n\nname = ",
        ),
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
        (
            '[[part]]\nkind = "leaf"\n[[part]]\nkind = "branch"\n[[part.leaves]]\nkind = "leaf"',
            "name, part[0].size, part[1].leaves[0].size: missing",
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


@pytest.mark.parametrize(
    "text",
    [
        "x = 1\n" + "a." * 60_000 + "a = 1",
        "x = 1\n[" + "a . " * 30_000 + "a]",
        "x = 1\n" + '"a b".' * 20_000 + "a = 1",
    ],
)
def test_keys_of_many_parts(text: str) -> None:
    """Dotted keys, whose time grows with the square of their parts, are refused with their line."""
    start = time.process_time()
    with pytest.raises(ValueError, match=r"^line 2: a key of more than 16 parts$"):
        decode(text.encode(), _Tree)
    assert time.process_time() - start < 1


@pytest.mark.parametrize("text", ['name = "1.2.3"', "x = [" + "1.5, " * 99 + "]", "x" * 130_000])
def test_dots_that_are_no_keys(text: str) -> None:
    """Numbers, texts and one long word are not taken for keys of many parts."""
    try:
        decode(text.encode(), _Tree)
    except ValueError as error:
        assert "parts" not in str(error)


def test_all_mistakes_are_named_at_once_and_what_is_missing_can_be_copied() -> None:
    """The examples in the message of an almost empty description are a valid description."""
    tables = ["mode", "watch", "order", "channel", "covariate", "parameter"]
    text = "".join(f"[[{name}]]\n" for name in tables) + "search = 2\n[map]"
    with pytest.raises(ValueError) as caught:
        decode(text.encode(), Description)
    mistakes, _, block = str(caught.value).partition("\nTo copy and edit:\n\n")
    for key in ("name", "mode[0].damping_ratio", "covariate[0].reference", "parameter[0].prior"):
        assert key in mistakes
    assert "parameter[0].search: unknown key" in mistakes
    made = decode(block.encode(), Description)
    assert all(getattr(made, name) for name in [*tables, "map"])


def test_many_mistakes_are_cut() -> None:
    """A message lists a dozen lines and counts the others."""
    with pytest.raises(ValueError) as caught:
        decode(('name = "a"\n' + "\n".join(f"x{k} = 1" for k in range(50))).encode(), _Tree)
    assert len(str(caught.value).splitlines()) == 14 and "38 more" in str(caught.value)


def test_messages_are_short_and_visible() -> None:
    """A message keeps both ends of a long key, and shows what cannot be seen."""
    deep = ".".join(["a\u00ad" * 40 for _ in range(15)])
    with pytest.raises(ValueError) as caught:
        decode(("name = 1\n" + 'part = "' + "x" * 9000 + '"').encode(), _Tree)
    assert len(str(caught.value)) < 500
    with pytest.raises(ValueError) as caught:
        decode(f'"{deep}" = 1\nname = "a"'.encode(), _Tree)
    assert len(str(caught.value)) < 500 and str(caught.value).isprintable()


def test_text_that_is_not_utf_8_is_refused() -> None:
    """A file of another encoding names the byte."""
    with pytest.raises(ValueError, match="no TOML: 'utf-8' codec can't decode byte 0xfc"):
        decode('# a\nname = "Stü"'.encode("latin-1"), _Tree)


def test_a_byte_order_mark_is_no_slip() -> None:
    """Some editors begin a file with one."""
    assert decode(b'\xef\xbb\xbfname = "a"', _Tree) == _Tree("a")
