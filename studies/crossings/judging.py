"""What an association of a life is worth: swaps, labels, false births."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from studies.crossings.lives import Life

N_AFTER = 15
Labels = Sequence[Sequence[str | None]]


def judge(life: Life, labels: Labels) -> Counter[str]:
    """Compare labels with the truth; a track is the mode that it shows at first.

    Returns
    -------
    Counter
        For the logs before, in and after the crossing: ``real`` estimates of modes, ``labelled``
        ones of them, ``swapped`` ones that bear the label of another mode; ``spurious`` ones and
        those ``taken`` for a mode. ``false_births`` are tracks of spurious estimates and second
        tracks of a mode; ``lives`` is 1, and ``lives_swapped`` too if any is after the crossing.
    """
    own = _owners(life, labels)
    modes = list(own.values())
    count = Counter(lives=1, false_births=len(modes) - len({mode for mode in modes if mode >= 0}))
    for k, (told, truth) in enumerate(zip(labels, life.truth, strict=True)):
        part = "before" if k < life.before else "after" if k >= life.after else "near"
        for label, mode in zip(told, truth, strict=True):
            if mode < 0:
                count["spurious"] += 1
                count["taken"] += label is not None
            else:
                count[f"real_{part}"] += 1
                count[f"labelled_{part}"] += label is not None
                count[f"swapped_{part}"] += label is not None and own[label] != mode
    count["lives_swapped"] = int(count["swapped_after"] > 0)
    return count


def _owners(life: Life, labels: Labels) -> dict[str, int]:
    """Find the mode of each track: what most of its first five estimates are of."""
    shown: dict[str, list[int]] = {}
    for told, truth in zip(labels, life.truth, strict=True):
        for label, mode in zip(told, truth, strict=True):
            if label is not None:
                shown.setdefault(label, []).append(mode)
    return {label: Counter(modes[:5]).most_common(1)[0][0] for label, modes in shown.items()}


def recovered(life: Life, labels: Labels) -> NDArray[np.float64]:
    """Return the share labelled in each of the first logs after the crossing; NaN without one."""
    share = np.full(N_AFTER, np.nan)
    for j, k in enumerate(range(life.after, min(life.after + N_AFTER, len(labels)))):
        own = [
            label is not None for label, i in zip(labels[k], life.truth[k], strict=True) if i >= 0
        ]
        share[j] = np.mean(own) if own else np.nan
    return share


def nearest(life: Life) -> Labels:
    """Give each estimate to the mode that was last seen nearest: what is commonly done."""
    last = np.sort(life.ln_f[0])
    labels = []
    for epoch in life.epochs:
        told = []
        for value in epoch.ln_frequency:
            mode = int(np.argmin(np.abs(last - value)))
            told.append(f"track_{mode}")
            last[mode] = value
        labels.append(told)
    return labels
