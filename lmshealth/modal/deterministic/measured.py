"""Frequency responses that others have measured: UFF58 of type 4, SINUMERIK, tables of lines.

The README of the folder lists the columns of a table.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, parse

import numpy as np

from lmshealth._private.arrays import ComplexArray, FloatArray, ReadOnly
from lmshealth.errors import BadLog
from lmshealth.io import constants as limits
from lmshealth.io.column_map import RESPONSE_COLUMN, ColumnMap, parse_column, role_of
from lmshealth.io.formats.content import Content, unpacked
from lmshealth.io.formats.csv import CSV
from lmshealth.io.formats.instruments import TRACE
from lmshealth.io.formats.registry import confirm, format_name, load
from lmshealth.io.formats.uff import UFF, Function, load_functions
from lmshealth.io.log import SI_UNITS, Metadata, parse_metadata
from lmshealth.io.reading import content_digest
from lmshealth.io.refusal import Unusable, corrupt, listed, shown, visible
from lmshealth.modal import constants
from lmshealth.modal.deterministic.responses import Frf, Ordinates, average_noise

_FORMATS = (CSV.name, UFF.name, TRACE.name)
_HERTZ = {"hz": 1.0, "khz": 1e3, "rad_s": 1 / (2 * np.pi)}
_PER = {"n": 1.0, "kn": 1e3, "a": 1.0, "ma": 1e-3, "v": 1.0, "mv": 1e-3}
_PARTS = "needed real and imag, or magnitude (or db) and phase_deg (or phase_rad)"
_ROUNDING = 1e-9
# Digits of base 85 that the control writes, and its name of spectra of one signal.
_DIGITS = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ!#$`()*+-/:;=?@[]^_{|}~"
_AUTO = "m_autospectrumInfo"


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredResponse(ReadOnly):
    """A frequency response from a file, arrays ``(n_lines,)``."""

    name: str  # of the file, with that of the output where the file holds several
    digest: str  # SHA-256 of the file
    metadata: Metadata
    input: str
    output: str
    frequency: FloatArray  # in Hz, ascending
    values: ComplexArray  # output per input
    coherence: FloatArray  # NaN where the file has none
    unit: str  # of the values; empty where it is unknown


class _ResponseColumns(ColumnMap, frozen=True, dict=True):
    """Column map of a table of responses."""

    def target(self, source: str) -> str | None:
        """Return the name of a column of a response; None for any other."""
        name = self._targets.get(source, source)
        return name if RESPONSE_COLUMN.fullmatch(name) else None


def read_responses(
    path: Path,
    *,
    columns: ColumnMap | None = None,
    overrides: Mapping[str, str] | None = None,
    max_memory: float = limits.MAX_MEMORY,
    latest: datetime | None = None,
) -> tuple[MeasuredResponse, ...]:
    """Read the frequency responses of a file; none from a log, which holds time records.

    `BadLog` if a response lacks a part, or its lines are not finite and ascending.
    """
    given, form = columns or ColumnMap(), format_name(path).removeprefix("gzipped ")
    if form not in _FORMATS:
        return ()
    label, digest = shown(path), content_digest(path)
    try:
        stated: dict[str, str] = {}
        if form != CSV.name:
            confirm(path)
            with unpacked(path) as file:
                functions = (load_functions(file, max_memory) if form == UFF.name
                             else _of_sinumerik(file))  # fmt: skip
        else:
            own = _ResponseColumns(columns=given.columns, csv=given.csv, layouts=given.layouts)
            content = load(path, own, max_memory)
            functions, stated = _tabulated(content, own), content.metadata
        metadata, _ = parse_metadata(stated | given.constants() | dict(overrides or {}), latest)
        coherences = {f[:2]: f.values.real for f in functions if f.coherence}
        responses = []
        for f in (f for f in functions if not f.coherence):
            coherence = coherences.get(f[:2], np.full(f.frequency.size, np.nan))
            place = label, digest, metadata, f.input or "input", f.output
            one = MeasuredResponse(*place, f.frequency, f.values, coherence, f.unit)
            responses.append(_checked(one))
        if len(responses) > 1:
            responses = [replace(r, name=f"{label}:{r.output}") for r in responses]
        return tuple(responses)
    except Unusable as error:
        raise BadLog(label, error.reason, error.detail) from error
    except Exception as error:
        # As for logs, whatever a library raises on a damaged file ends only this file.
        detail = f"cannot be read ({type(error).__name__}: {error}); copy the file again"
        raise BadLog(label, "corrupt", visible(detail)) from error


def _of_sinumerik(path: Path) -> list[Function]:
    """Read the responses of a SINUMERIK servo tuning, or of a response test from its spectra (H1).

    The convention of the cross spectrum is that of a public sample with its time series. A trace
    has none. `Unusable` (``corrupt``) for numbers that are cut off or do not fit together.
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


