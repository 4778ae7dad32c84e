"""Files of measuring systems and controls: Renishaw laser (.rtx), SINUMERIK trace and FRF (.xml).

None states units: a column map names the channels. The layouts were taken from public readers, the
convention of the cross spectrum from a public sample with its time series.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, iterparse, parse

import numpy as np

from lmshealth._private.arrays import ComplexArray, FloatArray
from lmshealth.io.buffers import Spool, as_samples
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import Content, Format, check_size
from lmshealth.io.formats.uff import Function
from lmshealth.io.formats.unit_channels import Described, choose
from lmshealth.io.refusal import Unusable, corrupt

_RTX, _RTX_DATA, _RTX_END = b"HEADER::", b"Data:\r\n", b"EOF::"
_RTX_HEADER = 1 << 16
_ROWS = 1 << 14  # per block
# A control writes its largest counts where a signal has no value.
_NO_VALUE = 9.2e18
# Digits of base 85 that the control writes, and its name of spectra of one signal.
_DIGITS = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ!#$`()*+-/:;=?@[]^_{|}~"
_AUTO = "m_autospectrumInfo"


def _load_rtx(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    """Read the lines of the header, and float64 values up to the end mark."""
    data = path.read_bytes()
    start = data.find(_RTX_DATA, 0, _RTX_HEADER)
    end = data.rfind(_RTX_END)
    if start < 0 or end < start:
        raise corrupt("needed a line 'Data:' and the mark 'EOF::' at the end")
    lines = data[:start].decode("utf-8", "replace").splitlines()
    header = dict(line.split(": ", 1) for line in lines if ": " in line)
    start += len(_RTX_DATA)
    if (end - start) % 8:
        raise corrupt(f"{end - start} bytes of data are no whole number of float64 values")
    rate = header.get("Actual sample rate", header.get("Sample rate", ""))
    chosen, content = choose([Described("data", "")], columns)
    values = as_samples(np.frombuffer(data[start:end], dtype="<f8"))
    metadata = {"sample_rate_hz": rate.strip()} if rate.strip() else {}
    return replace(content, columns=dict.fromkeys(chosen, values), metadata=metadata)


def _load_trace(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    """Read the signals of a trace: records with a time and a value of each signal, or some."""
    names: list[str] = []
    spools: dict[str, Spool] = {}
    records, n_rows = _records(path, names), 0
    content = Content({}, {}, ())
    while rows := list(islice(records, _ROWS)):
        table = np.array(rows)
        table[np.abs(table) > _NO_VALUE] = np.nan
        channels = [Described("time", "s"), *(Described(name, "") for name in names)]
        chosen, content = choose(channels, columns)
        for name, k in chosen.items():
            spools.setdefault(name, Spool()).append(table[:, k])
        n_rows += len(rows)
        check_size(8 * n_rows * len(spools), path.stat().st_size)
    if not n_rows:
        detail = "an XML file with no records (rec) of a trace; `lmshealth frf` reads responses"
        raise Unusable("columns", detail)
    return replace(content, columns={name: one.samples() for name, one in spools.items()})


def _records(path: Path, names: list[str]) -> Iterator[list[float]]:
    """Yield time and values of each record; the signals, which come before, add their names."""
    try:
        for _, element in iterparse(path):  # noqa: S314 (expat bounds entities)
            if element.tag == "dataSignal":
                names.append(_name(element))
            if element.tag == "rec":
                keys = "time", *(f"f{k}" for k in range(1, len(names) + 1))
                yield [float(element.attrib.get(key, "nan")) for key in keys]
            element.clear()
    except (ParseError, ValueError) as error:
        raise corrupt(f"the trace cannot be read: {error}") from error


def _name(element: Element) -> str:
    """Return the name of a signal: its description, else its path in the control."""
    described = element.attrib.get("description", "").removesuffix("(64 bit)").strip()
    return described or element.attrib.get("name", element.attrib.get("key", ""))


def response_functions(path: Path) -> list[Function]:
    """Read the responses of a servo tuning, or of a response test from its spectra (H1).

    A trace has none. `Unusable` (``corrupt``) for numbers that are cut off or do not fit together.
    """
    try:
        root = parse(path).getroot()  # noqa: S314
        named = {what: [e for e in root.iter("FrequencyResponseFunction") if e.get("name") == what]
                 for what in ("m_pPlant", "m_pMeasCoherence")}  # fmt: skip
        plants, coherences = named.values()
        functions = []
        for k, plant in enumerate(plants):
            name = "plant" if len(plants) == 1 else f"plant_{k + 1}"
            functions.append(Function(name, "setpoint", *_spectrum(plant), False, ""))
            if len(coherences) == len(plants):
                functions.append(Function(name, "setpoint", *_spectrum(coherences[k]), True, ""))
        nodes = {
            _field(node, "m_iUniqueInstanceId"): node for node in root.iter("PlatformSignalNode")
        }
        for pair in root.iter("PrimaryFreqRespSigNodeData"):
            used = [
                nodes[_field(pair, f"m_i{w}SigNodeUniqueInstanceID")] for w in ("Input", "Output")
            ]
            ids = [_field(node, "m_uNodeId") for node in used]
            crosses = (
                e for e in used[1].iter("SigNodeCrossSpectrumInfo") if e.get("name") != _AUTO
            )
            cross = next(e for e in crosses if _field(e, "m_uSignodeId") == ids[0])
            auto = [next(e for e in node.iter() if e.get("name") == _AUTO) for node in used]
            frequency, values = _spectrum(cross)
            powers = [_spectrum(e)[1].real for e in auto]
            coherence = np.abs(values) ** 2 / (powers[0] * powers[1])
            place = f"node_{ids[1]}", f"node_{ids[0]}", frequency
            functions.append(Function(*place, values.conj() / powers[0], False, ""))
            functions.append(Function(*place, coherence.astype(np.complex128), True, ""))
        return functions
    except (ParseError, ValueError, KeyError, StopIteration) as error:
        raise corrupt(f"the responses cannot be read: {error!r}") from error


def _field(element: Element, name: str) -> str:
    """Return the text of a child by its name, empty where there is none."""
    return next((child.text or "" for child in element if child.get("name") == name), "").strip()


def _spectrum(element: Element) -> tuple[FloatArray, ComplexArray]:
    """Read frequencies in Hz and complex values, ``(n_lines,)`` each."""
    arrays = {
        e.get("name"): _doubles(e.findtext("raw") or "") for e in element.iter("NumericArray")
    }
    frequency, values = arrays["m_FrequencyVector"], arrays["m_ValueVector"]
    if values.size != 2 * frequency.size:
        raise ValueError(f"{values.size} values at {frequency.size} frequencies")
    return frequency, values.view(np.complex128)


def _doubles(text: str) -> FloatArray:
    """Decode float64 values of two words each: five digits of base 85, or a point for zero."""
    text = "".join(text.split())
    words = re.findall(r"\.|[^.]{5}", text)
    if sum(map(len, words)) != len(text) or len(words) % 2:
        raise ValueError("numbers are cut off")
    numbers = [0 if word == "." else sum(85**k * _DIGITS.index(c) for k, c in enumerate(word[::-1]))
               for word in words]  # fmt: skip
    if max(numbers, default=0) >= 1 << 32:
        raise ValueError("a word is no number of 32 bits")
    return np.array(numbers, dtype=">u4").view(">f8").astype(np.float64)


def _is_trace(head: bytes) -> bool:
    return head.lstrip(b"\xef\xbb\xbf \r\n\t").startswith((b"<?xml", b"<trace"))


RTX = Format("Renishaw laser", (".rtx",), lambda head: head.startswith(_RTX), _load_rtx)
TRACE = Format("SINUMERIK trace", (".xml",), _is_trace, _load_trace)
