"""Files of instruments that are no tables of text: Renishaw laser (.rtx), SINUMERIK trace (.xml).

Neither states units: a column map names the channels. Both were taken from public readers.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from xml.etree.ElementTree import ParseError, iterparse

import numpy as np

from lmshealth.io.buffers import Spool, as_samples
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import Content, Described, Format, begins, check_size, choose
from lmshealth.io.refusal import Unusable, corrupt

_RTX, _RTX_DATA, _RTX_END = b"HEADER::", b"Data:\r\n", b"EOF::"
_RTX_HEADER = 1 << 16
_ROWS = 1 << 14  # per block
# A control writes its largest counts where a signal has no value.
_NO_VALUE = 9.2e18


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
    names, spools, n_rows = list[str](), dict[str, Spool](), 0
    records, content = _records(path, names), Content({}, {}, ())
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
                # Its description, else its path in the control.
                own = element.attrib
                described = own.get("description", "").removesuffix("(64 bit)").strip()
                names.append(described or own.get("name", own.get("key", "")))
            if element.tag == "rec":
                keys = "time", *(f"f{k}" for k in range(1, len(names) + 1))
                yield [float(element.attrib.get(key, "nan")) for key in keys]
            element.clear()
    except (ParseError, ValueError) as error:
        raise corrupt(f"the trace cannot be read: {error}") from error


RTX = Format("Renishaw laser", (".rtx",), begins(_RTX), _load_rtx)
_XML = begins(b"<?xml", b"<trace", blanks=b"\xef\xbb\xbf \r\n\t")
TRACE = Format("SINUMERIK trace", (".xml",), _XML, _load_trace)
