"""Reading files: formats agree, the contract is kept, every fault is a ``BadLog``."""

import gzip
import hashlib
import os
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from lmshealth import io as readers
from lmshealth.cli.main import main
from lmshealth.errors import BadLog
from lmshealth.io import constants
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.native import PARQUET
from lmshealth.io.reading import content_digest, read_log, require_identity
from lmshealth.io.refusal import Unusable

ALL = ["log.csv", "log.csv.gz", "log.parquet", "log.h5", "log.hdf5", "log.tdms", "log.mat"]


def refused(path, reason, *words, **options):
    """Expect a refusal with words in its detail."""
    with pytest.raises(BadLog) as caught:
        read_log(path, **options)
    assert caught.value.reason == reason, caught.value
    for word in words:
        assert word in caught.value.detail
    return caught.value


@pytest.mark.parametrize("file", ALL)
def test_formats_hold_the_same_log(make, file):
    """Every format gives the same signals in SI units and the same metadata."""
    path = make(file)
    log, other = read_log(path), read_log(make("other.h5"))
    assert log.metadata == other.metadata
    assert log.metadata.travel == 123500.0
    moment = log.metadata.recorded_at
    assert moment is not None and moment.utcoffset() == timedelta(hours=1)
    assert log.sample_rate == 2000.0 and log.pieces == ((0, 400),) and log.refused == ()
    assert [c.name for c in log.channels] and {c.name for c in log.channels} == {
        "delta_e",
        "acc_feed",
    }
    values = {c.name: c.values[:] for c in log.channels}
    for channel in other.channels:
        np.testing.assert_allclose(values[channel.name], channel.values[:], rtol=1e-12)
    assert 1e-8 < values["delta_e"].std() < 1e-7
    assert log.reference_velocity is not None
    np.testing.assert_allclose(log.reference_velocity[:], 0.1)
    assert log.digest == content_digest(path) == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize("file", ALL)
def test_zero_bytes(tmp_path, file):
    """A file of 0 bytes is refused as empty."""
    (tmp_path / file).write_bytes(b"")
    refused(tmp_path / file, "empty")


@pytest.mark.parametrize("file", ALL)
@pytest.mark.parametrize("share", [0.3, 0.9])
def test_truncated(make, file, share):
    """A file cut in the middle is refused as corrupt."""
    path = make(file)
    data = path.read_bytes()
    if file == "log.csv":
        data = data[: data.rindex(b",", 0, int(len(data) * share))]
    else:
        data = data[: int(len(data) * share)]
    path.write_bytes(data)
    refused(path, "corrupt")


@pytest.mark.parametrize(
    ("content", "name", "found"),
    [
        ("log.parquet", "x.h5", "Parquet"),
        ("log.h5", "x.csv", "HDF5"),
        ("log.csv", "x.parquet", "CSV"),
        ("log.csv.gz", "x.csv", "gzip"),
        ("log.tdms", "x.mat", "TDMS"),
        ("log.mat", "x.tdms", "MAT"),
        ("log.csv", "x.uff", "CSV"),
        ("log.mat", "x.csv", "MAT"),
    ],
)
def test_wrong_extension(make, content, name, found):
    """Content of another format than the suffix promises is named."""
    path = make(content)
    refused(path.rename(path.with_name(name)), "format", found)


def test_not_there(tmp_path):
    """Absent files, folders, pipes and impossible names are refused without waiting."""
    os.mkfifo(tmp_path / "pipe.csv")
    for path in ("absent.csv", ".", "pipe.csv", "nul\0.csv"):
        refused(tmp_path / path, "missing-file")
    with pytest.raises(BadLog, match="missing-file"):
        content_digest(tmp_path / "absent.csv")


def test_unknown_suffix(tmp_path):
    """A suffix that no format registered is refused with those that are."""
    (tmp_path / "log.xyz").write_bytes(b"abc")
    refused(tmp_path / "log.xyz", "format", ".parquet", ".csv.gz")


def test_gzip_bomb(tmp_path, monkeypatch):
    """A gzip bomb is stopped while it is unpacked."""
    monkeypatch.setattr(constants, "SMALL_ENOUGH", 1 << 20)
    member = gzip.compress(b"0\n" * (1 << 24), 9)
    (tmp_path / "bomb.csv.gz").write_bytes(gzip.compress(b"delta_e_um\n") + member)
    refused(tmp_path / "bomb.csv.gz", "too-large")


def test_hdf5_bomb(tmp_path):
    """An HDF5 file that declares terabytes is refused before they are allocated."""
    with h5py.File(tmp_path / "bomb.h5", "w") as file:
        file.create_dataset("delta_e_um", (1 << 40,), chunks=(1 << 20,), dtype="f4")
        file.attrs["sample_rate_hz"] = 1000.0
    refused(tmp_path / "bomb.h5", "corrupt", "0 of 1048576")


