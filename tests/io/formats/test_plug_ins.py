"""Formats of plug-ins, and the conformance test that all formats pass and wrong ones fail."""

from __future__ import annotations

import logging
import re
from dataclasses import replace
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import lmshealth._private as plug_ins
from lmshealth.errors import BadLog
from lmshealth.io.buffers import as_samples
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats import registry
from lmshealth.io.formats.content import Content, Format, wanted
from lmshealth.io.formats.instruments import RTX, TRACE
from lmshealth.io.formats.uff import UFF
from lmshealth.io.manifest import find_logs
from lmshealth.io.reading import read_log
from lmshealth.testing import check_format
from tests.io.conftest import META, signals, write, write_uff
from tests.io.formats.test_instruments import rtx, trace

X = np.random.default_rng(2).normal(0, 1, 64)


def load_raw(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    """Read a mark, and float64 values of one acceleration."""
    values = np.frombuffer(path.read_bytes()[4:], "<f8")
    names = wanted(["acc_raw_g"], columns)
    return Content(
        {n: as_samples(values) for n in names}, {"sample_rate_hz": "1000"}, ("acc_raw_g",)
    )


RAW = Format("raw accelerations", (".raw",), lambda head: head.startswith(b"RAW1"), load_raw)


class Point(EntryPoint):
    """An entry point that gives an object, or fails."""

    def load(self):
        """Return what stands for the object of the module."""
        found = OBJECTS[self.name]
        if isinstance(found, Exception):
            raise found
        return found


def _no_content(path: Path, columns: ColumnMap, max_memory: float) -> Any:
    """Break the protocol of formats."""
    return {"acc": 1}


OBJECTS: dict[str, object] = {
    "raw": RAW,
    "missing": ModuleNotFoundError("No module named 'vendor'"),
    "number": 7,
    "taken": replace(RAW, suffixes=(".my.csv",)),
    "again": RAW,
    "liar": replace(RAW, suffixes=(".liar",), load=_no_content),
    "texts": replace(
        RAW,
        suffixes=(".texts",),
        load=lambda path, columns, most: Content({"acc_x_g": np.array(["a"])}, {}, ("acc_x_g",)),
    ),
    "falls": replace(RAW, suffixes=(".falls",), sniff=lambda head: head[9999] == 0),
}


@pytest.fixture
def plugged(monkeypatch):
    """Install the plug-ins above for one test."""
    points = []
    for name in OBJECTS:
        point = Point(name, "some.module:FORMAT", registry.GROUP)
        vars(point)["dist"] = SimpleNamespace(name=f"lmshealth-{name}")
        points.append(point)
    monkeypatch.setattr(plug_ins, "entry_points", lambda group: EntryPoints(points))
    registry.plug_ins.cache_clear()
    yield
    registry.plug_ins.cache_clear()


def test_a_plug_in_is_a_format(tmp_path, plugged, caplog):
    """Its files are found and read; broken plug-ins are named once and disturb nothing."""
    (tmp_path / "a.raw").write_bytes(b"RAW1" + X.tobytes())
    write(tmp_path / "b.csv", signals(), META)
    with caplog.at_level(logging.ERROR):
        logs = [read_log(path) for path in find_logs(tmp_path).logs]
    assert [log.sample_rate for log in logs] == [1000, 2000]
    np.testing.assert_allclose(logs[0].channels[0].values[:], 9.80665 * X)
    said = [record.getMessage() for record in caplog.records]
    broken = {"missing": "No module", "number": "is a int", "taken": ".my.csv", "again": "taken"}
    assert len(said) == len(broken)
    for line, (name, why) in zip(said, broken.items(), strict=True):
        assert f"of lmshealth-{name} is not used" in line and why in line
    with pytest.raises(BadLog, match=r"needed one of .*\.raw"):
        read_log(write(tmp_path / "b.csv", signals(), META).rename(tmp_path / "b.unknown"))


@pytest.mark.parametrize(
    ("suffix", "why"),
    [("liar", "returns a dict"), ("texts", "no array of numbers"), ("falls", "fails .IndexError")],
)
def test_what_a_plug_in_does_wrong_is_its_refusal(tmp_path, plugged, suffix, why):
    """A protocol that is broken while a file is read refuses the file, naming the format."""
    (tmp_path / f"a.{suffix}").write_bytes(b"RAW1" + X.tobytes())
    with pytest.raises(BadLog, match=f"raw accelerations.*{why}"):
        read_log(tmp_path / f"a.{suffix}")


@pytest.mark.parametrize(
    "file", ["a.csv", "a.csv.gz", "a.txt.gz", "a.h5", "a.parquet", "a.tdms", "a.mat"]
)
def test_formats_with_metadata_conform(tmp_path, file):
    """The formats that hold columns of the contract and metadata keep the protocol."""
    columns = {name: values for name, values in signals().items() if name != "time_s"}
    path = write(tmp_path / file, columns, META)
    known = {} if file.endswith(("tdms", "mat")) else META
    found = registry.format_of(path)
    assert found is not None
    check_format(found, path, columns, metadata=known)


def test_formats_with_a_map_conform(tmp_path):
    """So do UFF58, the laser and the trace."""
    check_format(RTX, _bytes(tmp_path / "a.rtx", rtx(X)), {"data": X},
                 columns=ColumnMap(columns={"delta_e_mm": "data"}))  # fmt: skip
    check_format(TRACE, _bytes(tmp_path / "a.xml", trace(X).encode()), TRACED,
                 columns=ColumnMap(columns={"delta_e_mm": "lag error"}))  # fmt: skip
    path = write_uff(tmp_path / "a.uff", {"sensor": X}, ordinate_spec_data_type=12, binary=1)
    check_format(UFF, path, {"acc_sensor_g": X})
    check_format(RAW, _bytes(tmp_path / "a.raw", b"RAW1" + X.tobytes()), {"acc_raw_g": X})


TRACED = {"time_s": np.arange(X.size) / 1000, "lag error": X}


def _bytes(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def _with(change):
    """Return a reader that changes what the right one returns."""

    def load(path, columns, max_memory):
        return change(load_raw(path, columns, max_memory))

    return load


def _shuffled(path, columns, max_memory):
    if path.stat().st_size == 4 + X.nbytes:
        return load_raw(path, columns, max_memory)
    return Content({"acc_raw_g": np.zeros(40)}, {}, ("acc_raw_g",))


def _greedy(path, columns, max_memory):
    content = load_raw(path, columns, max_memory)
    return replace(content, columns={**content.columns, "speed": X}) if columns.columns else content


def _of_nothing(path, columns, max_memory):
    if not path.stat().st_size:
        return Content({"acc_raw_g": X}, {}, ("acc_raw_g",))
    return load_raw(path, columns, max_memory)


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "suffix": ({"suffixes": (".RAW", ".raw")}, "lower case"),
    "name": ({"name": ""}, "printable"),
    "sniff": ({"sniff": lambda head: True}, "return False"),
    "blind": ({"sniff": lambda head: False}, "return True"),
    "local": ({"library": "vendor", "load": _with(lambda c: c)}, "function of a module"),
    "values": ({"load": _with(lambda c: replace(c, columns={"acc_raw_g": X + 1}))}, "differs"),
    "greedy": ({"load": _greedy}, "do not name"),
    "metadata": ({"load": _with(lambda c: replace(c, metadata={"sample_rate_hz": 1}))}, "no text"),
    "lost": ({"load": _with(lambda c: replace(c, metadata={}))}, "needed '1000'"),
    "silent": ({"load": _with(lambda c: replace(c, present=()))}, "present is empty"),
    "invents": ({"load": _shuffled}, "has other values"),
    "empty": ({"load": _of_nothing}, "empty file"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_format_fails(tmp_path, wrong):
    """Each fault of a format is found, and said."""
    changes, why = WRONG[wrong]
    path = _bytes(tmp_path / "a.raw", b"RAW1" + X.tobytes())
    with pytest.raises(AssertionError, match=why):
        check_format(
            replace(RAW, **changes), path, {"acc_raw_g": X}, metadata={"sample_rate_hz": "1000"}
        )
    assert [one.name for one in tmp_path.iterdir()] == ["a.raw"]


def test_a_folder_of_compressed_text_is_read(tmp_path):
    """Every suffix of text is read compressed, and then also collected from folders."""
    for k, suffix in enumerate((*registry.TEXT_SUFFIXES, ".csv", ".lvm")):
        write(tmp_path / f"{k}{suffix}.gz", signals(), META)
    logs = find_logs(tmp_path).logs
    assert len(logs) == 6 and {read_log(path).sample_rate for path in logs} == {2000.0}


def test_the_example_of_the_page_conforms(tmp_path, root):
    """The plug-in of the README passes its own test, and fails it with another byte order."""
    page = (root / "lmshealth" / "io" / "README.md").read_text(encoding="utf-8")
    reader, test = re.findall(r"^```python\n(.*?)^```$", page, re.S | re.M)
    names: dict[str, Any] = {}
    exec(reader + test, names)
    names["test_format"](tmp_path)
    exec(reader.replace("<f4", ">f4") + test, names)
    with pytest.raises(AssertionError, match="differs"):
        names["test_format"](tmp_path)
