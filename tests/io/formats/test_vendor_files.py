"""Files of measuring systems and controls, written to their layouts."""

import gzip

import numpy as np
import pytest

from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.manifest import find_logs
from lmshealth.io.reading import read_log
from lmshealth.modal.frf.identification import read_measured
from lmshealth.modal.frf.measured import read_responses
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


DIGITS = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ!#$`()*+-/:;=?@[]^_{|}~"
F = np.arange(1.0, 801.0)
S = 2j * np.pi * F
W = 2 * np.pi * 126.4
H = S**2 / (S**2 + 2 * 0.015 * W * S + W**2)


def words(values: np.ndarray) -> str:
    """Write doubles in base 85, zero words as points, in lines."""
    text = ""
    for number in values.astype(">f8").view(">u4").tolist():
        digits = [DIGITS[number // 85**k % 85] for k in range(4, -1, -1)]
        text += "".join(digits) if number else "."
    return "\n   ".join(text[k : k + 200] for k in range(0, len(text), 200))


def spectrum(tag: str, name: str, values: np.ndarray) -> str:
    """Write a spectrum of complex values."""
    arrays = (("m_ValueVector", values.astype(complex).view(float)), ("m_FrequencyVector", F))
    inner = "".join(
        f'<NumericArray name="{key}"><raw><![CDATA[{words(v)}]]></raw></NumericArray>'
        for key, v in arrays
    )
    return f'<{tag} name="{name}">{inner}</{tag}>'


def tuning(h: np.ndarray) -> str:
    """Write a servo tuning: the plant and its coherence."""
    parts = [("m_pPlant", h), ("m_pMeasCoherence", np.full(F.size, 0.99))]
    inner = "".join(spectrum("FrequencyResponseFunction", *part) for part in parts)
    return f"<?xml version='1.0'?><AutoTune>{inner}</AutoTune>"


def response_test(h: np.ndarray) -> str:
    """Write a response test: power spectra of output and input, and their cross spectrum."""
    power = 1 + F / 100

    def info(name: str, node: int, values: np.ndarray) -> str:
        inside = spectrum("CrossSpectrum", "m_avgCrossSpec", values)
        return (f'<SigNodeCrossSpectrumInfo name="{name}"><unsigned_int name="m_uSignodeId">{node}'
                f"</unsigned_int>{inside}</SigNodeCrossSpectrumInfo>")  # fmt: skip

    def node(number: int, unique: int, *infos: str) -> str:
        return (f'<PlatformSignalNode><unsigned_int name="m_uNodeId">{number}</unsigned_int>'
                f'<integer name="m_iUniqueInstanceId">{unique}</integer>{"".join(infos)}'
                "</PlatformSignalNode>")  # fmt: skip

    auto = "m_autospectrumInfo"
    nodes = node(61, 0, info(auto, 61, power * abs(h) ** 2),
                 info("m_crossSpecInfoList_el", 62, power * h.conj()))  # fmt: skip
    nodes += node(62, 1, info(auto, 62, power))
    pair = ('<PrimaryFreqRespSigNodeData>'
            '<integer name="m_iInputSigNodeUniqueInstanceID">1</integer>'
            '<integer name="m_iOutputSigNodeUniqueInstanceID">0</integer>'
            "</PrimaryFreqRespSigNodeData>")  # fmt: skip
    return f"<?xml version='1.0'?><ResponseTestCustom>{nodes}{pair}</ResponseTestCustom>"


@pytest.mark.parametrize(("write", "name"), [(tuning, "plant"), (response_test, "node_61")])
def test_responses_of_a_control(tmp_path, write, name):
    """Responses are read to the last bit, with coherence; cut numbers are refused."""
    path = tmp_path / "frf.xml"
    path.write_text(write(H))
    (response,) = read_responses(path)
    assert response.output == name
    np.testing.assert_allclose(response.values, H, rtol=1e-14)
    np.testing.assert_array_equal(response.frequency, F)
    assert np.isfinite(response.coherence).all()
    mode = read_measured(response, band=(80.0, 180.0)).modes
    assert mode.frequency == pytest.approx([126.4], rel=1e-3)
    path.write_text(write(H).replace("]]>", "7]]>", 1))
    with pytest.raises(BadLog, match="cut off"):
        read_responses(path)
    path.write_text(trace(X))
    assert read_responses(path) == ()
