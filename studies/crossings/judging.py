"""What an association of a life is worth: swaps, labels, false births."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from studies.crossings.lives import Life

Labels = Sequence[Sequence[str | None]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """Counts of one life.

    Attributes
    ----------
    swapped : bool
        Whether after the crossing any estimate bears the label of another mode.
    wrong, wrong_before, wrong_near : int
        Wrong labels after, before and in the crossing.
    labelled, real : int
        Estimates of modes with any label, and all, after the crossing.
    labelled_before, real_before : int
        The same before modes come near.
    false_births : int
        Tracks of spurious estimates, or second ones of a mode.
    """

    swapped: bool
    wrong: int
    wrong_before: int
    wrong_near: int
    labelled: int
    real: int
    labelled_before: int
    real_before: int
    false_births: int


def judge(life: Life, labels: Labels) -> Score:
    """Compare labels with the truth; a track is the mode that it shows at first."""
    own, false = _owners(life, labels)
    count: Counter[str] = Counter()
    for k, (told, truth) in enumerate(zip(labels, life.truth, strict=True)):
        part = "before" if k < life.before else "after" if k >= life.after else "near"
        for label, mode in zip(told, truth, strict=True):
            if mode >= 0:
                count[f"real {part}"] += 1
                count[f"labelled {part}"] += label is not None
            if label is not None:
                count[f"wrong {part}"] += own.get(label) != mode
    return Score(
        swapped=count["wrong after"] > 0,
        wrong=count["wrong after"],
        wrong_before=count["wrong before"],
        wrong_near=count["wrong near"],
        labelled=count["labelled after"],
        real=count["real after"],
        labelled_before=count["labelled before"],
        real_before=count["real before"],
        false_births=false,
    )


def _owners(life: Life, labels: Labels) -> tuple[dict[str, int], int]:
    """Find the mode of each track, and how many tracks are of none or of one that has another."""
    shown: dict[str, list[int]] = {}
    for told, truth in zip(labels, life.truth, strict=True):
        for label, mode in zip(told, truth, strict=True):
            if label is not None:
                shown.setdefault(label, []).append(mode)
    own = {label: Counter(modes[:5]).most_common(1)[0][0] for label, modes in shown.items()}
    modes = list(own.values())
    return own, len(modes) - len({mode for mode in modes if mode >= 0})


def nearest(life: Life) -> Labels:
    """Give each estimate to the mode that was last seen nearest: what is commonly done."""
    last = {f"track_{i}": float(value) for i, value in enumerate(np.sort(life.ln_f[0]))}
    labels = []
    for epoch in life.epochs:
        told = []
        for value in epoch.ln_frequency.tolist():
            name = min(last, key=lambda n: abs(last[n] - value))  # noqa: B023
            told.append(name)
            last[name] = value
        labels.append(told)
    return labels