@pytest.mark.slow
def test_parquet_bomb(make):
    """A Parquet file of a few bytes that declares a billion samples is refused."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = make("log.parquet")
    block = pa.table({"delta_e_um": np.zeros(1 << 24)})
    with pq.ParquetWriter(path, block.schema, use_dictionary=True) as writer:
        for _ in range(3):
            writer.write_table(block)
    refused(path, "too-large")


def test_parquet_text_column(make):
    """A text column under a signal's name is named, elsewhere it is passed over."""
    refused(make("a.parquet", {"acc_x_g": np.array(["a"] * 400)}), "columns", "acc_x_g", "string")
    read_log(make("b.parquet", {"remark": np.array(["a"] * 400)}))


def test_parquet_without_pyarrow(make, monkeypatch):
    """Without pyarrow the error names the extra to install."""
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    # Not by `read_log`: the process that reads Parquet has modules of its own.
    with pytest.raises(Unusable, match=r"lmshealth\[formats\]") as caught:
        PARQUET.load(make("log.parquet"), ColumnMap(), 2e9)
    assert caught.value.reason == "format"


def test_require_identity(make):
    """A log without identity can be read, and is refused where a life is tracked."""
    require_identity(read_log(make()))
    log = read_log(make(meta={"stage": None, "travel_km": None}))
    with pytest.raises(BadLog, match="stage, travel_km not given"):
        require_identity(log)
    with pytest.raises(BadLog, match="stage not given"):
        require_identity(log, odometer=False)


def test_overrides(make):
    """The manifest has the last word, its empty cells none."""
    log = read_log(make(), overrides={"travel_km": "7", "stage": " ", "baseline": "true"}, name="n")
    assert (log.metadata.travel, log.metadata.stage, log.metadata.baseline) == (7e3, "demo-Y", True)
    assert log.name == "n"


def test_overrides_are_numbers_too(make):
    """Values that are no text are read as the text of them, and None overrides nothing."""
    moment = datetime(2026, 2, 3, tzinfo=UTC)
    given = {"travel_km": 3, "stage": None, "baseline": True, "recorded_at": moment}
    own = read_log(make(), overrides=given).metadata
    assert (own.travel, own.stage, own.baseline, own.recorded_at) == (3e3, "demo-Y", True, moment)


def test_import_is_light():
    """Importing the readers brings none of the libraries that read the formats."""
    folder = str(Path(readers.__file__).parents[1])
    # A bare stand-in for the package, whose own imports do not count here.
    code = (
        "import sys, types; package = types.ModuleType('lmshealth'); "
        f"package.__path__ = [{folder!r}]; sys.modules['lmshealth'] = package; "
        "import lmshealth.io.reading; "
        "late = ('pandas', 'pyarrow', 'h5py', 'scipy', 'nptdms', 'pyuff'); "
        "sys.exit(any(m in sys.modules for m in late))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def fails(path, reason, words):
    """Expect a refusal of the whole log."""
    with pytest.raises(BadLog, match=words) as caught:
        read_log(path)
    assert caught.value.reason == reason


def test_missing_signal(make):
    """A log without Δe and acceleration is refused with what there is and what it needs."""
    path = make(columns={"delta_e_um": None, "acc_feed_m_s2": None, "current_a": np.arange(400.0)})
    fails(path, "columns", "no signal: needed delta_e_um.*there: time_s")


def test_missing_rate(make):
    """A log without time and sample rate needs one of them."""
    fails(make(columns={"time_s": None}, meta={"sample_rate_hz": None}), "time", "needed one")
    assert read_log(make(columns={"time_s": None})).sample_rate == 2000.0


def test_unknown_unit(make):
    """An unknown unit is an error for a signal and of no interest elsewhere."""
    fails(make(columns={"acc_x_furlong": np.zeros(400)}), "unit", "acc_x_furlong.*there: time_s")
    read_log(make(columns={"weather_furlong": np.zeros(400)}))


def test_one_signal_in_two_units(make):
    """The same signal in two units is ambiguous."""
    fails(make(columns={"delta_e_nm": np.arange(400.0)}), "columns", "more than one unit")


def test_lengths(make):
    """Columns of different lengths are named with their lengths."""
    fails(make("log.h5", {"delta_e_um": np.arange(300.0)}), "columns", "delta_e 300")


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        (np.zeros(400), "flat"),
        (np.clip(np.random.default_rng(0).normal(size=400), -1, 1).repeat(1), "clipped"),
        (np.where(np.arange(400) < 50, np.nan, np.arange(400.0)), "missing-samples"),
    ],
)
def test_bad_channel_is_refused_alone(make, values, reason):
    """A bad channel is refused with its reason, the others are used over the whole record."""
    log = read_log(make(columns={"acc_bad_m_s2": values}))
    assert [(r.channel, r.reason) for r in log.refused] == [("acc_bad", reason)]
    assert {c.name for c in log.channels} == {"delta_e", "acc_feed"} and log.pieces == ((0, 400),)


