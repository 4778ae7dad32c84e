"""Results of a check of calibration: CSV, JSON, and one page with ranks and coverages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from lmshealth._private.arrays import finite_or_none
from lmshealth._private.files import write_text
from lmshealth._private.tables import TABLES, Row
from lmshealth.calibration import constants
from lmshealth.calibration.check import DAYS, DRAWN, CalibrationCheck, Coverage, Rate
from lmshealth.machine.constants import JSON_SCHEMA
from lmshealth.report.figures import BLUE, INK, MUTED, RED, svg
from lmshealth.report.rendering import render
from lmshealth.report.tables import csv_text
from lmshealth.report.text import GAP, coarse, percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PAGE = "calibration.html"
# Probability that some bar of uniform ranks leaves the band of its histogram.
_OUTSIDE = 0.01
# Few bins: with more, the band is so wide that no bar leaves it.
_LEAST_BINS, _MOST_BINS, _PER_BIN = 5, 20, 20
_FLAT = "Good: bars of equal height, none beyond the grey band."


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure with its caption, which states how a right result appears."""

    title: str
    svg: str
    caption: str
    kind: str = ""  # class of the figure in the style sheet


@dataclass(frozen=True, slots=True)
class Block:
    """A part of a page: text, figures, and the rows of a table, all with the same keys."""

    title: str
    text: Sequence[str]
    figures: Sequence[Picture] = ()
    rows: Sequence[dict[str, str]] = ()


@dataclass(frozen=True, slots=True)
class Share:
    """A share with its 95 % interval, beside what is stated: ``as``, at ``most`` or ``least``."""

    label: str
    share: float
    low: float
    high: float
    stated: float | None = None
    side: Literal["as", "most", "least"] = "as"
    rejected: bool | None = None  # by a rule over all checks; None where no rule has judged it

    @property
    def missed(self) -> bool:
        """Whether it is rejected; without a rule, whether its interval is on the wrong side."""
        if self.rejected is not None:
            return self.rejected
        if self.stated is None:
            return False
        above, below = self.low > self.stated, self.high < self.stated
        return (above and self.side != "least") or (below and self.side != "most")


