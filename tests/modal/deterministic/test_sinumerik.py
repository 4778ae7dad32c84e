"""Responses of SINUMERIK: servo tuning, and spectra of a response test."""

import numpy as np
import pytest

from lmshealth.errors import BadLog
from lmshealth.modal.deterministic.frequency_response import read_measured
from lmshealth.modal.deterministic.measured import read_responses
from tests.io.formats.test_instruments import X, trace

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
