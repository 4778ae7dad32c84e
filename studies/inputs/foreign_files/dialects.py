"""Files of delimited text in a dialect that is drawn, and the negative control that reads them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lmshealth.io.column_map import ColumnMap
from studies.inputs.foreign_files.writers import Held, Table

CHOICES: dict[str, tuple[Any, ...]] = {
    "delimiter": (",", ";", "\t", "|", ":", " "),
    "decimal": (".", ","),
    "encoding": ("utf-8", "utf-8-sig", "cp1252", "utf-16", "utf-16-le", "utf-16-be"),
    "header": ("contract", "units behind", "units below", "none", "remark", "quoted"),
    "before": ("", "metadata", "title", "key rows", "empty lines"),
    "blanks": ("none", "around", "at the end", "missing"),
    "groups": ("one", "slower", "text"),
    "digits": ("fixed", "shortest", "exponent", "thousands"),
    "time": ("s", "ms", "moment", "none"),
    "ending": ("\n", "\r\n"),
    "last": ("", "EOF"),
}


def draw(seed: int) -> dict[str, Any]:
    """Draw a dialect; thousands are rare, because all of them are refused."""
    rng = np.random.default_rng([seed, 1])
    chosen = {key: values[rng.integers(len(values))] for key, values in CHOICES.items()}
    if chosen["digits"] == "thousands" and rng.random() < 0.7:
        chosen["digits"] = "fixed"
    return chosen


def write(path: Path, t: Table, d: dict[str, Any]) -> tuple[ColumnMap | None, Held]:
    """Write a table in a dialect; return the map of a file without names, and what it holds."""
    columns = [] if d["time"] == "none" else [[_stamp(x, d) for x in t.time.tolist()]]
    columns += [[_number(v, d) for v in values.tolist()] for values in (t.a, t.b)]
    names, units, scale = _names(d)
    # Nothing between blanks is no field.
    empty = "nan" if d["delimiter"] == " " else ""
    if d["blanks"] == "missing":
        # A lost sample of the second signal.
        columns[-1][7] = empty
    if d["groups"] != "one":
        slow = [
            _number(k / 8, d) if d["groups"] == "slower" else "running" for k in range(t.a.size)
        ]
        if d["groups"] == "slower":
            slow[t.a.size // 2 :] = [empty] * (t.a.size - t.a.size // 2)
        columns.append(slow)
        names.append("Temp")
        units.append("°C" if d["groups"] == "slower" else "")
    pad = " " if d["blanks"] == "around" and d["delimiter"] != " " else ""
    end = d["delimiter"] if d["blanks"] == "at the end" else ""
    join = f"{pad}{d['delimiter']}{pad}".join
    lines = _before(d)
    if d["header"] != "none":
        shown = [f'"{name}"' for name in names] if d["header"] == "quoted" else names
        lines.append(("# " if d["header"] == "remark" else "") + join(shown) + end)
    if d["header"] == "units below":
        lines.append(join(units) + end)
    lines += [join(row) + end for row in zip(*columns, strict=True)]
    lines += [d["last"]] if d["last"] else []
    path.write_bytes((d["ending"].join(lines) + d["ending"]).encode(d["encoding"]))
    held = {"acc_a": scale * t.a, "acc_b": scale * t.b}
    if d["blanks"] == "missing":
        held["acc_b"] = held["acc_b"].copy()
        held["acc_b"][7] = np.nan
    rate = t.rate if d["time"] == "none" else None
    return (_map(d, rate) if rate or d["header"] == "none" else None), held


def _map(d: dict[str, Any], rate: float | None) -> ColumnMap:
    if d["header"] != "none":
        return ColumnMap(sample_rate_hz=rate)
    first = 0 if d["time"] == "none" else 1
    columns = {"acc_a_g": str(first), "acc_b_g": str(first + 1)}
    if first:
        columns["time_ms" if d["time"] == "ms" else "time_s"] = "0"
    return ColumnMap(columns=columns, sample_rate_hz=rate)


def _names(d: dict[str, Any]) -> tuple[list[str], list[str], float]:
    """Return names, units in a line below, and the SI value of one."""
    time = {"none": None, "moment": "time_s", "s": "time_s", "ms": "time_ms"}[d["time"]]
    unit = "ms" if d["time"] == "ms" else "s"
    if d["header"] in ("units behind", "units below"):
        names, units = ["a", "b"], ["m/s²", "m/s²"]
        names = ([] if time is None else ["Time"]) + names
        units = ([] if time is None else [unit]) + units
        if d["header"] == "units behind":
            names = [f"{name} [{unit}]" for name, unit in zip(names, units, strict=True)]
        return names, units, 1.0
    return [*([] if time is None else [time]), "acc_a_g", "acc_b_g"], [""] * 3, 9.80665


def _number(value: float, d: dict[str, Any]) -> str:
    # Writers quote a number with the delimiter in it.
    quote = '"' if d["delimiter"] == d["decimal"] or (d["digits"], d["delimiter"]) == (
        "thousands", ",") else ""  # fmt: skip
    text = {"fixed": f"{value:.6f}", "shortest": repr(value), "exponent": f"{value:.15E}",
            "thousands": f"{value:,.6f}"}[d["digits"]]  # fmt: skip
    text = text if d["decimal"] == "." else text.translate(str.maketrans(".,", ",."))
    return f"{quote}{text}{quote}"


def _stamp(seconds: float, d: dict[str, Any]) -> str:
    if d["time"] == "moment":
        return f"2026-01-05T08:00:{seconds:09.6f}Z"
    value = f"{1e3 * seconds:.3f}" if d["time"] == "ms" else f"{seconds:.6f}"
    return f'"{value}"'.replace(".", ",") if d["delimiter"] == d["decimal"] else value.replace(
        ".", d["decimal"])  # fmt: skip


def _before(d: dict[str, Any]) -> list[str]:
    return {
        "": [],
        "metadata": ["# stage: A-1", "# temperature_c: 21.4"],
        "title": ["Export of axis 7"],
        "key rows": [f"Device{d['delimiter']}X-1", f"Channels{d['delimiter']}2", ""],
        "empty lines": ["", ""],
    }[d["before"]].copy()


def control(path: Path, d: dict[str, Any]) -> Held:
    """Read as a reader does that takes every comma for a mark between thousands."""
    frame = pd.read_csv(path, sep=d["delimiter"], thousands=",", encoding=d["encoding"],
                        header=None, skiprows=1)  # fmt: skip
    return {"acc_a": frame[1].to_numpy(dtype=float), "acc_b": frame[2].to_numpy(dtype=float)}
