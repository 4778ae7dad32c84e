"""TDMS: units, rates and properties of channels; damage that npTDMS passes over."""

import os
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from nptdms import ChannelObject, RootObject, TdmsFile, TdmsWriter

from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.registry import load
from lmshealth.io.reading import read_log
from lmshealth.io.refusal import Unusable
from tests.io.handmade import tdms_segment

RATE = {"wf_increment": 1e-3}
NOISE = np.random.default_rng(0).normal(size=2000)


def write(path, *channels, root=None, n_segments=1):
    """Write channels given as (name, values, properties) or (group, name, values, properties)."""
    full = [c if len(c) == 4 else ("log", *c) for c in channels]
    with TdmsWriter(str(path)) as writer:
        for k in range(n_segments):
            writer.write_segment(
                [RootObject(root or {})]
                + [ChannelObject(g, n, np.array_split(v, n_segments)[k], p) for g, n, v, p in full]
            )
    return path


def refused(path, reason, *words, **options):
    """Expect a refusal with words in its detail."""
    with pytest.raises(BadLog) as caught:
        read_log(path, **options)
    assert caught.value.reason == reason, caught.value
    for word in words:
        assert word in caught.value.detail


@pytest.mark.parametrize("unit", ["g", "m/s^2", "m/s²", "mm/s2", "m/sÂ²"])
def test_reads_accelerations(tmp_path, unit):
    """Channels in a unit of acceleration are read without a map, over all segments."""
    factor = {"g": 9.80665, "mm/s2": 1e-3}.get(unit, 1.0)
    properties = {"unit_string": unit, **RATE}
    path = write(
        tmp_path / "log.tdms",
        ("Head X", NOISE.astype("f4"), properties),
        ("Strain", NOISE, {"unit_string": "um/m", **RATE}),
        n_segments=7,
    )
    log = read_log(path)
    assert [c.name for c in log.channels] == ["acc_Head_X"] and log.sample_rate == 1000.0
    np.testing.assert_allclose(log.channels[0].values[:], NOISE * factor, rtol=1e-6)


def test_unit_beside_a_name_of_the_contract(tmp_path):
    """A unit property completes a name of the contract and must not contradict it."""
    path = write(tmp_path / "a.tdms", ("delta_e", NOISE, {"unit_string": "nm", **RATE}))
    np.testing.assert_allclose(read_log(path).channels[0].values[:], NOISE * 1e-9)
    path = write(tmp_path / "b.tdms", ("acc_x_g", NOISE, {"unit_string": "m/s2", **RATE}))
    refused(path, "unit", "acc_x_g")


def test_mixed_rates(tmp_path):
    """The rate of most channels makes the log; the others are refused by name."""
    fast = {"unit_string": "g", "wf_increment": 1e-4}
    slow = {"unit_string": "g", "wf_increment": 1e-3}
    path = write(
        tmp_path / "log.tdms",
        ("a", NOISE, fast),
        ("b", NOISE[::-1], fast),
        ("c", NOISE[:200], slow),
        ("temperature", NOISE[:2], {"unit_string": "C", "wf_increment": 1.0}),
    )
    log = read_log(path)
    assert log.sample_rate == 10_000.0 and [c.name for c in log.channels] == ["acc_a", "acc_b"]
    (refusal,) = log.refused
    assert (refusal.channel, refusal.reason, refusal.log) == ("acc_c_g", "time", log.name)
    assert "1000 Hz" in refusal.detail and "10000 Hz" in refusal.detail


def test_groups(tmp_path):
    """Equal names in two groups are distinguished by the group, also in a map."""
    unit = {"unit_string": "g", **RATE}
    path = write(tmp_path / "log.tdms", ("one", "x", NOISE, unit), ("two", "x", NOISE[::-1], unit))
    assert {c.name for c in read_log(path).channels} == {"acc_one_x", "acc_two_x"}
    log = read_log(path, columns=ColumnMap(columns={"acc_second_g": "two/x"}))
    assert [c.name for c in log.channels] == ["acc_second"]


def test_names_that_collide(tmp_path):
    """Two channels whose names become one are not guessed at."""
    unit = {"unit_string": "g", **RATE}
    path = write(tmp_path / "log.tdms", ("a b", NOISE, unit), ("a-b", NOISE, unit))
    refused(path, "columns", "a b, a-b")


