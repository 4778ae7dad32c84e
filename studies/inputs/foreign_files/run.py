"""Are files of other programs read right, or refused with what to set?

Method
    Each of 15 formats and frequency responses of SINUMERIK are written by two or three
    independent writers (`writers.py`: the layout by hand; and the library of the format, or
    another way to write the layout), and read; every sample and the rate are compared in SI
    units. Then files whose content has two readings or is no log: each must be
    refused with what is there and what to set. Then 2,000 files of text in a dialect that is
    drawn (`dialects.py`: delimiter, decimal mark, encoding, names and units, lines before them,
    blanks, groups of other rates, numbers, times, line ends). What no reader can decide is not
    drawn: numbers with the delimiter in them are quoted, and nothing between blanks is written
    as nan. A file is right where the rate and all samples of both signals are, lost samples
    included; refused; or wrong. Control: a reader that takes commas for marks between
    thousands, on files with decimal commas: the same comparison must find its values wrong.
Run time
    Four minutes on one processor.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.log import WARNINGS
from lmshealth.io.reading import read_log
from lmshealth.modal.deterministic.measured import read_responses
from studies.harness.claims import Claim, counted
from studies.harness.study import Row, Study
from studies.inputs.foreign_files import dialects, writers
from studies.inputs.foreign_files.writers import WRITERS, Held

N_EACH, N_FUZZ, N_CONTROL = 12, 2000, 400
BLOCK = 100
# Files that have two readings, or hold no log: content, and what the refusal must name.
_ROWS = "\n".join(f"{k / 1000:.3f};{k * 7 % 11}" for k in range(60))
REFUSED: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "one comma in all numbers": (
        ".csv", "a;b\n1,234;2,345\n3,456;5,678\n", ("1,234", 'decimal = ","', "[csv]")),
    "marks between thousands": (
        ".csv", "a;b\n1.234,5;2\n1,5;3\n", ("1.234,5", "without them")),
    "a text in a signal": (
        ".csv", "acc_x_g\n1\n2\nerror\n4\n", ("acc_x_g", "'error' in row 3", "number")),
    "a row too short": (
        ".csv", "time_s,acc_x_g\n0.1,1\n0.2,2\n0.3", ("row", "1 of 2 fields")),
    "a row too long": (
        ".csv", "time_s,acc_x_g\n0.1,1\n0.2,2,3\n0.3,4\n", ("row 2", "3 fields")),
    "no sample rate": (".csv", "acc_x_g\n1\n2\n4\n3\n", ("time_s", "sample_rate_hz")),
    "no unit": (".csv", f"time_s;acc_x\n{_ROWS}\n", ("acc_x", "unit", "_m_s2")),
    "no known name": (".csv", f"t;x\n{_ROWS}\n", ("there: t, x", "--columns")),
    "segments without times": (
        ".lvm", "LabVIEW Measurement\nX_Columns\tNo\n***End_of_Header***\n\nSamples\t2\n"
        "Delta_X\t1\n***End_of_Header***\nX_Value\ta\n\t1\n\t2\n\t3\n",
        ("line 11", "Samples", "X_Columns One")),
    "a scope without rates": (
        ".csv", "Name;a\nStarttime of export;1\n\nName;x\nUnit;g\n\n0;1\n", ("SampleTime[ms]",)),
    "a laser that is cut": (".rtx", "HEADER::\r\nData:\r\n1234567", ("EOF::",)),
    "a trace without records": (".xml", "<?xml version='1.0'?><a/>", ("rec", "frf")),
    "a table in a workbook": (".xlsx", "PK", ("suffix", ".csv")),
}  # fmt: skip


def main() -> None:
    """Run the study; ``--quick`` reads a part of the files and records nothing."""
    study = Study(__file__, __doc__)
    n_each, n_fuzz = (1, 100) if study.quick else (N_EACH, N_FUZZ)
    formats = {name: study.trials.once(judge_format, name, n_each) for name in (*WRITERS, *OTHERS)}
    refused = study.trials.once(judge_refusals)
    blocks = study.trials.collect(judge_dialects, [(k, BLOCK) for k in range(0, n_fuzz, BLOCK)])
    fuzz = {key: sum(block[key] for block in blocks) for key in ("right", "refused", "wrong")}
    reasons: Counter[str] = sum((Counter(block["reasons"]) for block in blocks), Counter())
    control = study.trials.once(judge_control, min(n_fuzz, N_CONTROL))
    study.conclude(
        {
            "formats": formats,
            "refused": refused,
            "dialects": fuzz | {"reasons": dict(reasons.most_common())},
            "wrong": [one for block in blocks for one in block["examples"]][:5],
            "control": control,
            "passed": {
                "every file of every writer is read right": all(
                    row["right"] == row["files"] for row in formats.values()
                ),
                "every refusal names what is there and what to set": all(refused.values()),
                "no dialect is read with other values": fuzz["wrong"] == 0,
                "nine of ten dialects with one reading are read": fuzz["right"]
                >= 0.9 * (fuzz["right"] + fuzz["refused"] - reasons["thousands"]),
                "the control is found out": control["wrong"] > 0,
            },
        }
    )


def judge_format(name: str, n: int) -> Row:
    """Write and read files of a format by each of its writers."""
    outcomes: Counter[str] = Counter()
    faults = []
    suffix, own = WRITERS.get(name, ("", ()))
    with tempfile.TemporaryDirectory() as folder:
        for k in range(n):
            if name in OTHERS:
                found = [one(Path(folder), k) for one in OTHERS[name]]
            else:
                found = [_read(Path(folder) / f"{k}_{i}{suffix}", w, k) for i, w in enumerate(own)]
            outcomes.update(found)
            faults += [one for one in found if one != "right"]
    return {"files": outcomes.total(), "right": outcomes["right"], "faults": faults[:3]}


def _read(path: Path, writer: writers.Writer, seed: int) -> str:
    table = writers.table(seed)
    columns, held = writer(path, table)
    rate = writers.RATES.get(writer.__name__, table.rate)
    return judge(path, columns, held, rate)


def judge(path: Path, columns: ColumnMap | None, held: Held, rate: float) -> str:
    """Read a file and compare it with what it holds: right, a reason, or what is wrong."""
    try:
        log = read_log(path, columns=columns)
    except BadLog as why:
        return f"refused: {why.reason}: {why.detail}"
    left_out = {one.channel for one in log.refused if one.reason not in WARNINGS}
    read = {channel.name: channel.values[:] for channel in log.channels}
    return compare(read, held, log.sample_rate, rate, left_out)


def compare(
    read: Mapping[str, np.ndarray], held: Held, got: float, rate: float, left_out: set[str]
) -> str:
    """Compare what was read with what a file holds, in SI units."""
    if abs(got / rate - 1) > 1e-6:
        return f"wrong: {got} Hz, written {rate} Hz"
    for name, values in held.items():
        if name in left_out:
            return f"refused: channel: {name}"
        if name not in read or read[name].shape != values.shape:
            return f"wrong: {name} is not there, or of another length"
        if not np.allclose(read[name], values, rtol=1e-9, atol=1e-15, equal_nan=True):
            return f"wrong: {name} has other values"
    return "right"


def _response(words: object, folder: Path, seed: int) -> str:
    """Write and read a frequency response."""
    rng = np.random.default_rng(seed)
    f = np.sort(rng.uniform(1, 4000, 200))
    h = rng.normal(size=200) + 1j * rng.normal(size=200)
    h[3] = 0
    writers.tuning(folder / "frf.xml", f, h, words)  # type: ignore[arg-type]
    (found,) = read_responses(folder / "frf.xml")
    same = np.array_equal(found.frequency, f) and np.array_equal(found.values, h)
    return "right" if same else "wrong: other values"


def by_hand(folder: Path, seed: int) -> str:
    """Write the digits one by one."""
    return _response(writers.words_by_hand, folder, seed)


def by_base64(folder: Path, seed: int) -> str:
    """Write the digits by Python's encoder."""
    return _response(writers.words_by_base64, folder, seed)


