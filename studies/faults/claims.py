"""What the parts of faults claim."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, counted

STEP = "batch"


def kills(answer: Row) -> Iterator[Claim]:
    """Claim that batches whose runs are killed end as if nothing had happened."""
    for kind, row in answer["kills"].items():
        wrong = len(row["differences"]) + len(row["other_ends"])
        yield Claim(
            f"what is not as uninterrupted after kills at random moments ({kind})",
            f"{wrong} in {row['n']} kills, {row['batches']} batches",
            f"slowest end {row['slowest_end_s']:.0f} s",
            _control(answer),
            wrong == 0,
        )


def workers(answer: Row) -> Iterator[Claim]:
    """Claim the same of workers of a cluster, and of its scheduler."""
    row, passed = answer["workers killed"], answer["passed"]
    wrong = len(row["differences"]) + len(row["other_ends"])
    yield Claim(
        "what is not as uninterrupted after workers were killed",
        f"{wrong} in {row['n']} kills, {row['batches']} batches",
        "",
        _control(answer),
        wrong == 0,
    )
    if lost := answer["scheduler lost"]:
        fine = all(
            passed[f"{what}, scheduler lost"] for what in ("as uninterrupted", "told in one line")
        )
        yield Claim(
            "what is not so after the scheduler was lost",
            str(len(lost["differences"])),
            "",
            "told in one line" if fine else "not told in one line",
            fine,
        )


def losses(answer: Row) -> Iterator[Claim]:
    """Claim that a full disk and a lost database are told, and cost nothing."""
    for name in ("full disk", "full disk, output alone", "lost database"):
        row = answer[name]
        if row is None:
            yield Claim(name, "not tried: this machine does not allow it", met=False)
            continue
        fine = all(held for what, held in answer["passed"].items() if what.endswith(f", {name}"))
        yield Claim(
            f"{name}: what is not as without it",
            str(len(row["differences"])),
            f"{row['failed']} runs failed",
            "each in one line",
            fine,
        )


def together(answer: Row) -> Iterator[Claim]:
    """Claim that two runs at once leave what they leave alone."""
    for kind, ways in answer["pairs"].items():
        wrong = sum(bool(row["wrong"]) for row in ways.values())
        yield Claim(
            f"ways of running two at once that leave what each leaves alone ({kind})",
            f"{len(ways) - wrong} of {len(ways)}",
            f"{min(row['n'] for row in ways.values())} pairs each",
            "half of them with one killed",
            wrong == 0,
        )


def damaged(answer: Row) -> Iterator[Claim]:
    """Claim that damaged logs are told, and good ones analysed."""
    yield counted(
        f"damaged logs of {answer['kinds']} kinds told with the right reason",
        answer["damaged_told_right"],
        answer["damaged"],
        _control(answer, "controls"),
        met=answer["damaged_told_right"] == answer["damaged"],
    )
    yield counted(
        "good logs among them analysed",
        answer["good_analysed"],
        answer["good"],
        met=answer["good_analysed"] == answer["good"],
    )


def injection(answer: Row) -> Iterator[Claim]:
    """Claim that what names, tables and addresses say never acts."""
    for kind, row in answer["stores"].items():
        wrong = [line for found in row["wrong"].values() for line in found]
        yield Claim(
            f"what hostile names and metadata do ({kind})",
            f"{len(wrong)} of {len(row['wrong'])} things that must not be",
            f"{row['machines']} machines",
            _control(answer, "controls"),
            not wrong,
        )
    peaks = [row["peak_mb"] for row in answer["bombs"]]
    if peaks:
        yield Claim(
            "memory that a file which swells takes, with all libraries",
            f"{max(peaks)} MB at most",
            f"{len(peaks)} kinds",
            "",
            answer["passed"]["bombs stay small"],
        )
    tried = answer["addresses"]
    yield Claim(
        "addresses that show or keep their password",
        f"{len(tried['shown'])} of {tried['tried']}",
        met=not tried["shown"],
    )


def _control(answer: Row, name: str = "control") -> str:
    found = answer[name].values()
    return f"{sum(map(bool, found))} of {len(found)} controls are seen"
