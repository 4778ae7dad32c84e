"""Writers of foreign files: two or more for each format, independent of each other.

One writer follows the documented layout by hand, the other is a library that writes the format, or
another way to write the same layout (`csv`, pandas, numpy, ElementTree). A writer returns the
column map that the file needs, if any, and what it holds: channels in SI units.
"""

from __future__ import annotations

import base64
import csv
import gzip
import struct
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pyuff
import scipy.io
from nptdms import ChannelObject, TdmsWriter

from lmshealth.io.column_map import ColumnMap
from tests.io.handmade import array, element, mat_file, tdms_segment, uff_set


class Table(NamedTuple):
    """Two signals of six decimals, ``(n,)``, and their rate in Hz."""

    rate: float
    time: np.ndarray
    a: np.ndarray
    b: np.ndarray


Held = dict[str, np.ndarray]
Writer = Callable[[Path, Table], tuple[ColumnMap | None, Held]]
N = 300


def table(seed: int) -> Table:
    """Draw signals of large and small values, both signs, and a rate."""
    rng = np.random.default_rng(seed)
    rate = float(rng.choice([250, 500, 1000, 2000, 4000]))
    a, b = (np.round(scale * rng.normal(0, 1, N), 6) for scale in 10.0 ** rng.uniform(-2, 3, 2))
    return Table(rate, np.arange(N) / rate, a, b)


def text(value: float, decimal: str = ".") -> str:
    """Write six decimals."""
    return f"{value:.6f}".replace(".", decimal)


def _accelerations(t: Table) -> Held:
    return {"acc_feed": t.a, "acc_pitch": t.b}


# Delimited text