def test_no_channel_left(make):
    """A log whose channels are all refused is refused with all reasons."""
    path = make(columns={"delta_e_um": np.zeros(400), "acc_feed_m_s2": np.ones(400)})
    fails(path, "no-signal", "delta_e: flat.*acc_feed: flat")


@pytest.mark.parametrize("file", ["log.csv", "log.parquet", "log.h5"])
def test_short_gaps_split(make, file):
    """Missing samples of any channel split the record, with counts, and stay NaN."""
    values = np.random.default_rng(1).normal(size=400)
    values[[100, 101]] = np.nan
    log = read_log(make(file, {"acc_feed_m_s2": values}))
    assert log.pieces == ((0, 100), (102, 400))
    assert [(r.channel, r.reason) for r in log.refused] == [("acc_feed", "gaps")]
    assert "2 of 400" in log.refused[0].detail
    channel = next(c for c in log.channels if c.name == "acc_feed")
    assert np.isnan(channel.values[:]).sum() == 2


def test_dropped_samples(make):
    """Gaps in time are named with counts and split a record too short to predict them."""
    time = np.arange(400) / 2000
    time[250:] += 5 / 2000
    log = read_log(make(columns={"time_s": time}))
    assert log.pieces == ((0, 250), (255, 405)) and "5 dropped" in log.refused[0].detail


def test_velocity_from_position(make):
    """A set point given as position is differentiated, never across a gap."""
    time = np.arange(400) / 2000
    time[250:] += 5 / 2000
    columns = {"reference_velocity_mm_s": None, "reference_position_mm": 50 * time, "time_s": time}
    log = read_log(make(columns=columns))
    velocity = log.reference_velocity
    assert velocity is not None
    for start, stop in log.pieces:
        np.testing.assert_allclose(velocity[start:stop], 0.05)


def test_useless_set_point(make):
    """A set point that is mostly missing is refused, and cuts nothing."""
    log = read_log(make(columns={"reference_velocity_mm_s": np.full(400, np.nan)}))
    assert log.reference_velocity is None and log.pieces == ((0, 400),)
    assert log.refused[0].channel == "reference_velocity"


@pytest.mark.parametrize("share", [0.2, 1.0])
def test_a_set_position_replaces_a_useless_set_velocity(make, share):
    """A velocity that lacks samples is refused; the position is used, and not compared with it."""
    time = np.arange(400) / 2000
    useless = np.where(np.arange(400) < 400 * share, np.nan, 100.0)
    columns = {"reference_velocity_mm_s": useless, "reference_position_mm": 50 * time}
    log = read_log(make(columns=columns))
    assert [(one.channel, one.reason) for one in log.refused] == [
        ("reference_velocity", "missing-samples")
    ]
    assert log.reference_velocity is not None
    np.testing.assert_allclose(log.reference_velocity[:], 0.05)


def test_a_log_that_begins_at_rest_is_used(make):
    """Whole counts of an encoder that are equal for 4 s are no copy of another channel."""
    counts = np.round(20 * np.random.default_rng(3).normal(size=12_000))
    counts[:8400] = 0.0
    path = make(columns={"delta_e_um": counts}, n=12_000)
    log = read_log(path)
    assert log.refused == () and len(log.channels) == 2
    log = read_log(make(columns={"delta_e_um": counts, "acc_feed_m_s2": None}, n=12_000))
    assert log.refused == () and [one.name for one in log.channels] == ["delta_e"]


@pytest.mark.parametrize("n", [0, 1])
def test_too_few_samples(make, n):
    """Fewer than two samples are no recording."""
    fails(make("log.h5", n=n), "empty", "at least 2")


def test_arrays_are_read_only(make):
    """A log cannot be changed by who reads it."""
    with pytest.raises(ValueError, match="read-only"):
        read_log(make()).channels[0].values[:][0] = 1.0


def test_the_limit_of_memory_is_an_option(make):
    """The command line passes --max-memory to the reader, and names it in the refusal."""
    path = str(make("log.mat"))
    run = CliRunner().invoke(main, ["error", path, "--max-memory", "1e-6"])
    assert run.exit_code == 1 and "too-large: variable" in run.output + run.stderr
    assert "raise --max-memory" in run.output + run.stderr
    assert CliRunner().invoke(main, ["error", path]).exit_code == 0
