"""What of the paper's tables do the simulated stages reproduce?

Method
    Tables 1-7 of doi 10.3390/math9090951 and its velocity experiments on the simulated X and Y, as
    rigid bodies on springs in the loop of the equations (rigid), and with elastic parts in the loop
    as measured (full). Per velocity and seed one window of 4 s about the middle of a full stroke of
    280 mm; Δe and the accelerations are read as the paper reads them. Levels of friction,
    roughness, noise and mains were set on these tables: agreement shows that one small set of
    levels serves all of them. Rows at multiples of 50 Hz hold mains whose amplitude was set on that
    very row; the count is given without them too. Table 1 is from the loops with the flexible modes
    inside, Table 2 from sine sweeps while moving, Table 5 from the closed-loop modes. Cells are
    means over seeds. Control: the same tables from constant velocity alone, without acceleration
    and braking. ``printed/`` holds the paper's numbers, errata included; tables.md has every cell.
    Every row with a cell outside its tolerance has a reason in ``reasons.toml``, and changes of the
    simulation that test it: the cell must then be inside. What no change brings inside is counted.
Run time
    About a quarter of an hour on one processor.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from models.recordings.strokes import WINDOW_S
from studies.harness.claims import Claim, percents
from studies.harness.study import Row, Study
from studies.paper.tables import tables
from studies.paper.tables.changes import changed

REASONS = tomllib.loads(Path(__file__).with_name("reasons.toml").read_text(encoding="utf-8"))
# Factor within which a cell is asked to be; means are near zero, see `outside`.
TOLERANCES = {"Table 1": 1.1, "Table 2": 1.03, "Table 3": 1.5, "Table 4": 1.5, "Table 5": 1.015,
              "Table 6": 3.0, "Table 7": 3.0}  # fmt: skip
# In Table 3 the paper repeats Y's column at 100 mm/s for X.
ERRATUM = {("x std_um", 4), ("x mean_um", 4)}
# Claims of counts: what they count, and the rows, by table, name and mode.
COUNTS = {
    "table_3_std_within_1.5": ("standard deviations of Δe within a factor 1.5", "Table 3 . std"),
    "table_3_extremes_within_1.5": ("extremes of Δe within a factor 1.5", "Table 3 . m(in|ax)"),
    "table_4_max_magnitude_within_1.5": ("largest harmonics within a factor 1.5", "Table 4 . max"),
    "table_4_bandwidths_within_1.5": ("bandwidths of Δe within a factor 1.5", "Table 4 . band"),
    "table_6_7_mode_rows_within_3": ("accelerations at the modes within a factor 3",
                                     "Table [67] .* Hz (?!None)"),
    "table_6_7_mode_rows_without_mains_within_3": ("the same where no mains line was fitted",
                                                   r"Table [67] . (?!\d*[05]0 ).* Hz (?!None)"),
    "table_6_7_other_rows_within_3": ("other accelerations within a factor 3",
                                      "Table [67] .* Hz None"),
}  # fmt: skip
TEST_SEEDS, BALLS = 4, "no noise of the balls in the accelerometers"  # of the tests of reasons
# A frequency of Figure 18 depends strongly on velocity if it grows by this and gets this high.
GROWTH, HIGH_MM_S2 = 10.0, 15.0


def main() -> None:
    """Run the study; ``--quick`` takes one seed, short controls, no Table 2, records nothing."""
    study = Study(__file__, __doc__, seeds=20)
    seeds = 1 if study.quick else study.options.seeds
    answer: Row = {"seeds": seeds}
    rows, tests = [], list[Row]()
    for plant in tables.PLANTS:
        answer[plant], own = examine(plant, seeds, quick=study.quick)
        if plant == "full" and not study.quick:
            tests = tested(own)
            with changed(tables.stage_of("y", plant), REASONS["changes"][BALLS]):
                without = growing(tables.velocity_rows("y", plant, TEST_SEEDS))
            answer[plant]["growing_without_balls"] = without["simulated_by_the_same_rule"]
        rows += [record(plant, row, tests) for row in own]
    study.conclude(
        answer, details={"rows": rows, "tests": tests, "growing_why": REASONS["growing"]}
    )
    if not study.quick:
        page = Path(__file__).with_name("tables.md")
        page.write_text(markdown(rows, tests, seeds), encoding="utf-8")


def examine(plant: str, seeds: int, *, quick: bool) -> tuple[Row, list[tables.TableRow]]:
    """Return the answer about a plant, and all rows of its tables."""
    rows = tables.loop_rows(plant) + tables.modal_rows(plant)
    rows += [] if quick else tables.resonance_rows(plant)
    windows = ((seeds, None), (min(seeds, 2), 1.0 if quick else WINDOW_S))
    moved, control = (
        [row for axis in tables.FILES for row in tables.velocity_rows(axis, plant, *window)]
        for window in windows
    )
    answer = {
        "summary": summarise(moved),
        "control_constant_velocity_only": summarise(control),
        "growing_with_velocity": growing(moved),
    }
    return answer, sorted([*rows, *moved], key=lambda row: row.table)


def ratios(row: tables.TableRow) -> np.ndarray:
    """Return simulated over printed per cell; NaN where one is missing or zero."""
    cells, found = np.abs(row.printed), np.abs(row.simulated)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((cells > 0) & (found > 0), found / cells, np.nan)


def within(row: tables.TableRow, factor: float) -> list[bool | None]:
    """Return whether simulated and printed agree, cell by cell; None of errata."""
    inside = [bool(1 / factor <= ratio <= factor) for ratio in ratios(row)]
    return [None if (row.name, cell) in ERRATUM else hit for cell, hit in enumerate(inside)]


def outside(row: tables.TableRow) -> list[int]:
    """Return the cells that are not within the tolerance; of means, two standard deviations."""
    hits = within(row, TOLERANCES[row.table])
    if row.name.endswith("mean_um"):
        near = np.abs(np.subtract(row.printed, row.simulated)) <= 2 * np.array(row.scatter)
        hits = [None if hit is None else ok for hit, ok in zip(hits, near.tolist(), strict=True)]
    return [cell for cell, hit in enumerate(hits) if hit is False]


def tested(rows: list[tables.TableRow]) -> list[Row]:
    """Return which cells outside each change brings inside: of the rows that name it, of others."""
    off = {row.name: outside(row) for row in rows}
    tests: list[Row] = []
    for axis in tables.FILES:
        mine = {name: one.get("changes", ()) for name, one in REASONS["rows"].items()
                if name[0] == axis}  # fmt: skip
        for change, numbers in REASONS["changes"].items():
            columns = sorted({i for name, by in mine.items() if change in by for i in off[name]})
            if not columns:
                continue
            with changed(tables.stage_of(axis, "full"), numbers):
                found = tables.velocity_rows(axis, "full", TEST_SEEDS, columns=columns)
            for row in found:
                cells = [i for i in off[row.name] if i in columns]
                tests.append({
                    "row": row.name, "change": change, "named": change in mine.get(row.name, ()),
                    "outside": cells, "inside": sorted(set(cells) - set(outside(row))),
                })  # fmt: skip
    return [test for test in tests if test["outside"]]


def verdict(row: tables.TableRow) -> str:
    """Count the cells inside the tolerance; Table 2: name a mode that no sweep shows."""
    if row.table == "Table 2" and row.mode:
        return "mode there, hardly along the feed"
    asked = len(row.printed) - within(row, 1.0).count(None)
    mean = row.name.endswith("mean_um")
    limit = "two standard deviations" if mean else f"{TOLERANCES[row.table]:g}"
    return f"{asked - len(outside(row))} of {asked} within {limit}"


def record(plant: str, row: tables.TableRow, tests: list[Row]) -> Row:
    """Return a row as JSON, with the cells outside and those that no named change brings inside."""
    cells = {key: getattr(row, key) for key in ("printed", "simulated", "scatter")}
    off, reasons = outside(row), REASONS["rows"] if plant == "full" else {}
    named = [test["inside"] for test in tests if test["row"] == row.name and test["named"]]
    return {
        "plant": plant,
        "table": row.table,
        "row": row.name,
        "mode": row.mode,
        **{
            key: [float(f"{v:.4g}") if np.isfinite(v) else None for v in values]
            for key, values in (cells | {"ratio": ratios(row)}).items()
        },
        "verdict": verdict(row),
        "outside": off,
        "why": reasons.get(row.name, {"why": "not explained" if off else ""})["why"],
        "left": sorted(set(off).difference(*named)),
    }


def counted(key: str, table: str, name: str, mode: str | None) -> bool:
    """Return whether a count has a row."""
    return re.match(COUNTS[key][1], f"{table} {name} {mode}") is not None


def summarise(rows: list[tables.TableRow]) -> dict[str, str]:
    """Count the cells of the tables over velocity that agree."""
    counts = {}
    for key in COUNTS:
        own = [row for row in rows if counted(key, row.table, row.name, row.mode)]
        hits = [hit for row in own for hit in within(row, TOLERANCES[row.table])]
        counts[key] = f"{hits.count(True)} of {len(hits) - hits.count(None)}"
    x, y = (row.simulated for row in rows if row.name.endswith(" std_um"))
    return counts | {"std_of_x_below_y": f"{sum(np.less(x, y))} of 7"}


def grows(cells: tuple[float, ...]) -> bool:
    """Return whether magnitudes (mm/s²) over velocity depend strongly on it."""
    return cells[-1] >= HIGH_MM_S2 and cells[-1] >= GROWTH * float(np.median(cells[:4]))


def growing(rows: list[tables.TableRow]) -> dict[str, list[str]]:
    """Return the rows that depend strongly on velocity: named, printed, simulated."""
    own = [row for row in rows if row.table in ("Table 6", "Table 7")]
    return {
        "named_by_the_paper": tables.PRINTED_GROWING,
        "printed_by_one_rule": [row.name for row in own if grows(row.printed)],
        "simulated_by_the_same_rule": [row.name for row in own if grows(row.simulated)],
    }


def markdown(rows: list[Row], tests: list[Row], seeds: int) -> str:
    """Return all rows as one page of tables: rigid, full / printed."""
    lines = ["# Simulated beside printed", ""]
    lines += [
        f"Means over {seeds} seeds; each cell: rigid stage, full stage / printed. Velocities of "
        "Tables 3, 4, 6 and 7: 1, 5, 10, 20, 100, 200, 400 mm/s. Made by `run.py`. Tests: changes "
        "of the full stage (`reasons.toml`), and how many of the cells outside each brings inside.",
        "",
    ]
    rigid = {(row["table"], row["row"]): row for row in rows if row["plant"] == "rigid"}
    full = {(row["table"], row["row"]): row for row in rows if row["plant"] == "full"}
    for table in dict.fromkeys(table for table, _ in full):
        own = [key for key in full if key[0] == table]
        width = max(len(full[key]["printed"]) for key in own)
        head = {7: list(tables.printed(3)["velocity_mm_s"]), 2: ["X", "Y"], 1: ["Hz"]}[width]
        names = ["row", *map(str, head), "rigid", "full", "why not", "tests"]
        lines += [f"## {table}", "", "| " + " | ".join(names) + " |"]
        lines.append("| " + " | ".join(["---"] * len(names)) + " |")
        for key in own:
            one, other = rigid[key], full[key]
            columns = zip(one["simulated"], other["simulated"], other["printed"], strict=True)
            cells = [", ".join("–" if v is None else f"{v:.3g}" for v in both) + f" / {p:.4g}"
                     for *both, p in columns]  # fmt: skip
            name = key[1] + (f" ({other['mode']})" if other["mode"] else "")
            inside = [f"{test['change']}: {len(test['inside'])} of {len(other['outside'])}"
                      for test in tests if test["row"] == key[1] and test["named"]]  # fmt: skip
            judged = [one["verdict"], other["verdict"], other["why"], "; ".join(inside)]
            lines.append("| " + " | ".join([name, *cells, *judged]) + " |")
        lines.append("")
    return "\n".join(lines)


def unexplained(rows: Iterable[Row]) -> str:
    """Count rows with a cell outside, and name those that no reason or no test explains."""
    off = [row for row in rows if row["outside"]]
    names = [row["row"] for row in off if row["why"].startswith("not explained")
             or (row["left"] and row["table"] != "Table 2")]  # fmt: skip
    return f"{len(off)} rows with cells outside; not explained: {', '.join(names) or 'none'}"


def claims(answer: Row) -> Iterator[Claim]:
    """Claim which cells of the paper's tables the full stages reproduce, beside the rigid."""

    def of(plant: str, table: str) -> list[Row]:
        return [row for row in answer["rows"] if (row["plant"], row["table"]) == (plant, table)]

    rigid, modal = (
        max(abs(row["ratio"][0] - 1) for row in of(plant, "Table 5")) for plant in tables.PLANTS
    )
    yield Claim("Table 5, all cells, off at most", percents([modal]), "",
                f"rigid {percents([rigid])}; 1.5 % asked", modal <= 0.015)  # fmt: skip
    full = [row for row in answer["rows"] if row["plant"] == "full"]
    for key, (what, match) in COUNTS.items():
        summary = [answer[plant]["summary"][key] for plant in tables.PLANTS]
        control = answer["full"]["control_constant_velocity_only"][key]
        own = unexplained(r for r in full if counted(key, r["table"], r["row"], r["mode"]))
        beside = f"rigid: {summary[0]}; constant velocity alone: {control}; {own}"
        seeds = f"means over {answer['seeds']} seeds"
        where = "Tables 6, 7" if "67" in match else match[:7]
        yield Claim(f"{what} ({where})", summary[1], seeds, beside, own.endswith("none"))
    moved = [row for row in full if row["table"][-1] in "3467"]
    off, left = (sum(len(row[key]) for row in moved) for key in ("outside", "left"))
    other = [(len(test["inside"]), len(test["outside"])) for test in answer["tests"]
             if not test["named"]]  # fmt: skip
    yield Claim(
        "cells outside (Tables 3, 4, 6, 7) that the change named as their reason brings inside",
        f"{off - left} of {off}",
        f"{TEST_SEEDS} seeds",
        f"changes named for other rows: {sum(n for n, _ in other)} of {sum(n for _, n in other)}; "
        + unexplained(moved),
        met=off - left == off,
    )
    for what, table in (
        ("settings and margins of Table 1 within 10 %", "Table 1"),
        ("resonances of Table 2 seen along the feed within 3 %", "Table 2"),
    ):
        few, hits = (
            [not (row["outside"] or row["mode"]) for row in of(plant, table)]
            for plant in tables.PLANTS
        )
        own = unexplained(of("full", table))
        yield Claim(what, f"{sum(hits)} of {len(hits)}", "",
                    f"rigid: {sum(few)} of {len(few)}; {own}", own.endswith("none"))  # fmt: skip
    few, many = (answer[plant]["growing_with_velocity"] for plant in tables.PLANTS)
    named, printed, grown = (set(rows) for rows in many.values())
    quiet = {row for row in grown if row[0] == "x"} | set(answer["full"]["growing_without_balls"])
    why = [f"{row} {answer['growing_why'].get(row, 'not explained')}" for row in named - grown]
    yield Claim(
        "frequencies that grow with velocity in the paper and here (Figure 18)",
        f"{len(named & grown)} of {len(named)}",
        "",
        f"rigid: {len(named.intersection(few['simulated_by_the_same_rule']))}; {len(named)} asked; "
        f"missing: {'; '.join(sorted(why))}; {len(grown - named)} rows that the paper does not "
        f"name grow as well, by its printed numbers {len(printed - named)}; without noise of the "
        f"balls (Y) {len(named & quiet)} named and {len(quiet - named)} others grow",
        met=named <= grown,
    )


if __name__ == "__main__":
    main()
