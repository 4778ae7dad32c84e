"""Draw figure.svg from result.json: coverage of every case, and errors over their bound."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLUE, GREEN, GREY, ORANGE, draw_shares, name_lines, write
from studies.harness.study import Row

QUANTITIES = {"ln f": (BLUE, "o", -0.18), "ln zeta": (ORANGE, "s", 0.18)}
NAMES = {"ln f": "frequency", "ln zeta": "damping"}


def draw_figure(figure: Figure, record: Row) -> None:
    """Draw a line per case, its coverage on the left and its errors on the right."""
    rows = record["cases"]
    cases = cases_of(rows)
    left, right = figure.subplots(1, 2, sharey=True)
    draw_coverage(left, cases, rows)
    draw_efficiency(right, cases, rows)
    name_lines(left, cases)


def cases_of(rows: list[Row]) -> list[str]:
    """Return the names of cases in their order."""
    return list(dict.fromkeys(row["case"] for row in rows))


def places(cases: list[str], rows: list[Row]) -> list[tuple[float, Row]]:
    """Put the modes of a case beside each other, in the order of their frequencies."""
    found = []
    for row in rows:
        same = [r for r in rows if r["case"] == row["case"] and r["quantity"] == row["quantity"]]
        spread = 0.09 * (same.index(row) - (len(same) - 1) / 2)
        y = cases.index(row["case"]) + QUANTITIES[row["quantity"]][2] + spread
        found.append((y, row))
    return found


def draw_coverage(ax: Axes, cases: list[str], rows: list[Row]) -> None:
    """Draw the share of intervals that hold the truth, with its 99.9 % interval."""
    for quantity, (colour, marker, _) in QUANTITIES.items():
        ax.plot([], [], marker, ms=3, color=colour, label=NAMES[quantity])
    for y, row in places(cases, rows):
        colour, marker, _ = QUANTITIES[row["quantity"]]
        draw_shares(ax, y, [row["coverage"]], colour, marker, ms=3)
        ax.plot([row[key]["share"] for key in ("too_narrow", "too_wide")], [y, y], "|", ms=4,
                color=GREY)  # fmt: skip
    ax.plot([], [], "|", ms=4, color=GREY, label="1.5 times narrower or wider")
    ax.axvline(0.95, color="black", lw=0.8)
    ax.set_xlabel("share of 95 % intervals that hold the truth;\nbars: 99.9 % Clopper-Pearson")
    ax.legend(loc="upper left", frameon=True, framealpha=0.9)
    ax.grid(axis="x", alpha=0.25)


def draw_efficiency(ax: Axes, cases: list[str], rows: list[Row]) -> None:
    """Draw root mean square errors over the Cramér-Rao bound, with one standard error."""
    for y, row in places(cases, rows):
        if "rmse_over_bound" not in row:
            continue
        colour, marker, _ = QUANTITIES[row["quantity"]]
        ax.errorbar(row["rmse_over_bound"], y, xerr=row["its_error"], fmt=marker, ms=3, lw=1,
                    color=colour)  # fmt: skip
        if row["asked"] is not None:
            ax.plot(row["asked"], y, "|", ms=7, color=GREEN)
    for k, case in enumerate(cases):
        if all("rmse_over_bound" not in row for row in rows if row["case"] == case):
            ax.text(1.0, k, " no bound computed", va="center", color="#777777")
    ax.axvline(1, color="black", lw=0.8)
    ax.plot([], [], "|", ms=7, color=GREEN, label="asked: no more than this")
    ax.set_xlabel("root mean square error over the Cramér-Rao bound;\nbars: one standard error")
    ax.legend(loc="upper right", frameon=True, framealpha=0.9)
    ax.grid(axis="x", alpha=0.25)


if __name__ == "__main__":
    write(__file__, draw_figure,
          lambda record: (10, 0.42 * len(cases_of(record["cases"])) + 1.4), font=8)  # fmt: skip
