"""The store: what goes in comes out bit for bit, and what is wrong with it is said."""

from __future__ import annotations

import sqlite3
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest

from lmshealth.history import Reading
from lmshealth.logs import Metadata, Refusal
from lmshealth.results import Line, Modes
from lmshealth.store import SCHEMA, Store, StoreError, result_key
from lmshealth.waterfall import Levels


def reading(n: int = 2, log: str = "a.h5") -> Reading:
    """Give a reading whose numbers use all bits of a float."""
    rng = np.random.default_rng(n)
    cov = rng.normal(size=(2 * n, 2 * n)) * 10.0 ** rng.integers(-12, 3, (2 * n, 2 * n))
    names = tuple(f"mode_{k}" for k in range(n))
    modes = Modes(
        names=names,
        sources=("acc",) * n,
        channels=("acc_x",) * n,
        ln_frequency=np.log(rng.uniform(1, 300, n)),
        ln_damping=np.log(rng.uniform(1e-3, 0.1, n)),
        cov=cov @ cov.T,
        snr=np.exp(rng.normal(5, 3, n)),
        dispersion=np.ones(n),
        flags=("",) * n,
        shape_channels=("acc_x", "acc_y", "delta_e"),
        shapes=rng.choice([np.nan, 1 / 3, -0.1], (n, 3)),
        lines=(Line(50.0 + 1e-13, 1 / 3, "m/s²", "mains", "acc_x"),),
        refused=(Refusal(log, "not-excited", "näher 126.4 Hz", mode="yaw"),),
    )
    metadata = Metadata(
        stage="test-A",
        recorded_at=datetime(2026, 3, 1, 8, 30, 0, 125, tzinfo=timezone(timedelta(hours=1))),
        travel=123_456.7,
        covariates={"temperature_c": 21.4},
        servo_id="new",
        baseline=True,
        description="small",
    )
    levels = Levels(100 / 3, 200 / 3, rng.choice([np.nan, 1 / 3], 5))
    return Reading(log, "d" * 64, metadata, modes, 1e-6 / 3, levels)


@pytest.fixture
def url(tmp_path: Path) -> str:
    """Name a store that does not exist yet."""
    return f"sqlite:///{(tmp_path / 'store.sqlite').as_posix()}"


@pytest.mark.parametrize("n", [0, 1, 3])
def test_a_reading_comes_back_bit_for_bit(url: str, n: int) -> None:
    """Every float, name, line, refusal and metadatum is the same after a round trip."""
    put = reading(n)
    writer = Store(url)
    writer.put("k", put.log, put)
    writer.close()
    reader = Store(url)
    got = reader.get("k", put.log)
    reader.close()
    assert isinstance(got, Reading)
    assert (got.log, got.digest, got.metadata) == (put.log, put.digest, put.metadata)
    assert got.loop_error == put.loop_error
    assert got.metadata.recorded_at is not None
    assert got.metadata.recorded_at.utcoffset() == timedelta(hours=1)
    assert got.levels is not None and put.levels is not None
    assert got.levels.edges.tobytes() == put.levels.edges.tobytes()
    assert got.levels.level.tobytes() == put.levels.level.tobytes()
    for name in ("ln_frequency", "ln_damping", "cov", "snr", "dispersion", "shapes"):
        one, other = getattr(got.modes, name), getattr(put.modes, name)
        assert one.dtype == other.dtype
        assert one.shape == other.shape
        assert one.tobytes() == other.tobytes(), name
    for name in ("names", "sources", "channels", "shape_channels", "lines", "refused"):
        assert getattr(got.modes, name) == getattr(put.modes, name)


def test_missing_metadata_stay_missing(url: str) -> None:
    """What a log did not say is None again, not a text or a zero."""
    put = Reading("a.h5", "d" * 64, Metadata(), reading(0).modes)
    store = Store(url)
    store.put("k", "a.h5", put)
    got = store.get("k", "a.h5")
    store.close()
    assert isinstance(got, Reading)
    assert got.metadata == Metadata()
    assert got.loop_error is None
    assert got.levels is None


def test_refusals_come_back_under_the_present_name(url: str) -> None:
    """A refused log is remembered too; renamed, it is refused under its new name."""
    refused = (Refusal("old.h5", "too-short", "0.3 s", channel="acc_x", source="acc"),)
    store = Store(url)
    store.put("k", "old.h5", refused)
    assert store.get("k", "old.h5") == refused
    moved = store.get("k", "new.h5")
    store.close()
    assert moved == (Refusal("new.h5", "too-short", "0.3 s", channel="acc_x", source="acc"),)