def rank_histogram(ax: Axes, places: ArrayLike) -> Axes:
    """Plot the histogram of ranks ``(n,)`` from 0 to 1 with the band of uniform ones."""
    values = np.ravel(places)
    n = values.size
    bins = int(np.clip(n // _PER_BIN, _LEAST_BINS, _MOST_BINS))
    low, high = stats.binom.interval(1 - _OUTSIDE / bins, n, 1 / bins)
    ax.axhspan(low, high, color=MUTED, alpha=0.2, lw=0)
    ax.axhline(n / bins, color=INK, lw=1, ls=(0, (5, 3)))
    counts = np.histogram(values, bins=bins, range=(0, 1))[0]
    edges = np.linspace(0, 1, bins + 1)
    outside = (counts < low) | (counts > high)
    colours = [RED if out else BLUE for out in outside]
    ax.bar(edges[:-1], counts, width=1 / bins, align="edge", color=colours, ec="#fefefe", lw=0.7)
    ax.set(xlim=(0, 1), ylim=(0, 1.15 * max(high, counts.max(initial=0))))
    ax.set_xticks([0, 0.5, 1], ["below all", "middle", "above all"])
    ax.set(xlabel="true value among the values held possible", ylabel="number")
    ax.grid(visible=False)
    return ax


def share_plot(ax: Axes, rows: Sequence[Share]) -> Axes:
    """Plot shares with their intervals, and dashed lines where they are stated."""
    for y, one in enumerate(rows):
        colour = RED if one.missed else BLUE
        ax.plot([100 * one.low, 100 * one.high], [y, y], color=colour, lw=5, alpha=0.45)
        ax.plot(100 * one.share, y, "o", ms=5, color=colour)
        if one.stated is not None:
            ax.plot([100 * one.stated] * 2, [y - 0.4, y + 0.4], color=INK, lw=1.4, ls=(0, (2, 1)))
    ax.set_yticks(range(len(rows)), [one.label for one in rows])
    ax.set(ylim=(len(rows) - 0.4, -0.6), xlim=(-2, 102))
    ax.set_xlabel(f"share in % with 95{GAP}% interval")
    ax.grid(visible=False, axis="y")
    return ax


def histogram_picture(
    title: str, places: ArrayLike, note: str, *, salt: str, expected: str = _FLAT
) -> Picture:
    """Draw a histogram of ranks; its caption has the expected form of the bars, and a note."""
    text = svg(lambda ax: rank_histogram(ax, places), salt=salt)
    return Picture(title, text, f"{expected} {note}")


def share_picture(
    title: str, rows: Sequence[Share], caption: str, *, salt: str, wide: bool = False
) -> Picture:
    """Draw shares with a caption."""
    size = (9.2 if wide else 4.5, 0.9 + 0.26 * len(rows))
    text = svg(lambda ax: share_plot(ax, rows), salt=salt, size=size)
    return Picture(title, text, caption, "wide-figure" if wide else "")


def render_page(
    title: str, sub: str, verdict: tuple[str, str, Sequence[str]], blocks: Sequence[Block]
) -> str:
    """Render a page: ``good``, ``bad`` or ``open`` with headline and reasons, then its blocks."""
    content = dict(zip(("state", "headline", "why"), verdict, strict=True))
    return render("calibration.html.j2", title=title, sub=sub, blocks=blocks, **content)


def verdict_of(check: CalibrationCheck) -> tuple[str, str, list[str]]:
    """Return state, headline and reasons of a check, for page and terminal."""
    n_drawn = sum(one.drawn for one in check.outcomes)
    drawn = f"{n_drawn} {'life' if n_drawn == 1 else 'lives'} drawn from the description"
    family = (
        f"{len(check.p_values)} checks are held to {percent(constants.FALSE_VERDICT)} together: at "
        "most so often a right program is called wrong."
    )
    if check.wrong:
        found = (f"{_spelled(name)} (p = {check.p_values[name]:.2g})" for name in check.wrong)
        why = f"By {drawn}, not so: {'; '.join(found)}."
        return "bad", "The stated uncertainty is wrong", [why, family]
    if not check.ranks:
        return "open", "No life has a result", [f"None of {drawn} has a posterior."]
    if check.blind:
        faults = "; ".join(map(_spelled, check.blind))
        why = f"By {drawn} these faults would not be found: {faults}. Draw more lives."
        return "open", "No fault found, in too few lives to be sure", [why, family]
    why = f"Intervals and ranks of {drawn} agree with what is stated; wrong ones would be found."
    return "good", "The stated uncertainty is right", [why, family]


def _spelled(name: str) -> str:
    """Return the name of a quantity, or of a check or control of it, as the page has it."""
    return name.replace(DAYS, "date of the first limit")


def _width(one: Coverage) -> str:
    """Format a median width: of health in percent of the baseline, of dates in days."""
    if one.width != one.width:
        return "–"
    if one.quantity != DAYS:
        return f"{100 * one.width:.1f}{GAP}%"
    return f"{coarse(one.width)}{GAP}days ({one.n_ends} of {one.n} end)"


def expectation_rows(check: CalibrationCheck) -> list[dict[str, str]]:
    """Return coverage and width by kind of life and quantity, as texts."""
    pairs: dict[tuple[str, str], list[Coverage]] = {}
    for one in check.coverage:
        pairs.setdefault((one.kind, one.quantity), []).append(one)
    rows = []
    for (kind, quantity), own in pairs.items():
        wrong = [f"{percent(x.level)}: {x.verdict}" for x in own if x.verdict != "as stated"]
        row = {"lives": kind, "quantity": _spelled(quantity), "n": str(own[0].n)}
        row |= {f"{percent(one.level)} hold": _measured(one) for one in own}
        row |= {
            f"median width at {percent(own[-1].level)}": _width(own[-1]),
            "": ", ".join(wrong) or ("as stated" if kind == DRAWN else "not excluded"),
        }
        rows.append(row)
    return rows


def _measured(one: Coverage | Rate) -> str:
    low, high = (f"{100 * end:.0f}" for end in (one.low, one.high))
    return f"{percent(one.share, 0)} ({low} to {high})"


def rate_rows(rates: Iterable[Rate]) -> list[dict[str, str]]:
    """Return detection and false alarms by kind of life, as texts."""
    return [
        {
            "lives": one.kind,
            "what happens": one.what,
            "share (95 % interval)": f"{_measured(one)}, {one.hits} of {one.n}",
            "stated": "" if one.at_most is None else f"at most {percent(one.at_most)}",
            "at (median)": "" if one.median_log is None else f"log {one.median_log:.0f}",
        }
        for one in rates
    ]


def _expectations(check: CalibrationCheck, quantities: Sequence[str]) -> Block:
    """Show coverage and width of intervals by kind of life."""
    n = len(check.outcomes)
    return Block(
        "What you may expect",
        (
            f"{n} lives of {check.stage} were drawn from its description, and each was analysed as "
            "real logs are. A 90 % interval is right if it contains the true value in 90 of 100 "
            "lives: in fewer it is too narrow, and its uncertainty is too small; in more it is too "
            "wide, and its uncertainty too large.",
            "“as described” has lives of all kinds as often as the description expects them; only "
            "there coverage must be as stated. In lives of one kind alone it may be higher or "
            "lower, which is shown beside it; few lives do not exclude the level. In brackets: "
            "95 % Monte-Carlo interval.",
            *(f"Without a result are {k} lives: {why}." for why, k in check.without_result.items()),
        ),
        [
            share_picture(
                _spelled(quantity).capitalize(),
                [
                    Share(f"{one.kind}, {100 * one.level:.0f} %", one.share, one.low, one.high,
                          one.level, rejected=one.verdict != "as stated")
                    for one in check.coverage
                    if one.quantity == quantity
                ],
                "Good: no “as described” bar is red. A bar is red if the table calls its intervals "
                "too narrow or too wide; a blue one may miss its dashed line by chance. "
                f"{_of_kinds(quantity)}",
                salt=f"coverage-{k}",
            )
            for k, quantity in enumerate(quantities)
        ],
        expectation_rows(check),
    )  # fmt: skip


def _ranks(check: CalibrationCheck, quantities: Sequence[str]) -> Block:
    """Show the ranks of truths in lives drawn from the description, and tests of them."""
    drawn = [one for one in check.outcomes if one.drawn]
    return Block(
        "Is the uncertainty neither too small nor too large?",
        (
            "In each life the true value is ranked among 127 values that the analysis considers "
            "possible. If its uncertainty is right, all ranks are equally frequent: the bars are "
            "level. Bars high at both ends: intervals too narrow. High in the middle: too wide. "
            "High on the left: estimates too high; on the right: too low.",
            "In the table, “changes” is whether a parameter changes at all, “off its law” its "
            "deviation from its law, “remaining” the travel left, and “moves alone” whether a mode "
            "moves by a foreign cause.",
        ),
        [
            histogram_picture(
                _spelled(name).capitalize(),
                [one.places[name] for one in drawn if name in one.places],
                f"Test of uniform ranks: {_tested(check, name)}.",
                salt=f"rank-{k}",
            )
            for k, name in enumerate(quantities)
            if name in check.ranks
        ],
        [
            {
                "quantity": _spelled(name),
                "lives": str(row["n"]),
                "test of uniform ranks": _tested(check, name),
                "p": f"{row['p_value']:.2g}",
            }
            for name, row in check.ranks.items()
        ],
    )


def _assumptions(check: CalibrationCheck) -> Block:
    """State schedule, errors of the estimates, and what was not checked."""
    schedule = check.schedule
    errors = "the Cramér-Rao bound with the SNR of the description"
    if schedule.frequency_std is not None:
        errors = f"{percent(schedule.frequency_std, 3)} of the frequency"
    return Block(
        "What was assumed",
        (
            f"{schedule.logs} logs, one every {schedule.every:g} days, {schedule.seconds:g} s "
            f"each; {coarse(schedule.km_per_day or np.nan)} km a day; seed {check.seed}. Standard "
            f"deviations of frequencies in one log: {errors}.",
            "Lives are drawn at the level of modal estimates of each log with their covariances, "
            "not of raw samples: errors of identification are in studies/modes. Map, priors, laws "
            "and disturbances are those of the description, with the error of the map that it "
            "states. A machine that differs from its description in another way is not checked.",
        ),
    )


def _of_kinds(quantity: str) -> str:
    if quantity == DAYS:
        return "Of machines that never reach a limit, ranks beyond the horizon are drawn at random."
    return "Other kinds show what to expect of such lives alone."


def _tested(check: CalibrationCheck, name: str) -> str:
    return "passed" if check.passed[f"{name}: ranks are uniform"] else "failed"


def _detection(check: CalibrationCheck) -> Block:
    rates = [one for one in check.rates if one.what.startswith("a loss of ")]
    rows = [
        Share(one.what.removeprefix("a loss of ").removesuffix(" is reported as degraded"),
              one.share, one.low, one.high)
        for one in rates
    ]  # fmt: skip
    false = [one for one in check.rates if "(false)" in one.what or one.at_most is not None]
    alarms = [
        Share(f"{o.kind}: {o.what}"[:70], o.share, o.low, o.high, o.at_most, "most", o.exceeded)
        for o in false
    ]
    pictures = []
    if rows:
        caption = (
            "Good: near 0 % for losses that do not matter, near 100 % from a quarter of the way "
            "to the limit on, where a parameter counts as degraded."
        )
        pictures.append(share_picture("Losses that are reported", rows, caption, salt="losses"))
    if alarms:
        caption = (
            "Good: near 0 %, and no bar is red. A bar is red if by the rule over all checks its "
            "share is above its dashed line; a blue one may be so by chance."
        )
        pictures.append(
            share_picture("False alarms and late dates", alarms, caption, salt="false", wide=True)
        )
    text = (
        "What is reported of lives whose truth is known. A loss is the share of its baseline that "
        "a parameter has truly lost at the last log.",
        "The tracker declares its false alarms for machines whose health is constant and whose "
        "modes wander no more than its own model has it; only of these their rate is part of the "
        "verdict. In other healthy lives modes wander more, or a parameter deviates by a few "
        "percent: something does move, though hardly a verdict follows.",
    )
    return Block("What is detected, and what is reported by mistake", text, pictures,
                 rate_rows(check.rates))  # fmt: skip


def _controls(check: CalibrationCheck, quantities: Sequence[str]) -> Block:
    """Show the same check of intervals that are wrong on purpose."""
    where = dict(zip(constants.WRONG_WIDTHS, ("at both ends", "in the middle"), strict=True))
    pictures = [
        histogram_picture(
            f"{_spelled(name).capitalize()}, intervals {word} on purpose",
            [o.controls[f"{factor:g}"][name] for o in check.outcomes
             if o.drawn and name in o.controls.get(f"{factor:g}", {})],
            f"This one must not look good: it is high {where[factor]}.",
            salt=f"control-{factor:g}".replace(".", "-"),
        )
        for name in quantities[:1]
        for factor, word in constants.WRONG_WIDTHS.items()
    ]  # fmt: skip
    rows = [
        {"control": _spelled(name), "found": "no: more lives are needed"
         if name in check.blind else "yes"}
        for name in check.controls
    ]  # fmt: skip
    text = (
        "The same lives with intervals of half and of double width (of dates that mostly never "
        "come, half and double the time). A check that does not find these could not find such a "
        "fault in the analysis either.",
    )
    return Block("Would a fault be found? (negative controls)", text, pictures, rows)


def life_rows(check: CalibrationCheck) -> list[Row]:
    """Return one row per life and published quantity."""
    table = TABLES["calibration_lives"]
    found = []
    for one in check.outcomes:
        common = one.kind, one.drawn, one.number
        wait = finite_or_none(one.wait)
        end = one.verdict or None, one.alarm, one.service or None, wait, one.failed or None
        for name, values in one.quantiles.items():
            known = map(finite_or_none, (one.truth[name], *values))
            found.append(table.row(*common, name, *known, one.places[name], *end))
        if not one.quantiles:
            found.append(table.row(*common, *([None] * 8), *end))
    return found


def document(check: CalibrationCheck) -> dict[str, Any]:
    """Return the check for other programs, without the single lives."""
    state, headline, _ = verdict_of(check)
    names = [one.name for one in fields(check) if one.name != "outcomes"]
    content = {name: getattr(check, name) for name in names}
    return {"schema": JSON_SCHEMA, "state": state, "verdict": headline, **content}


def write_results(folder: Path, check: CalibrationCheck) -> Path:
    """Write the tables, ``calibration.json`` and the page into a folder; return the page."""
    tables = {
        "coverage": TABLES["calibration_coverage"].rows_of(check.coverage),
        "rates": TABLES["calibration_rates"].rows_of(check.rates),
        "lives": life_rows(check),
    }
    for name, rows in tables.items():
        write_text(folder / f"{name}.csv", csv_text(f"calibration_{name}", rows))
    encoded = msgspec.json.format(msgspec.json.encode(document(check)), indent=1).decode()
    write_text(folder / "calibration.json", encoded + "\n")
    n = sum(one.drawn for one in check.outcomes)
    sub = f"{len(check.outcomes)} simulated lives, {n} of them with the description's probabilities"
    page = folder / PAGE
    title = f"Calibration of {check.stage}"
    quantities = list(dict.fromkeys(one.quantity for one in check.coverage))
    blocks = [
        _expectations(check, quantities),
        _ranks(check, quantities),
        _detection(check),
        _controls(check, quantities),
        _assumptions(check),
    ]
    write_text(page, render_page(title, sub, verdict_of(check), blocks))
    return page
