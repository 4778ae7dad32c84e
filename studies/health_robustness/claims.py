"""What health_robustness claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Older, Row, counted, covered, number, percents

STEP = "health, on machines that it does not know"
OLDER = {
    "result": Older("62df3d765a0b", "laws were weighed"),
    "control": Older("0c702f1698ba", "laws were weighed"),
}
JUMPING = ("sudden-loosening", "crash")
STAGES = {"lms-y": "Y", "lms-x": "X"}
ASKED = {
    "at epochs": ("epoch", "last"),
    "by the laws": ("now",),
    "of the remaining life": ("left",),
}


def raw(answer: Row) -> Iterator[Claim]:
    """Claim what intervals of raw lives hold; of what the modes do not tell, only what is left."""
    rows = answer["lives"]
    for how, asked in ASKED.items():
        for stage, name in STAGES.items():
            own = [
                row["90"]
                for row in rows
                if row["stage"] == stage
                and row["what"] in asked
                and (row["told"] or how == "of the remaining life")
            ]
            yield counted(
                f"90 % intervals {how} hold the truth ({name}, raw lives of ten kinds)",
                sum(row["hits"] for row in own),
                sum(row["n"] for row in own),
                "of one life several, so that the interval is too narrow",
                met=all(row["high"] >= 0.9 for row in own),
            )
    jumped = [
        row["error"]
        for row in rows
        if row["kind"] in JUMPING and row["what"] == "now" and row["told"]
    ]
    worst = max(jumped, key=lambda row: abs(row["mean"]))
    yield Claim(
        "medians by the laws after a crash or a broken bolt, off in the mean at most",
        f"{100 * abs(worst['mean']):.1f} %",
        f"± {100 * worst['se']:.1f} %",
    )


def result(answer: Row) -> Iterator[Claim]:
    """Claim what intervals of drawn lives hold, with maps that are right and wrong."""
    shown = [row for row in answer["lives"] if row["told"] and row["what"] in ("epoch", "last")]
    hits, n = (sum(row["90"][key] for row in shown) for key in ("hits", "n"))
    yield counted(
        "90 % intervals at epochs hold the truth (drawn lives of ten kinds)",
        hits,
        n,
        "",
        met=all(row["90"]["high"] >= 0.9 for row in shown),
    )
    for arm in ("coherent", "independent", "no error term"):
        own = [
            row
            for row in answer["fleets"]
            if (row["stage"], row["world"], row["arm"]) == ("lms-y", "map 5 % wrong", arm)
        ]
        control = arm != "coherent"
        yield covered(
            f"the map is 5 % wrong, its error believed: {arm}" + (" (control)" if control else ""),
            [row["90"] for row in own],
            "90 % asked" if not control else "",
            met=any(not row["90"]["holds"] for row in own)
            if control
            else all(row["90"]["holds"] for row in own),
        )
    for plant in dict.fromkeys(row["plant"] for row in answer["plants"]):
        own = [row for row in answer["plants"] if row["plant"] == plant and row["what"] == "last"]
        with_error, without = (
            [row["90"] for row in own if row["arm"] == arm] for arm in ("coherent", "no error term")
        )
        yield covered(
            f"the map is of another plant: {plant}",
            with_error,
            f"without its error {percents(row['share'] for row in without)}",
            met=all(row["share"] >= 0.9 for row in with_error),
        )
    chains = answer["chains"]
    apart = [value for name in ("infer", "fit_life", "prognose") if (value := chains.get(name))]
    yield Claim(
        "quantiles by importance sampling and by chains apart, standard deviations",
        number(max(apart)),
        f"{chains['n']} lives",
        "0.25 asked",
        max(apart) < 0.25,
    )


def control(answer: Row) -> Iterator[Claim]:
    """Claim that halved covariances are found out."""
    for what, name in (("last", "at epochs"), ("now", "by the laws")):
        own = [row["90"] for row in answer["fleets"] if row["what"] == what]
        yield covered(
            f"90 % intervals {name}, covariances halved (control)",
            own,
            met=all(row["high"] < 0.9 for row in own),
        )
