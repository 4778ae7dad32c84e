"""The samples of TDMS segments: every layout as npTDMS reads it, in blocks of any size."""

import os
from pathlib import Path

import numpy as np
import pytest
from nptdms import ChannelObject, TdmsFile, TdmsWriter

from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats import tdmsdata
from lmshealth.io.formats.registry import load
from lmshealth.io.formats.tdmsdata import raw_samples
from lmshealth.io.refusal import Unusable
from tests.io.handmade import tdms_segment

NOISE = np.random.default_rng(0).normal(size=240)
CHANNELS = {
    "delta_e_um": NOISE,
    "other": np.arange(240, dtype="i2"),
    "acc_x_g": NOISE.astype("f4"),
}


def agree(path):
    """Compare the wanted channels with what npTDMS reads."""
    columns = load(path, ColumnMap()).columns
    group = TdmsFile.read(path)["log"]
    for name in ("delta_e_um", "acc_x_g"):
        np.testing.assert_array_equal(columns[name], group[name][:])
    assert set(columns) == {"delta_e_um", "acc_x_g"}
    return columns


@pytest.mark.parametrize("block", [24, 1000, 1 << 20])
@pytest.mark.parametrize("n_chunks", [1, 3, 240])
@pytest.mark.parametrize("interleaved", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
def test_layouts(tmp_path, monkeypatch, order, interleaved, n_chunks, block):
    """Chunks one after the other and samples in turns, in either order of bytes."""
    monkeypatch.setattr(tdmsdata, "_BLOCK", block)
    made = tdms_segment(CHANNELS, order=order, interleaved=interleaved, n_chunks=n_chunks)
    (tmp_path / "log.tdms").write_bytes(made + made)
    columns = agree(tmp_path / "log.tdms")
    np.testing.assert_array_equal(columns["delta_e_um"], np.tile(NOISE, 2))


@pytest.mark.parametrize("block", [24, 1 << 20])
def test_shorter_last_chunk(tmp_path, monkeypatch, block):
    """A last chunk with half the samples of each channel is read in proportion."""
    monkeypatch.setattr(tdmsdata, "_BLOCK", block)
    half = b"".join(values[:60].tobytes() for values in CHANNELS.values())
    made = tdms_segment(CHANNELS, n_chunks=2, extra=half)
    (tmp_path / "log.tdms").write_bytes(made + tdms_segment(CHANNELS))
    columns = agree(tmp_path / "log.tdms")
    np.testing.assert_array_equal(columns["delta_e_um"], np.concatenate([NOISE, NOISE[:60], NOISE]))


@pytest.mark.parametrize("block", [24, 1 << 20])
def test_channels_that_come_and_go(tmp_path, monkeypatch, block):
    """Text, channels of some segments only, and scaled counts stand between the samples."""
    monkeypatch.setattr(tdmsdata, "_BLOCK", block)
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
                ChannelObject("log", "said", np.array(["a", "bcd"] * 20)),
                ChannelObject("log", "delta_e_um", NOISE),
                ChannelObject("log", "acc_x_g", counts, scale),
            ]
        )
        writer.write_segment([ChannelObject("log", "acc_x_g", counts[:7])])
        writer.write_segment([ChannelObject("log", "said", np.array(["only text"]))])
        writer.write_segment([ChannelObject("log", "delta_e_um", NOISE[:9])])
    columns = agree(path)
    assert {name: values.size for name, values in columns.items()} == {
        "delta_e_um": 249,
        "acc_x_g": 247,
    }
    np.testing.assert_array_equal(columns["acc_x_g"][-7:], 1 + 2 * counts[:7] + counts[:7] ** 2 / 4)


def test_what_is_kept_is_small(tmp_path):
    """A block that is handed on does not keep those of the other channels in memory."""
    many = {f"other{k}": NOISE for k in range(20)}
    (tmp_path / "log.tdms").write_bytes(tdms_segment({"delta_e_um": NOISE, **many}))
    with (tmp_path / "log.tdms").open("rb") as stream, TdmsFile.open(stream) as file:
        (segment,) = file._reader._segments
        ((path, raw),) = raw_samples(stream, segment, {"/'log'/'delta_e_um'"})
    assert path == "/'log'/'delta_e_um'" and raw.data.base is None
    np.testing.assert_array_equal(raw.data, NOISE)


def test_counts_of_acquisition_cards(needs, monkeypatch):
    """Chunks of DAQmx are left to npTDMS; one that is too long is refused with the next step."""
    needs("data")
    path = Path(os.environ["LMSHEALTH_DATA"]) / "tdms_reader_samples/raw1.tdms"
    with TdmsFile.open(path) as file:
        channel = file.groups()[0].channels()[0]
        name = channel.name
        whole = channel[:]
    columns = ColumnMap(columns={"acc_x_m_s2": name})
    np.testing.assert_array_equal(load(path, columns).columns[name], whole)
    monkeypatch.setattr(tdmsdata, "_LARGEST_DAQMX", 27_999)
    with pytest.raises(Unusable, match="export the channels as numbers") as caught:
        load(path, columns)
    assert caught.value.reason == "too-large"
