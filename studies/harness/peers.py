"""Compare with other programs on the same records, series and lives: tables from the records.

A figure is better where it differs by more than its Monte-Carlo error, as ``studies/PEERS.md`` has
it; processor times by more than a factor of 1.15, as single turns of `cost/ratios` differ.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import starmap
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest, fisher_exact

from lmshealth.calibration.ranks import clopper_pearson
from studies.harness.claims import number
from studies.harness.metrics import mean
from studies.harness.study import STUDIES

# Peer, world, our figures and theirs, intervals that hold, time over ours, who is better in what.
Row = tuple[str, str, str, str, str, float | None, dict[str, str]]
LEVEL, SURE, SAME_TIME, SAME_SHARE = 0.05, 2.0, 1.15, 0.02
OURS, PEER, SAME = "lmshealth", "**peer**", "equal"
CONTROL = "peaks of single channels"
HEAD = ("peer", "world", OURS, "the peer", "intervals that hold", "time over ours", "better")
TABLES = {
    "Modes: those found, all other estimates, and errors of f and ζ": (
        "pyOMA2", "pyoma-toolbox", "koma"),
    "Tracking: root mean square error of ln f at the last log, over that of one log": (
        "filterpy", "simdkalman", "statsmodels"),
    "Remaining life: score (CRPS, km), and root mean square error of ln preload now": (
        "progpy", "plain particle filter", "straight line"),
}  # fmt: skip


def lines(studies: Path = STUDIES) -> list[str]:
    """Return the tables of all peers, as far as the studies in a folder are recorded."""

    def read(name: str) -> Any:
        path = studies / f"{name}.json"
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}

    drawn, known = read("modes/without_description/result"), read("modes/real/blind")
    modes = [*drawn_modes(drawn), *known_modes(known)]
    found, subjects = [], (modes, tracks(read("track/peers")), lives(read("life/peers")))
    for (title, names), rows in zip(TABLES.items(), subjects, strict=True):
        table: list[tuple[str, ...]] = []
        for *cells, ratio, better in rows:
            if ratio:
                better["time"] = _who(float(np.log(ratio)), float(np.log(SAME_TIME)))
            who = "; ".join(f"{what}: {one}" for what, one in better.items())
            table.append((*cells, number(ratio) if ratio else "", who))
        there, n = " ".join(row[0] for row in table), sum(PEER in row[-1] for row in table)
        count = f"A peer is better by a figure in {n} of {len(table)} rows."
        table += [(name, "not recorded", *[""] * 5) for name in names if name not in there]
        found += [f"## {title}", "", count, ""]
        found += [f"| {' | '.join(row)} |" for row in (HEAD, ["---"] * len(HEAD), *table)] + [""]
    return found[:-1]


def drawn_modes(record: Any) -> Iterator[Row]:
    """Compare modes on drawn records that a peer searched, which are the first of ours."""
    for family, one in record.get("families", {}).items():
        for name, row in one["others"].items():
            if name == CONTROL:
                continue
            short = [own for own in one["imperfect"] if own["seed"] < row["records"]]
            missed, false = (sum(len(r[k]) for r in short) for k in ("missed_hz", "false_hz"))
            n, world = row["there"], f"{family}, {row['records']} records"
            *cells, better = _counted(n, (n - missed, row["found"]), (false, row["false"]))
            compared = {q: row["errors"][key] for q, key in (("f", "f"), ("ζ", "zeta"))}
            for whose, k in (("ours", 0), ("theirs", 1)):
                errors = [f"{number(100 * e[whose])} %" for e in compared.values() if e["n"]]
                cells[k] += f"; {', '.join(errors)}" * bool(errors)
            better |= {q: _who(e["worse_by"][0], SURE * e["worse_by"][1])
                       for q, e in compared.items() if e["n"] > 1}  # fmt: skip
            held = [(c["hits"], c["n"]) for c in (one["coverage"]["f"], row["coverage"].get("f"))
                    if c]  # fmt: skip
            if len(held) == 2:
                better["intervals"] = _nearer(held, 0.95)
            text = "; ".join([*map("{0[0]} of {0[1]}".format, held), "states none"][:2])
            yield name, world, *cells, text, row["time_over_ours"], better


def known_modes(record: Any) -> Iterator[Row]:
    """Compare modes on records of others; measured structures may have more than are known."""
    worlds = defaultdict(list)
    for one in record.get("sets", ()):
        made = "simulated" if one["complete"] else "measured"
        worlds[f"{one['set'].split(',')[0]}, {made} by others"].append(one)
    for world, sets in worlds.items():
        n, many = sum(one["known"] for one in sets), f", {len(sets)} records" * (len(sets) > 1)
        for name in sets[0].get("others", ()):
            found, other = (
                [sum(one[key] for one in sets), sum(one["others"][name][key] for one in sets)]
                for key in ("found", "else")
            )
            *cells, better = _counted(n, found, other)
            yield name, world + many, *cells, "not judged", None, better


def _counted(n: int, found: Sequence[int], other: Sequence[int]) -> tuple[str, str, dict[str, str]]:
    """Return, of ours and theirs, modes found of n and other estimates, and who is better."""
    sure = fisher_exact(np.array([[one, n - one] for one in found])).pvalue < LEVEL
    better = {"found": _who((found[0] - found[1]) * sure)}
    sure = sum(other) > 0 and binomtest(other[0], sum(other)).pvalue < LEVEL
    better["others"] = _who((other[1] - other[0]) * sure)
    ours, theirs = (f"{one} of {n}, {more}" for one, more in zip(found, other, strict=True))
    return ours, theirs, better


def tracks(record: Any) -> Iterator[Row]:
    """Compare filters on the same lives; the last estimate alone is no program."""
    for kind, one in record.get("kinds", {}).items():
        ours = one["programs"][OURS]
        for name, row in one["programs"].items():
            if name.startswith((OURS, "the last estimate")):
                continue
            gain, error = row["worse_by"]
            held = [(x["held"]["hits"], x["held"]["n"]) for x in (ours, row)]
            better = {"error": _who(gain, SURE * error), "intervals": _nearer(held, 0.9)}
            texts = (
                number(ours["rms"]),
                number(row["rms"]),
                "; ".join("{} of {}".format(*counts) for counts in held),
            )
            yield (
                name,
                f"{kind}, {one['lives']} lives",
                *texts,
                row["cpu_s"] / ours["cpu_s"],
                better,
            )


def lives(record: Any) -> Iterator[Row]:
    """Compare predictions on the same lives; that without any log is among them."""
    programs = dict(record.get("programs", {}))
    ours = programs.pop(OURS, {})
    for name, kind in ((name, kind) for name, kinds in programs.items() for kind in kinds):
        both, better = (ours[kind], programs[name][kind]), dict[str, str]()
        cells, held = ([list[str](), list[str]()] for _ in range(2))
        for what, part, key in (("life", "left", "crps"), ("preload", "health", "square")):
            rows = [one[part] for one in both]
            if not rows[1]["held"][1]:
                continue
            pairs = zip(rows[0][key], rows[1][key], strict=True)
            gain, error = mean([b - a for a, b in pairs if None not in (a, b)])
            intervals = _nearer([row["held"] for row in rows], 0.9)
            better |= {what: _who(gain, SURE * error), f"{what}, intervals": intervals}
            for row, cell, counts in zip(rows, cells, held, strict=True):
                value, error = mean(row[key])
                root = number(value**0.5)
                cell.append(f"{value:,.0f} ± {error:,.0f}" if what == "life" else root)
                counts.append("{} of {}".format(*row["held"]))
        texts = [*map(", ".join, cells), "; ".join(map(", ".join, held))]
        ratio = both[1]["cpu_s"] / both[0]["cpu_s"] or None
        yield name, f"{kind}, {both[0]['n']} lives", *texts, ratio, better


def _nearer(held: Sequence[Sequence[int]], stated: float) -> str:
    """Return whose share that holds, of ours and theirs of so many, is nearer to what is stated."""
    ends = starmap(clopper_pearson, held)
    ours, theirs = (max(low - stated, stated - high, 0.0) for low, high in ends)
    return _who(theirs - ours, SAME_SHARE)


def _who(gain: float, error: float = 0.0) -> str:
    """Return who is better, by how much worse the peer is, and the error of this."""
    return SAME if abs(gain) <= error else OURS if gain > 0 else PEER
