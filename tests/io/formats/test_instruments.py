"""Files of instruments that are no tables of text, written to their layouts."""

import gzip

import numpy as np
import pytest

from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.manifest import find_logs
from lmshealth.io.reading import read_log
from tests.io.handmade import uff_set

X = 1e-3 * np.sin(np.arange(400) * 0.7)


def rtx(values: np.ndarray) -> bytes:
    """Write the header lines, the values and the end mark of a laser file."""
    head = "HEADER::\r\nOwner: Renishaw\r\nActual sample rate: 1000.0\r\nAxis: X\r\nData:\r\n"
    return head.encode() + values.astype("<f8").tobytes() + b"EOF::\r\n"


def trace(x: np.ndarray) -> str:
    """Write a trace of two signals, of which one has no value in every other record."""
    rows = [
        f'<rec time="{k / 1000}" f1="{v!r}" f2="{1.0 if k % 2 else 9.3e18}"/>'
        for k, v in enumerate(x.tolist())
    ]
    signals = '<dataSignal description="lag error (64 bit)" name="/x"/><dataSignal name="/v"/>'
    frame = f"<dataFrame>{signals}{''.join(rows)}</dataFrame>"
    return f"<?xml version='1.0'?><traceDisplay><traceData>{frame}</traceData></traceDisplay>"


def test_laser(tmp_path):
    """The values and the rate of a laser file are read; a cut one is refused."""
    columns = ColumnMap(columns={"delta_e_mm": "data"})
    (tmp_path / "log.rtx").write_bytes(rtx(X))
    log = read_log(tmp_path / "log.rtx", columns=columns)
    assert log.sample_rate == 1000
    np.testing.assert_allclose(log.channels[0].values[:], 1e-3 * X, rtol=1e-12)
    for damaged in (rtx(X)[:-9], rtx(X).replace(b"EOF::", b"1EOF::")):
        (tmp_path / "log.rtx").write_bytes(damaged)
        with pytest.raises(BadLog, match="corrupt"):
            read_log(tmp_path / "log.rtx", columns=columns)


@pytest.mark.parametrize("suffix", [".rtx", ".xml", ".uff"])
def test_compressed_files_are_read_and_found(tmp_path, suffix):
    """They hold what the file held before; another content is refused, and so is a cut one."""
    content = {
        ".rtx": rtx(X),
        ".xml": trace(X).encode(),
        ".uff": uff_set(
            (body := X.astype("<f8").tobytes()), X.size, name="delta_e_mm", binary=str(len(body))
        ),
    }[suffix]
    source = {".rtx": "data", ".xml": "lag error", ".uff": "delta_e_mm"}[suffix]
    path, columns = tmp_path / f"log{suffix}.gz", ColumnMap(columns={"delta_e_mm": source})
    path.write_bytes(gzip.compress(content))
    log = read_log(path, columns=columns)
    np.testing.assert_allclose(log.channels[0].values[:], 1e-3 * X, rtol=1e-12)
    assert find_logs(tmp_path).logs == (path,)
    for damaged in (gzip.compress(b"PK" + content), gzip.compress(content)[:-20]):
        path.write_bytes(damaged)
        with pytest.raises(BadLog, match="corrupt"):
            read_log(path, columns=columns)


def test_trace(tmp_path):
    """Signals of a trace are named by their description; what has no value is missing."""
    (tmp_path / "log.xml").write_text(trace(X))
    log = read_log(tmp_path / "log.xml", columns=ColumnMap(columns={"delta_e_mm": "lag error"}))
    assert log.sample_rate == pytest.approx(1000)
    np.testing.assert_allclose(log.channels[0].values[:], 1e-3 * X, rtol=1e-12)
    with pytest.raises(BadLog, match=r"there: time \[s\], lag error, /v"):
        read_log(tmp_path / "log.xml")
    columns = ColumnMap(columns={"delta_e_mm": "lag error", "acc_x_g": "/v"})
    refused = read_log(tmp_path / "log.xml", columns=columns).refused
    assert [(one.channel, one.reason) for one in refused] == [("acc_x", "missing-samples")]


def test_a_damaged_trace_is_refused(tmp_path):
    """A trace that is cut off is refused, and so is another document."""
    for text in (trace(X)[:-300], "<?xml version='1.0'?><a/>"):
        (tmp_path / "log.xml").write_text(text)
        with pytest.raises(BadLog, match=r"corrupt|columns"):
            read_log(tmp_path / "log.xml", columns=ColumnMap(columns={"delta_e_mm": "lag error"}))