def test_a_renamed_log_is_known_under_its_new_name(url: str) -> None:
    """The reading and the refusals inside it carry the name asked for."""
    store = Store(url)
    store.put("k", "a.h5", reading())
    got = store.get("k", "b.h5")
    store.close()
    assert isinstance(got, Reading)
    assert got.log == "b.h5"
    assert [refusal.log for refusal in got.modes.refused] == ["b.h5"]


def test_what_is_not_there_is_none(url: str) -> None:
    """An unknown key is no error."""
    store = Store(url)
    assert store.get("nothing", "a.h5") is None
    store.close()


def test_what_an_older_version_kept_is_not_read(url: str, tmp_path: Path) -> None:
    """Rows of an older layout stay where they are, and their logs are done again."""
    with sqlite3.connect(tmp_path / "store.sqlite") as older:
        older.execute(f"CREATE TABLE identified_{SCHEMA - 1} (key TEXT, log TEXT, outcome TEXT)")
        older.execute(f"INSERT INTO identified_{SCHEMA - 1} VALUES ('k', 'a.h5', '{{}}')")
    store = Store(url)
    assert store.get("k", "a.h5") is None
    store.put("k", "a.h5", reading())
    assert isinstance(store.get("k", "a.h5"), Reading)
    store.close()


def test_putting_twice_changes_nothing(url: str) -> None:
    """The same key again keeps one row with the same content."""
    store = Store(url)
    for _ in range(2):
        store.put("k", "a.h5", reading())
    got = store.get("k", "a.h5")
    store.close()
    assert isinstance(got, Reading)
    assert got.modes.cov.tobytes() == reading().modes.cov.tobytes()


def test_the_key_changes_with_every_circumstance() -> None:
    """Content, version, description, their order and the manifest each make another key."""
    keys = [
        result_key("d1", "0.1.0", "stage"),
        result_key("d2", "0.1.0", "stage"),
        result_key("d1", "0.1.1", "stage"),
        result_key("d1", "0.1.0", "stage2"),
        result_key("d1", "stage", "0.1.0"),
        result_key("d1", "0.1.0", "stage", "[]"),
        result_key("d1", "0.1.0", "stage", "[('travel_km', '3')]"),
    ]
    assert len(set(keys)) == len(keys)
    assert keys[0] == result_key("d1", "0.1.0", "stage")


@pytest.mark.parametrize(
    "bad",
    [
        "no url at all",
        "nosuchdatabase://user:hunter2@host/db",
        "postgresql+nosuchdriver://user:hunter2@host/db",
        "postgresql://user:hunter2@host:port/db",
        "sqlite:////no/such/folder/store.sqlite",
    ],
)
def test_a_url_that_cannot_be_opened_is_named_without_its_password(bad: str) -> None:
    """Each bad URL is a StoreError of one message that does not show the password."""
    with pytest.raises(StoreError) as caught:
        Store(bad)
    assert "hunter2" not in str(caught.value)
    assert "cannot open the store" in str(caught.value)


def test_a_file_that_is_no_store_is_named(tmp_path: Path) -> None:
    """A file of other content is a StoreError that names it, and stays as it was."""
    path = tmp_path / "notes.sqlite"
    path.write_text("these are my notes, not a database\n" * 100)
    before = path.read_bytes()
    with pytest.raises(StoreError, match=r"notes\.sqlite"):
        Store(f"sqlite:///{path.as_posix()}")
    assert path.read_bytes() == before


def test_a_damaged_store_is_named(url: str, tmp_path: Path) -> None:
    """A store damaged after its first page fails with a StoreError when it is read."""
    store = Store(url)
    for number in range(40):
        store.put(f"k{number}", "a.h5", reading(3))
    store.close()
    path = tmp_path / "store.sqlite"
    data = bytearray(path.read_bytes())
    data[4096:] = b"\xff" * (len(data) - 4096)
    path.write_bytes(bytes(data))
    with pytest.raises(StoreError, match=r"store\.sqlite"):
        damaged = Store(url)
        try:
            damaged.get("k7", "a.h5")
        finally:
            damaged.close()