def _tabulated(content: Content, columns: _ResponseColumns) -> list[Function]:
    """Collect the responses of a table; none where it has no column of frequencies."""
    frequency: FloatArray | None = None
    parts: dict[str, dict[str, FloatArray]] = {}
    for source, samples in content.columns.items():
        values = np.asarray(samples[:])
        if (match := RESPONSE_COLUMN.fullmatch(str(columns.target(source)))) is None:
            continue
        if match["axis"]:
            frequency = values * _HERTZ[match["axis"]]
        else:
            parts.setdefault(match["name"] or "", {})[match["part"]] = values
    if frequency is None:
        return []
    functions = []
    for column, part in parts.items():
        name, factor, unit = _unit(column)
        if {"real", "imag"} <= set(part):
            values = part["real"] + 1j * part["imag"]
        else:
            gain = 10 ** (part["db"] / 20) if "db" in part else part.get("magnitude")
            phase = np.radians(part["phase_deg"]) if "phase_deg" in part else part.get("phase_rad")
            if gain is None or phase is None:
                raise Unusable("columns", f"response {name!r} has {listed(part)}; {_PARTS}")
            values = gain * np.exp(1j * phase)
        whole = np.asarray(factor * values, dtype=np.complex128)
        functions.append(Function(name, "", frequency, whole, False, unit))
        if "coherence" in part:
            whole = part["coherence"].astype(np.complex128)
            functions.append(Function(name, "", frequency, whole, True, ""))
    if not functions:
        raise Unusable("columns", f"no response; {_PARTS}; there: {listed(content.present)}")
    return functions


def _unit(column: str) -> tuple[str, float, str]:
    """Split a name into that of the output, the SI value of one, and the unit of the values."""
    of, per, by = column.partition("_per_")
    if per and by not in _PER:
        raise Unusable("unit", f"{column!r} is per {by!r}; needed one of {listed(_PER)}")
    name, factor, unit = of or "response", 1.0, ""
    try:
        signal = parse_column(of)
        name, factor, unit = signal.name, signal.factor, SI_UNITS.get(signal.role, "")
    except Unusable:
        if per and role_of(of) is not None:
            raise
    return name, factor / _PER.get(by, 1.0), f"({unit})/{by[-1].upper()}" if per else unit


def _checked(response: MeasuredResponse) -> MeasuredResponse:
    """Require ascending frequencies; leave out the static value and lines that are not finite."""
    f = response.frequency
    if response.coherence.shape != f.shape:
        found = f"{response.output}: {f.size} lines, but {response.coherence.size} of coherence"
        raise Unusable("columns", f"{found}; needed the same")
    use = np.isfinite(f) & np.isfinite(response.values) & (f > 0)
    if not (np.diff(f[use]) > 0).all():
        at = int(np.argmin(np.diff(f[use]) > 0))
        found = f"frequencies do not ascend: {f[use][at + 1]:g} Hz follows {f[use][at]:g} Hz"
        raise Unusable("columns", f"{found}; needed one row per line, in ascending order")
    parts = {key: getattr(response, key)[use] for key in ("frequency", "values", "coherence")}
    return replace(response, **parts)


def from_measured(
    response: MeasuredResponse, band: tuple[float, float], averages: int | None
) -> tuple[Frf, Ordinates]:
    """Return the lines of a band; their noise follows from coherence and number of averages.

    Without these it is unknown (zero degrees of freedom), and is that of the residual of the fit
    [Pintelon2012]. `BadLog` if the band holds too few lines, or too many.
    """
    use = (response.frequency >= band[0]) & (response.frequency <= band[1])
    f, h, coherence = response.frequency[use], response.values[use], response.coherence[use]
    averages = None if averages == 1 else averages  # of one the coherence is 1, whatever the noise
    known = averages is not None and bool(np.isfinite(coherence).all())
    fewest = constants.FRF_LINES if known else constants.FRF_LINES_OF_UNKNOWN_NOISE
    if not fewest <= f.size <= constants.FRF_MOST_LINES:
        reason = "band-too-narrow" if f.size < fewest else "band-too-wide"
        needed = f"needed {fewest} to {constants.FRF_MOST_LINES}"
        if not known:
            needed += f" ({constants.FRF_LINES} suffice with coherence and --averages)"
        where = f"in the band of {band[0]:g} to {band[1]:g} Hz"
        found = f"{response.output} has {f.size} lines {where}, {use.size} in all; {needed}"
        raise BadLog(response.name, reason, f"{found}: choose another band, or measure more lines")
    noise, freedom = np.full(f.size, constants.UNKNOWN_NOISE * np.mean(np.abs(h) ** 2)), 0.0
    if known and averages is not None:
        at = np.clip(coherence, _ROUNDING, 1 - _ROUNDING)
        noise = np.abs(h) ** 2 * (1 - at) / (at * (averages - 1))
        noise, freedom = average_noise(noise, h, averages - 1)
    n = float("nan") if averages is None else float(averages)
    names, std = (response.input, response.output), np.sqrt(noise)
    frf = Frf(*names, f, h, std, h, h, h, coherence, n, method="measured")
    return frf, Ordinates(f, np.ones(f.size, dtype=complex), h, noise, freedom, periodic=True)