def test_properties_are_metadata(tmp_path):
    """Properties of the file are metadata; the start of the recording is in UTC."""
    moment = np.datetime64("2026-03-01T07:30:00", "us")
    channel = ("x", NOISE, {"unit_string": "g", "wf_start_time": moment, **RATE})
    root = {"stage": "demo-Y", "travel_km": 12.5, "baseline": True}
    log = read_log(write(tmp_path / "log.tdms", channel, root=root))
    assert (log.metadata.stage, log.metadata.travel) == ("demo-Y", 12_500.0)
    recorded_at = log.metadata.recorded_at
    assert recorded_at is not None and recorded_at.isoformat().endswith("07:30:00+00:00")
    assert log.metadata.baseline
    never = ("x", NOISE, {"unit_string": "g", "wf_start_time": np.datetime64(0, "us"), **RATE})
    path = write(tmp_path / "b.tdms", never, root={**root, "recorded_at": "2026-01-01T00:00:00Z"})
    recorded_at = read_log(path).metadata.recorded_at
    assert recorded_at is not None and recorded_at.year == 2026


def test_velocity_is_metadata(tmp_path):
    """The velocity at which a log was recorded is read in m/s; anything but a number is refused."""
    channel = ("x", NOISE, {"unit_string": "g", **RATE})
    for given in (-100.0, "-100", 100):
        path = write(tmp_path / "log.tdms", channel, root={"velocity_mm_s": given})
        assert read_log(path).metadata.velocity == pytest.approx(0.001 * float(given), rel=1e-15)
    assert read_log(write(tmp_path / "log.tdms", channel)).metadata.velocity is None
    path = write(tmp_path / "log.tdms", channel, root={"velocity_mm_s": "fast"})
    refused(path, "metadata", "velocity_mm_s", "'fast'")


def test_scaled_samples(tmp_path):
    """Raw counts are scaled by the properties."""
    scale = {
        "NI_Number_Of_Scales": 1,
        "NI_Scale[0]_Scale_Type": "Linear",
        "NI_Scale[0]_Linear_Slope": 0.5,
        "NI_Scale[0]_Linear_Y_Intercept": 1.0,
        "NI_Scale[0]_Linear_Input_Source": 0xFFFFFFFF,
    }
    counts = (NOISE * 1000).astype("i2")
    path = write(tmp_path / "log.tdms", ("x", counts, {"unit_string": "m/s2", **RATE, **scale}))
    np.testing.assert_allclose(read_log(path).channels[0].values[:], counts * 0.5 + 1)


@pytest.mark.parametrize(
    "damage",
    [
        {"NI_Number_Of_Scales": 4_000_000_000},
        {"NI_Scale[4000000000]_Scale_Type": "Linear"},
        {"NI_Scale[0]_Polynomial_Coefficients_Size": 4_000_000_000},
    ],
)
def test_counts_of_scales(tmp_path, damage):
    """A damaged count of scales is refused; npTDMS would fill the memory and loop."""
    path = write(tmp_path / "log.tdms", ("x", NOISE, {"unit_string": "g", **RATE, **damage}))
    refused(path, "corrupt", "NI_")


def test_text_channel(tmp_path):
    """A channel of text cannot be a signal."""
    text = np.array(["a", "b"] * 10)
    path = write(tmp_path / "log.tdms", ("delta_e_um", text, RATE))
    refused(path, "columns", "delta_e_um")


def test_truncated_anywhere(tmp_path):
    """A file cut anywhere but between segments is refused; npTDMS would read the rest."""
    channel = ("x", NOISE, {"unit_string": "g", **RATE})
    path = write(tmp_path / "log.tdms", channel, n_segments=3)
    data = path.read_bytes()
    last = data.rindex(b"TDSm")
    for stop in (20, last - 8, last + 3, last + 20, last + 40, len(data) - 1):
        path.write_bytes(data[:stop])
        refused(path, "corrupt")


def test_unfinished_segment(tmp_path):
    """A recorder that stopped before it wrote the length of its segment is named."""
    path = write(tmp_path / "log.tdms", ("x", NOISE, {"unit_string": "g", **RATE}))
    data = path.read_bytes()
    path.write_bytes(data[:12] + b"\xff" * 8 + data[20:])
    refused(path, "corrupt", "never finished")


def test_an_index_file_is_ignored(tmp_path):
    """An index file in the folder of the log is ignored."""
    channel = ("x", NOISE, {"unit_string": "g", **RATE})
    path = write(tmp_path / "log.tdms", channel)
    path.with_name("log.tdms_index").write_bytes(b"TDSh" + bytes(100))
    assert read_log(path).channels[0].values.size == 2000


def test_nothing_is_printed(tmp_path, capfd):
    """Guesses of npTDMS end as errors and not as lines on standard error."""
    path = write(tmp_path / "log.tdms", ("x", NOISE, {"unit_string": "g", **RATE}))
    data = path.read_bytes()
    path.write_bytes(data[:-8])
    with warnings.catch_warnings(record=True) as caught:
        refused(path, "corrupt")
    assert capfd.readouterr() == ("", "") and not caught