def csv_by_csv(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write the log contract by the csv module."""
    out = StringIO()
    rows = csv.writer(out)
    rows.writerow(["time_s", "acc_feed_m_s2", "acc_pitch_m_s2"])
    rows.writerows([text(x), text(y), text(z)] for x, y, z in zip(*t[1:], strict=True))
    _stored(path, out.getvalue())
    return None, _accelerations(t)


def csv_by_pandas(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write semicolons and decimal commas, as a spreadsheet of Europe, by pandas."""
    names = ["Zeit [s]", "feed [m/s²]", "pitch [m/s²]"]
    frame = pd.DataFrame(np.column_stack(t[1:]), columns=names)
    _stored(path, frame.to_csv(sep=";", decimal=",", index=False, float_format="%.6f"))
    return None, _accelerations(t)


def csv_by_numpy(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write columns between blanks below a remark, by numpy."""
    out = StringIO()
    np.savetxt(out, np.column_stack(t[1:]), fmt="%14.6f", header="time_s acc_feed_g acc_pitch_g")
    _stored(path, out.getvalue())
    return None, {name: 9.80665 * values for name, values in _accelerations(t).items()}


def _stored(path: Path, content: str) -> None:
    data = content.encode()
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)


# Exports of controls and measuring systems

FILETIME = "133481088000000000"


def _scope_head(t: Table, d: str) -> str:
    step = f"{1000 / t.rate:g}"
    rows = {
        "Name": "feed pitch Name slow", "SymbolComment": ". . SymbolComment .",
        "Data-Type": "REAL64 REAL64 Data-Type REAL64",
        "SampleTime[ms]": f"{step} {step} SampleTime[ms] {2000 / t.rate:g}",
        "VariableSize": "8 8 VariableSize 8", "ScaleFactor": "1 1 ScaleFactor 1",
        "Unit": "m/s^2 mm/s^2 Unit m/s^2", "Unit ScaleFactor": "1 1 Unit_ScaleFactor 1",
    }  # fmt: skip
    head = [f"Name{d}scope", f"File{d}x", f"Starttime of export{d}{FILETIME}{d}date{d}time",
            f"Endtime of export{d}{FILETIME}{d}date{d}time", "", ""]  # fmt: skip
    return "\n".join([*head, *(d.join([key, *line.split()]) for key, line in rows.items()), "", ""])


def twincat_by_hand(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write tabs, decimal commas, a slower group between blanks, and EOF."""
    rows = []
    for k in range(N):
        slow = [text(2000 * k / t.rate, ","), "0,5"] if 2 * k < N else ["", ""]
        cells = [text(1000 * t.time[k], ","), text(t.a[k], ","), text(t.b[k], ","), *slow]
        rows.append("\t".join(cells))
    path.write_text(_scope_head(t, "\t") + "\n".join([*rows, "EOF", ""]))
    return None, {"acc_feed": t.a, "acc_pitch": 1e-3 * t.b}


def twincat_by_pandas(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write semicolons and decimal points."""
    half = N // 2
    slow = np.full((2, N), np.nan)
    slow[0, :half], slow[1, :half] = 2000 * np.arange(half) / t.rate, 0.5
    frame = pd.DataFrame({0: 1000 * t.time, 1: t.a, 2: t.b, 3: slow[0], 4: slow[1]})
    body = frame.to_csv(sep=";", index=False, header=False, float_format="%.6f")
    path.write_text(_scope_head(t, ";") + body)
    return None, {"acc_feed": t.a, "acc_pitch": 1e-3 * t.b}


def _lvm_head(t: Table, own_x: str, decimal: str = ".") -> str:
    gap = "\t\t" if own_x == "Multi" else "\t"
    step = f"{1 / t.rate:.9f}".replace(".", decimal)
    x = "X_Value\tfeed\tX_Value\tpitch" if own_x == "Multi" else "X_Value\tfeed\tpitch"
    return "\n".join([
        "LabVIEW Measurement\t", "Writer_Version\t2", "Separator\tTab",
        f"Decimal_Separator\t{decimal}", f"X_Columns\t{own_x}", "Date\t2026/01/05",
        "***End_of_Header***\t", "\t", "Channels\t2\t\t", f"Samples\t{N}{gap}{N}\t",
        f"Y_Unit_Label\tm/s^2{gap}g\t", f"X_Dimension\tTime{gap}Time\t", f"X0\t0{gap}0\t",
        f"Delta_X\t{step}{gap}{step}\t", "***End_of_Header***\t\t\t", f"{x}\tComment", "",
    ])  # fmt: skip


def lvm_by_hand(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write no X values, and decimal commas."""
    rows = [f"\t{text(a, ',')}\t{text(b, ',')}" for a, b in zip(t.a, t.b, strict=True)]
    path.write_text(_lvm_head(t, "No", ",") + "\n".join(rows) + "\n")
    return None, {"acc_feed": t.a, "acc_pitch": 9.80665 * t.b}


def lvm_by_pandas(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write one column of X values."""
    frame = pd.DataFrame(np.column_stack(t[1:]))
    body = frame.to_csv(sep="\t", index=False, header=False, float_format="%.6f")
    path.write_text(_lvm_head(t, "One") + body)
    return None, {"acc_feed": t.a, "acc_pitch": 9.80665 * t.b}


def lvm_by_numpy(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write a column of X values before each channel."""
    out = StringIO()
    np.savetxt(out, np.column_stack([t.time, t.a, t.time, t.b]), fmt="%.6f", delimiter="\t")
    path.write_text(_lvm_head(t, "Multi") + out.getvalue())
    return None, {"acc_feed": t.a, "acc_pitch": 9.80665 * t.b}


def gcs_by_hand(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write blanks between values and at the end of a row."""
    head = ["# VERSION = 1", "# TYPE = 1", "# SEPARATOR = 32", "# DIM = 2", f"# NDATA = {N}",
            f"# SAMPLE_TIME = {1 / t.rate!r}", "# NAME0 = Position Error", "# NAME1 = Accel",
            "# END_HEADER"]  # fmt: skip
    rows = [f"{text(a)} {text(b)} " for a, b in zip(t.a, t.b, strict=True)]
    path.write_text("[GCS_ARRAY]\n" + "\n".join([*head, *rows, ""]))
    return _map({"delta_e_um": "Position Error", "acc_x_g": "Accel"}), {
        "delta_e": 1e-6 * t.a, "acc_x": 9.80665 * t.b,
    }  # fmt: skip


def gcs_by_numpy(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write tabs, by numpy."""
    out = StringIO()
    head = f"SEPARATOR = 9\nDIM = 2\nSAMPLE_TIME = {1 / t.rate!r}\nEND_HEADER"
    np.savetxt(out, np.column_stack(t[2:]), fmt="%.6f", delimiter="\t", header=head)
    path.write_text(out.getvalue())
    return _map({"delta_e_um": "0", "acc_x_g": "1"}), {
        "delta_e": 1e-6 * t.a, "acc_x": 9.80665 * t.b,
    }  # fmt: skip


def klipper_by_hand(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write mm/s² as Klipper does."""
    rows = [f"{x:.6f},{a:.6f},{b:.6f},{k % 7:.6f}" for k, (x, a, b) in
            enumerate(zip(*t[1:], strict=True))]  # fmt: skip
    path.write_text("\n".join(["#time,accel_x,accel_y,accel_z", *rows, ""]))
    return None, {"acc_accel_x": 1e-3 * t.a, "acc_accel_y": 1e-3 * t.b}


def klipper_by_pandas(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write the same below a line of statistics."""
    frame = pd.DataFrame({"#time": t.time, "accel_x": t.a, "accel_y": t.b, "accel_z": t.a[::-1]})
    path.write_text("##stats errors=0\n" + frame.to_csv(index=False, float_format="%.6f"))
    return None, {"acc_accel_x": 1e-3 * t.a, "acc_accel_y": 1e-3 * t.b}


def xps_by_hand(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write a gathering of Newport: two header lines, then numbers between blanks."""
    rows = [f"{text(a)}  {text(b)}" for a, b in zip(t.a, t.b, strict=True)]
    path.write_text("\n".join(["GatheringExternal 2", "X.FollowingError X.Accel", *rows, ""]))
    return _map({"delta_e_um": "X.FollowingError", "acc_x_g": "X.Accel"}, t.rate), {
        "delta_e": 1e-6 * t.a, "acc_x": 9.80665 * t.b,
    }  # fmt: skip


def xps_by_numpy(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write tabs."""
    out = StringIO("")
    np.savetxt(out, np.column_stack(t[2:]), fmt="%.6f", delimiter="\t", comments="",
               header="Gathering\nX.FollowingError\tX.Accel")  # fmt: skip
    path.write_text(out.getvalue())
    return _map({"delta_e_um": "X.FollowingError", "acc_x_g": "X.Accel"}, t.rate), {
        "delta_e": 1e-6 * t.a, "acc_x": 9.80665 * t.b,
    }  # fmt: skip


def rtx_by_struct(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write values one by one."""
    head = f"HEADER::\r\nActual sample rate: {t.rate}\r\nAxis: X\r\nData:\r\n".encode()
    path.write_bytes(head + struct.pack(f"<{N}d", *t.a.tolist()) + b"EOF::\r\n")
    return _map({"delta_e_mm": "data"}), {"delta_e": 1e-3 * t.a}


def rtx_by_numpy(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write values at once, below further keys."""
    head = f"HEADER::\r\nOwner: a: b\r\nSample rate: {t.rate:g}\r\nData:\r\n".encode()
    path.write_bytes(head + t.a.astype("<f8").tobytes() + b"EOF::")
    return _map({"delta_e_mm": "data"}), {"delta_e": 1e-3 * t.a}


def trace_by_hand(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write signals and records as text."""
    rows = [f'<rec time="{x!r}" f1="{a!r}" f2="{b!r}"/>' for x, a, b in
            zip(*(c.tolist() for c in t[1:]), strict=True)]  # fmt: skip
    signals = '<dataSignal description="lag (64 bit)" key="1"/><dataSignal name="/v" key="2"/>'
    path.write_text(f"<?xml version='1.0'?><trace><traceData><dataFrame>{signals}{''.join(rows)}"
                    "</dataFrame></traceData></trace>")  # fmt: skip
    return _map({"delta_e_um": "lag", "acc_v_g": "/v"}), {
        "delta_e": 1e-6 * t.a, "acc_v": 9.80665 * t.b,
    }  # fmt: skip


def trace_by_elementtree(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write the same, with the set-up of the display before it, by ElementTree."""
    root = ET.Element("trace")
    signals = ET.SubElement(ET.SubElement(root, "traceDisplaySetup"), "signals")
    frame = ET.SubElement(ET.SubElement(root, "traceData"), "dataFrame")
    for key, name in (("1", "lag"), ("2", "/v")):
        ET.SubElement(signals, "signal", key=key, description=name)
        ET.SubElement(frame, "dataSignal", key=key, description=name)
    for x, a, b in zip(*(c.tolist() for c in t[1:]), strict=True):
        ET.SubElement(frame, "rec", time=repr(x), f1=repr(a), f2=repr(b))
    ET.indent(root)
    ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
    return _map({"delta_e_um": "lag", "acc_v_g": "/v"}), {
        "delta_e": 1e-6 * t.a, "acc_v": 9.80665 * t.b,
    }  # fmt: skip


# Binary formats


def _columns(t: Table) -> Held:
    return {"time_s": t.time, "acc_feed_m_s2": t.a, "acc_pitch_m_s2": t.b}


def hdf5_by_h5py(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write one dataset per column."""
    with h5py.File(path, "w") as file:
        for name, values in _columns(t).items():
            file[name] = values
    return None, _accelerations(t)


def hdf5_by_xarray(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write NetCDF, which is HDF5, by xarray."""
    import xarray as xr

    data = xr.Dataset({name: ("row", values) for name, values in _columns(t).items()})
    data.to_netcdf(path, engine="h5netcdf")
    return None, _accelerations(t)


def parquet_by_arrow(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write a table of pyarrow."""
    pq.write_table(pa.table(_columns(t)), path)
    return None, _accelerations(t)


def parquet_by_pandas(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write a frame of pandas, with its index."""
    pd.DataFrame(_columns(t)).to_parquet(path, compression="gzip", index=True)
    return None, _accelerations(t)


def tdms_by_library(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write channels with units and intervals."""
    step = {"wf_increment": 1 / t.rate}
    rows = (("feed", t.a, "m/s^2"), ("pitch", t.b, "g"))
    channels = [ChannelObject("g", n, v, step | {"unit_string": unit}) for n, v, unit in rows]
    with TdmsWriter(str(path)) as writer:
        writer.write_segment(channels)
    return None, {"acc_feed": t.a, "acc_pitch": 9.80665 * t.b}


def tdms_by_hand(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write bytes: two segments, big-endian, interleaved."""
    parts = (
        {k: v[:100] for k, v in _columns(t).items()},
        {k: v[100:] for k, v in _columns(t).items()},
    )
    path.write_bytes(b"".join(tdms_segment(p, order=">", interleaved=True) for p in parts))
    return None, _accelerations(t)


def mat_by_scipy(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write columns in a compressed struct."""
    scipy.io.savemat(path, {"log": {"t": t.time, "a": t.a, "b": t.b}}, do_compression=True)
    return _map({"time_s": "log.t", "acc_a_g": "log.a", "acc_b_g": "log.b"}), {
        "acc_a": 9.80665 * t.a, "acc_b": 9.80665 * t.b,
    }  # fmt: skip


def mat_by_hand(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write bytes: big-endian arrays of the log contract."""
    arrays = [array(6, (N, 1), name.encode(), element(9, values.astype(">f8").tobytes(), ">"), ">")
              for name, values in _columns(t).items()]  # fmt: skip
    mat_file(path, *arrays, order=">")
    return None, _accelerations(t)


def uff_by_pyuff(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write binary time records in g."""
    file = pyuff.UFF(str(path))
    for name, values in (("feed", t.a), ("pitch", t.b)):
        content = pyuff.prepare_58(
            binary=1, id1=name, func_type=1, rsp_node=1, rsp_dir=1, ref_node=0, ref_dir=0,
            abscissa_spacing=1, abscissa_min=0.0, abscissa_inc=1 / t.rate,
            abscissa_spec_data_type=17, abscissa_axis_units_lab="s", ordinate_spec_data_type=12,
            ordinate_axis_units_lab="g", orddenom_spec_data_type=0, data=values, x=t.time,
        )  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)
            file.write_sets([content], mode="add")
    return None, {"acc_feed": 9.80665 * t.a, "acc_pitch": 9.80665 * t.b}


def uff_by_hand(path: Path, t: Table) -> tuple[ColumnMap | None, Held]:
    """Write ASCII records of four numbers, at 20 kHz, as the header of the layout says."""
    sets = []
    for name, values in (("delta_e_um", t.a), ("acc_feed_g", t.b)):
        words = [f"{v:20.12E}" for v in values.tolist()]
        lines = ["".join(words[k : k + 4]) for k in range(0, N, 4)]
        sets.append(uff_set(("\n".join(lines) + "\n").encode(), N, name=name))
    path.write_bytes(b"".join(sets))
    return None, {"delta_e": 1e-6 * t.a, "acc_feed": 9.80665 * t.b}


def _map(columns: dict[str, str], rate: float | None = None) -> ColumnMap:
    return ColumnMap(columns=columns, sample_rate_hz=rate)


# By format: suffix, and its writers.
WRITERS: dict[str, tuple[str, tuple[Writer, ...]]] = {
    "CSV": (".csv", (csv_by_csv, csv_by_pandas, csv_by_numpy)),
    "text": (".txt", (csv_by_csv, csv_by_pandas, csv_by_numpy)),
    "compressed text": (".txt.gz", (csv_by_csv, csv_by_pandas, csv_by_numpy)),
    "TwinCAT Scope": (".csv", (twincat_by_hand, twincat_by_pandas)),
    "LabVIEW": (".lvm", (lvm_by_hand, lvm_by_pandas, lvm_by_numpy)),
    "PI GCS array": (".dat", (gcs_by_hand, gcs_by_numpy)),
    "Klipper": (".csv", (klipper_by_hand, klipper_by_pandas)),
    "XPS gathering": (".dat", (xps_by_hand, xps_by_numpy)),
    "Renishaw laser": (".rtx", (rtx_by_struct, rtx_by_numpy)),
    "SINUMERIK trace": (".xml", (trace_by_hand, trace_by_elementtree)),
    "HDF5": (".h5", (hdf5_by_h5py, hdf5_by_xarray)),
    "Parquet": (".parquet", (parquet_by_arrow, parquet_by_pandas)),
    "TDMS": (".tdms", (tdms_by_library, tdms_by_hand)),
    "MAT": (".mat", (mat_by_scipy, mat_by_hand)),
    "UFF58": (".uff", (uff_by_pyuff, uff_by_hand)),
}

# Rates in Hz of writers that write no other.
RATES = {"uff_by_hand": 20_000.0}

# Frequency responses of SINUMERIK

_STANDARD = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz!#$%&()*+-;<=>?@^_`{|}~"
_OF_CONTROL = (
    "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ!#$`()*+-/:;=?@[]^_{|}~"
)


def words_by_hand(values: np.ndarray) -> str:
    """Write doubles in base 85 digit by digit; zero words are points."""
    numbers = values.astype(">f8").view(">u4").tolist()
    digits = (("".join(_OF_CONTROL[n // 85**k % 85] for k in (4, 3, 2, 1, 0)) if n else ".")
              for n in numbers)  # fmt: skip
    return "".join(digits)


def words_by_base64(values: np.ndarray) -> str:
    """Write doubles by the base85 of Python, in the digits of the control."""
    encoded = base64.b85encode(values.astype(">f8").tobytes()).decode()
    return encoded.translate(str.maketrans(_STANDARD, _OF_CONTROL))


def tuning(path: Path, f: np.ndarray, h: np.ndarray, words: Callable[[np.ndarray], str]) -> None:
    """Write a servo tuning with a plant at frequencies in Hz, ``(n_lines,)``."""
    arrays = {"m_ValueVector": h.view(float), "m_FrequencyVector": f}
    inner = "".join(f'<NumericArray name="{name}"><raw><![CDATA[{words(values)}]]></raw>'
                    "</NumericArray>" for name, values in arrays.items())  # fmt: skip
    path.write_text(f"<?xml version='1.0'?><T><FrequencyResponseFunction name='m_pPlant'>{inner}"
                    "</FrequencyResponseFunction></T>")  # fmt: skip
