"""Packing: bit for bit there and back, by types alone, and nothing else gets in."""

from __future__ import annotations

import pickle
import zlib
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta, timezone
from typing import Any, Literal

import msgspec
import numpy as np
import pytest

from lmshealth._private import serialize as packing
from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth._private.serialize import fingerprint, pack, unpack


class Law(msgspec.Struct, frozen=True, tag="law", tag_field="kind"):
    """A struct that a tag distinguishes from others."""

    rate: float = 1.0


class Other(msgspec.Struct, frozen=True, tag="other", tag_field="kind"):
    """Another one."""


@dataclass(frozen=True, slots=True)
class Inner:
    """A result inside of a result."""

    name: str
    there: BoolArray


@dataclass(frozen=True, slots=True)
class Result:
    """One field of every kind that results have."""

    floats: FloatArray
    names: np.ndarray[Any, Any]
    by_name: dict[str, FloatArray]
    maybe: FloatArray | None
    inner: tuple[Inner, ...]
    pairs: tuple[tuple[int, str], ...]
    word: Literal["one", "two"]
    law: Law | Other
    moment: datetime
    day: date | None
    numbers: tuple[float, ...]


def result() -> Result:
    """Return one whose numbers use all bits, and all that floats can be."""
    rng = np.random.default_rng(1)
    odd = [np.nan, np.inf, -np.inf, -0.0, 5e-324, 1 / 3]
    return Result(
        floats=rng.choice(odd, (4, 3, 2)),
        names=np.array(["roll", "ä"]),
        by_name={"b": np.empty((0, 2)), "a": np.asfortranarray(rng.normal(size=(3, 2)))},
        maybe=None,
        inner=(Inner("x", np.array([True, False])),),
        pairs=((3, "yaw"),),
        word="two",
        law=Law(np.float64(1 / 3)),
        moment=datetime(2026, 3, 1, 8, 30, 0, 125, tzinfo=timezone(timedelta(hours=1))),
        day=date(2027, 3, 1),
        numbers=(float("inf"), np.float64(0.1), float("-inf")),
    )


def test_everything_comes_back_bit_for_bit() -> None:
    """Arrays of any shape and kind, NaN, infinity, offsets, tags and the order of names."""
    put = result()
    got = unpack(pack(put), Result)
    for one, other in (
        (put.floats, got.floats),
        (put.names, got.names),
        *zip(put.by_name.values(), got.by_name.values(), strict=True),
        (put.inner[0].there, got.inner[0].there),
    ):
        assert (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
        assert not other.flags.writeable
    assert list(got.by_name) == ["b", "a"]
    assert got.moment.utcoffset() == timedelta(hours=1)
    for name in ("maybe", "pairs", "word", "law", "moment", "day", "numbers"):
        assert getattr(got, name) == getattr(put, name)
    assert pack(got) == pack(put)


def test_moments_in_utc_keep_their_name() -> None:
    """Pages write the zone."""
    got = unpack(pack([datetime(2026, 1, 1, tzinfo=UTC)]), list[datetime])
    assert got[0].strftime("%Z") == "UTC"


def test_a_new_field_with_a_default_needs_nothing_and_one_without_makes_a_row_unreadable() -> None:
    """What was packed before a field was there comes back with its default, or not at all."""

    @dataclass(frozen=True)
    class Before:
        a: int

    @dataclass(frozen=True)
    class After:
        a: int
        b: float = 0.5

    @dataclass(frozen=True)
    class Needing:
        a: int
        b: float

    assert unpack(pack(Before(3)), After) == After(3, 0.5)
    with pytest.raises(ValueError, match="`b`"):
        unpack(pack(Before(3)), Needing)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no bytes of ours",
        pickle.dumps({"floats": 1}),
        zlib.compress(b"\xc1"),
        zlib.compress(pickle.dumps(3)),
        pack({"name": "x", "there": ["|O", [1], b"12345678"]}),
        pack({"name": "x", "there": ["<f8", [3], b"12345678"]}),
        pack({"name": "x", "there": ["<f8", [-1, 0], b"12345678"]}),
        pack({"name": "x", "there": ["nonsense", [1], b"12345678"]}),
        pack({"name": "x", "there": 7}),
        pack({"name": 7, "there": np.zeros(1)}),
        pack({"there": np.zeros(1)}),
        pack(Inner("x", np.zeros(2, dtype=bool)))[:-3],
    ],
)
def test_foreign_bytes_are_refused(content: bytes) -> None:
    """Whatever the bytes are, it is a ValueError, and nothing in them is run."""
    with pytest.raises(ValueError, match="these bytes are no"):
        unpack(content, Inner)


def test_bytes_that_swell_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A small row that would fill the memory is not inflated to its end."""
    content = pack("0" * 100_000)
    assert len(content) < 1000
    assert unpack(content, str) == "0" * 100_000
    monkeypatch.setattr(packing, "_MOST_BYTES", 10_000)
    with pytest.raises(ValueError, match="more than 10000 bytes"):
        unpack(content, str)


@pytest.mark.parametrize("value", [np.array([object()]), object(), open])
def test_what_is_no_data_is_not_packed(value: object) -> None:
    """Objects and code have no bytes."""
    with pytest.raises(TypeError, match="cannot be packed"):
        pack(value)


def test_a_fingerprint_changes_with_every_bit_and_with_nothing_else() -> None:
    """Values, their order, their grouping and single bits of floats each make another one."""
    one = np.array([1.0, 2.0])
    given = [
        ("a", "b", one),
        ("b", "a", one),
        ("ab", "", one),
        ("a", ["b", one]),
        ("a", "b", np.nextafter(one, 3)),
        ("a", "b", one[:, None]),
        ("a", "b", one.astype(np.float32)),
    ]
    assert len({fingerprint(*values) for values in given}) == len(given)
    assert fingerprint("a", "b", one.copy(order="F")) == fingerprint(*given[0])