def test_without_nptdms(tmp_path, monkeypatch):
    """Without npTDMS the error names the extra to install."""
    path = write(tmp_path / "log.tdms", ("x", NOISE, RATE))
    monkeypatch.setitem(sys.modules, "nptdms", None)
    refused(path, "format", "lmshealth[formats]")


SHORT = NOISE[:240]
CHANNELS = {"delta_e_um": SHORT, "other": np.arange(240, dtype="i2"), "acc_x_g": SHORT.astype("f4")}


def agree(path):
    """Compare the wanted channels with what npTDMS reads."""
    columns = load(path, ColumnMap()).columns
    group = TdmsFile.read(path)["log"]
    for name in ("delta_e_um", "acc_x_g"):
        np.testing.assert_array_equal(columns[name], group[name][:])
    assert set(columns) == {"delta_e_um", "acc_x_g"}
    return columns


@pytest.mark.parametrize("n_chunks", [1, 3, 240])
@pytest.mark.parametrize("interleaved", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
def test_layouts(tmp_path, order, interleaved, n_chunks):
    """Chunks one after the other and samples in turns, in either order of bytes."""
    made = tdms_segment(CHANNELS, order=order, interleaved=interleaved, n_chunks=n_chunks)
    (tmp_path / "log.tdms").write_bytes(made + made)
    columns = agree(tmp_path / "log.tdms")
    np.testing.assert_array_equal(columns["delta_e_um"], np.tile(SHORT, 2))


def test_shorter_last_chunk(tmp_path):
    """A last chunk with half the samples of each channel is read in proportion."""
    half = b"".join(values[:60].tobytes() for values in CHANNELS.values())
    made = tdms_segment(CHANNELS, n_chunks=2, extra=half)
    (tmp_path / "log.tdms").write_bytes(made + tdms_segment(CHANNELS))
    columns = agree(tmp_path / "log.tdms")
    np.testing.assert_array_equal(columns["delta_e_um"], np.concatenate([SHORT, SHORT[:60], SHORT]))


def test_channels_that_come_and_go(tmp_path):
    """Text, channels of some segments only, and scaled counts are between the samples."""
    scale = {
        "NI_Number_Of_Scales": 1,
        "NI_Scale[0]_Scale_Type": "Polynomial",
        "NI_Scale[0]_Polynomial_Coefficients_Size": 3,
        "NI_Scale[0]_Polynomial_Coefficients[0]": 1.0,
        "NI_Scale[0]_Polynomial_Coefficients[1]": 2.0,
        "NI_Scale[0]_Polynomial_Coefficients[2]": 0.25,
        "NI_Scale[0]_Polynomial_Input_Source": 0xFFFFFFFF,
    }
    path = tmp_path / "log.tdms"
    counts = np.arange(240, dtype="i2")
    with TdmsWriter(str(path)) as writer:
        writer.write_segment(
            [
                ChannelObject("log", "remark", np.array(["a", "bcd"] * 20)),
                ChannelObject("log", "delta_e_um", SHORT),
                ChannelObject("log", "acc_x_g", counts, scale),
            ]
        )
        writer.write_segment([ChannelObject("log", "acc_x_g", counts[:7])])
        writer.write_segment([ChannelObject("log", "remark", np.array(["only text"]))])
        writer.write_segment([ChannelObject("log", "delta_e_um", SHORT[:9])])
    columns = agree(path)
    assert {name: values.size for name, values in columns.items()} == {
        "delta_e_um": 249,
        "acc_x_g": 247,
    }
    np.testing.assert_array_equal(columns["acc_x_g"][-7:], 1 + 2 * counts[:7] + counts[:7] ** 2 / 4)


def test_counts_of_acquisition_cards(needs):
    """Raw counts of DAQmx are scaled by npTDMS."""
    needs("data")
    path = Path(os.environ["LMSHEALTH_DATA"]) / "tdms_reader_samples/raw1.tdms"
    with TdmsFile.open(path) as file:
        channel = file.groups()[0].channels()[0]
        name = channel.name
        whole = channel[:]
    columns = ColumnMap(columns={"acc_x_m_s2": name})
    np.testing.assert_array_equal(load(path, columns).columns[name], whole)


def test_limit_of_memory(tmp_path):
    """A segment that takes more memory than allowed is refused with the next step."""
    (tmp_path / "log.tdms").write_bytes(tdms_segment(CHANNELS))
    n_bytes = sum(values.nbytes for values in CHANNELS.values())
    assert load(tmp_path / "log.tdms", ColumnMap(), 2 * n_bytes).columns
    with pytest.raises(Unusable, match="convert the file to HDF5 or Parquet, or raise") as caught:
        load(tmp_path / "log.tdms", ColumnMap(), 2 * n_bytes - 1)
    assert caught.value.reason == "too-large"


def write_segments(path, *segments):
    """Write one channel in g, each segment with its samples and properties."""
    with TdmsWriter(str(path)) as writer:
        for values, properties in segments:
            own = {"unit_string": "g", **properties}
            writer.write_segment([ChannelObject("log", "x", values, own)])
    return path


def test_segments_of_other_clocks(tmp_path):
    """A segment of another increment or a late start is placed in time; a continued one is not."""
    moment = np.datetime64("2026-03-01T08:30:00", "us")
    values = np.random.default_rng(0).standard_normal(6000)
    first = (values[:3000], {"wf_start_time": moment, **RATE})
    log = read_log(
        write_segments(tmp_path / "a.tdms", first, (values[3000:], {"wf_increment": 1.2e-3}))
    )
    assert log.sample_rate == pytest.approx(1000 / 1.2, rel=1e-4) and len(log.pieces) == 2
    for late, n_pieces in ((0, 1), (500, 2)):
        start = moment + np.timedelta64(3000 + late, "ms").astype("timedelta64[us]")
        second = (values[3000:], {"wf_start_time": start, **RATE})
        log = read_log(write_segments(tmp_path / f"{late}.tdms", first, second))
        assert log.sample_rate == 1000.0 and len(log.pieces) == n_pieces


def clock(start=0.0, offset=0.0, **more):
    """Make the properties of a channel of 2 kHz that starts some seconds after 8 o'clock."""
    moment = np.datetime64("2026-03-01T08:00:00", "us") + np.timedelta64(round(1e6 * start), "us")
    own = {"wf_increment": 5e-4, "wf_start_time": moment, "wf_start_offset": offset}
    return {"unit_string": "g", **own, **more}


@pytest.mark.parametrize(("start", "offset"), [(0.05, 0.0), (0.0, 0.05), (0.03, 0.02)])
def test_channels_that_start_later_are_aligned(tmp_path, start, offset):
    """Channels some whole samples apart are used where both have samples, in one time."""
    whole = np.random.default_rng(1).normal(size=(2, 1100))
    late = whole[1][100:] + 0.5 * whole[0][100:]
    path = write(tmp_path / "a.tdms", ("a", whole[0], clock()), ("b", late, clock(start, offset)))
    log = read_log(path)
    np.testing.assert_allclose(log.channels[0].values[:], 9.80665 * whole[0][100:])
    np.testing.assert_allclose(log.channels[1].values[:], 9.80665 * late)
    assert "starts 100 samples (0.05 s) after" in log.refused[0].detail


@pytest.mark.parametrize("late", [0.00525, 0.7])
def test_channels_that_cannot_be_aligned(tmp_path, late):
    """A fraction of a sample, or half of the record: the minority is refused with both starts."""
    channels = [("a", NOISE, clock()), ("b", NOISE[::-1], clock())]
    path = write(tmp_path / "a.tdms", *channels, ("c", NOISE**3, clock(late)))
    log = read_log(path)
    assert [c.name for c in log.channels] == ["acc_a", "acc_b"]
    assert f"starts at {late:g} s, the others at 0 s" in log.refused[0].detail
    assert log.channels[0].values.size == NOISE.size


def test_starts_that_are_equal_or_absent(tmp_path):
    """Rounding of start times, and channels without one, change nothing."""
    without = {"unit_string": "g", "wf_increment": 5e-4}
    path = write(
        tmp_path / "a.tdms",
        *(("a", NOISE, clock()), ("b", NOISE[::-1], clock(1e-5)), ("c", NOISE**3, without)),
        n_segments=3,
    )
    log = read_log(path)
    assert len(log.channels) == 3 and log.refused == () and log.channels[0].values.size == 2000


@pytest.mark.parametrize("name", ["Time", "Zeitstempel", "x"])
def test_a_channel_of_moments_is_the_time(tmp_path, name):
    """Moments place samples where no rate is stated, and date the log."""
    stamps = np.datetime64("2026-03-01T08:00:00", "us") + np.arange(2000) * np.timedelta64(
        500, "us"
    )
    path = write(tmp_path / "a.tdms", (name, stamps, {}), ("a", NOISE, {"unit_string": "g"}))
    log = read_log(path)
    assert log.sample_rate == pytest.approx(2000.0)
    moment = log.metadata.recorded_at
    assert moment is not None and moment.isoformat() == "2026-03-01T08:00:00+00:00"
    mapped = ColumnMap(columns={"time_ms": name, "acc_b_g": "a"})
    assert read_log(path, columns=mapped).sample_rate == pytest.approx(2000.0)
    rated = write(tmp_path / "b.tdms", (name, stamps[:1].repeat(2000), {}), ("a", NOISE, clock()))
    assert read_log(rated).sample_rate == 2000.0
    with pytest.raises(BadLog, match="one number per sample"):
        read_log(path, columns=ColumnMap(columns={"acc_b_g": name}))