OTHERS = {"SINUMERIK responses": (by_hand, by_base64)}


def judge_refusals() -> dict[str, bool]:
    """Read files that must be refused; return whether each refusal names what it must."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, (suffix, content, needed) in REFUSED.items():
            path = Path(folder) / f"log{suffix}"
            path.write_text(content, newline="")
            try:
                read_log(path)
                found[name] = False
            except BadLog as why:
                found[name] = all(word in why.detail for word in needed)
    return found


def judge_dialects(first: int, n: int) -> Row:
    """Write and read text in dialects that are drawn."""
    outcomes: Counter[str] = Counter()
    reasons: Counter[str] = Counter()
    examples = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(first, first + n):
            path, dialect, table = Path(folder) / f"{seed}.txt", dialects.draw(seed), None
            table = writers.table(seed)
            columns, held = dialects.write(path, table, dialect)
            told = judge(path, columns, held, table.rate)
            kind = told.partition(":")[0]
            outcomes[kind] += 1
            if kind == "refused":
                thousands = dialect["digits"] == "thousands"
                reasons["thousands" if thousands else told.split(": ")[1]] += 1
            if kind == "wrong":
                examples.append(f"{seed}: {told}; {json.dumps(dialect)}")
    counts = {kind: outcomes[kind] for kind in ("right", "refused", "wrong")}
    return {**counts, "reasons": dict(reasons), "examples": examples}


def judge_control(n: int) -> Row:
    """Judge the control by the same comparison on text with decimal commas."""
    outcomes: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(n):
            plain = {"header": "contract", "before": "", "blanks": "none", "groups": "one",
                     "digits": "fixed", "time": "s", "last": "", "decimal": ","}  # fmt: skip
            dialect = dialects.draw(seed) | plain
            if dialect["delimiter"] == ",":
                continue
            path, table = Path(folder) / f"{seed}.txt", writers.table(seed)
            _, held = dialects.write(path, table, dialect)
            scaled = {k: 9.80665 * v for k, v in dialects.control(path, dialect).items()}
            told = compare(scaled, held, table.rate, table.rate, set())
            outcomes[told.partition(":")[0]] += 1
    return {"files": outcomes.total(), "wrong": outcomes["wrong"]}


def claims(answer: Row) -> Iterator[Claim]:
    """Claim files read right, refusals that help, dialects without silent errors."""
    formats, fuzz, control = answer["formats"], answer["dialects"], answer["control"]
    right, files = (sum(row[key] for row in formats.values()) for key in ("right", "files"))
    yield counted(
        f"files of {len(formats)} formats by independent writers that are read right", right, files,
        "all required", met=right == files,
    )  # fmt: skip
    refused = answer["refused"]
    yield Claim(
        "files with two readings, or none, refused with what is there and what to set",
        f"{sum(refused.values())} of {len(refused)}", "", "all required", all(refused.values()),
    )  # fmt: skip
    n = sum(fuzz[key] for key in ("right", "refused", "wrong"))
    beside = f"none required; the control that ignores decimal commas: {control['wrong']:,}"
    beside += f" of {control['files']:,}"
    yield counted("drawn dialects that are read with wrong values", fuzz["wrong"], n, beside,
                  met=fuzz["wrong"] == 0)  # fmt: skip
    one = n - fuzz["reasons"].get("thousands", 0)
    yield counted("drawn dialects with one reading that are read right, the others refused",
                  fuzz["right"], one, "90 % required", met=fuzz["right"] >= 0.9 * one)  # fmt: skip


if __name__ == "__main__":
    main()
