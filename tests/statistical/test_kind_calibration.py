"""Lives of a plant that shares no map and no law with the program, each kind by itself.

Coarse forms of `studies/life/kinds`, which has the requirements and a hundred lives of each kind.
"""

from __future__ import annotations

import os

import numpy as np
import pytest

from studies.harness.study import Row
from studies.life.kinds.plant import MODES
from studies.life.kinds.run import ALARMS, NAMED, one
from studies.life.kinds.scores import scored
from studies.life.kinds.worlds import HEALTHY, LONE, life_of
from tests.claims import Claims, generator
from tests.statistical.evidence import as_often, at_least, at_most
from tests.statistical.sizes import SEED

# Courses that the description has not. Of each drawn number the place in the life follows.
COURSES = ("preload, power", "preload, exponential", "preload, relubrication")
PRELOAD = "guide_preload"
# Of lives of which a mode moves alone and a part is surely called degraded: next to none.
LEAST = 0.001


def lives(rng: np.random.Generator, kinds: tuple[str, ...], n: int) -> list[tuple[str, int, Row]]:
    """Answer lives of some kinds in turn, as the study does."""
    numbers = rng.choice(10**6, n, replace=False).tolist()
    return [(kind := kinds[k % len(kinds)], m, one(kind, m)) for k, m in enumerate(numbers)]


@pytest.fixture(scope="module")
def worn() -> list[tuple[str, int, Row]]:
    """Answer lives that wear, of which controls must take none for another kind."""
    seed = int(os.environ.get("LMSHEALTH_SEED", SEED))
    return lives(generator(seed, __name__), ("preload, linear",), 4)


def test_health_of_lives_that_wear_is_held(rng: np.random.Generator, claims: Claims) -> None:
    """Intervals of 90 % of a preload that wears by no law of the description hold it.

    Control: the preload of the next life.
    """
    found = lives(rng, COURSES, claims.trials)
    truths = [float(life_of(kind, number).ln_health[-1, 0]) for kind, number, _ in found]

    def held(truths: list[float]) -> int:
        ends = [np.quantile(answer["health"][PRELOAD], [0.05, 0.95]) for *_, answer in found]
        return sum(low <= truth <= high for (low, high), truth in zip(ends, truths, strict=True))

    n = len(found)
    claims.claim("preload that wears", as_often(held(truths), n, 0.9))
    claims.control("preload that wears", as_often(held(truths[1:] + truths[:1]), n, 0.9))


def test_a_mode_that_moves_alone_is_named(
    rng: np.random.Generator, claims: Claims, worn: list[tuple[str, int, Row]]
) -> None:
    """A mode that another cause moves is named, and no part is surely called degraded.

    Control: the name of the next mode, and lives whose preload wears.
    """
    found = lives(rng, tuple(LONE), claims.trials)
    scores = [scored(*life) for life in found]
    named, n = sum(row["right"] for row in scores), len(scores)
    claims.claim("mode alone, named", at_least(named, n, NAMED))
    claims.claim(
        "mode alone, no part degraded",
        at_most(sum(row["surely_degraded"] for row in scores), n, LEAST),
    )
    other = {mode: MODES[k - 1] for k, mode in enumerate(MODES)}
    wrong = [
        answer | {"why": answer["why"].lower().replace(mode, other[mode])}
        for kind, _, answer in found
        for mode in MODES
        if mode in kind
    ]
    misnamed = [
        scored(kind, m, own)["right"] for (kind, m, _), own in zip(found, wrong, strict=True)
    ]
    claims.control("mode alone, named", at_least(sum(misnamed), n, NAMED))
    degraded = sum(scored(*life)["surely_degraded"] for life in worn)
    claims.control("mode alone, no part degraded", at_most(degraded, len(worn), LEAST))


def test_machines_that_stay_raise_no_alarm(
    rng: np.random.Generator, claims: Claims, worn: list[tuple[str, int, Row]]
) -> None:
    """Machines that stay as they are, are healthy. Control: machines that wear."""

    def alarms(found: list[tuple[str, int, Row]]) -> int:
        return sum(answer["verdict"] != "healthy" for *_, answer in found)

    n = claims.trials
    still = lives(rng, tuple(HEALTHY), n)
    claims.claim("no alarm, by kind", at_most(alarms(still), n, ALARMS))
    claims.control("no alarm, by kind", at_most(alarms(worn), len(worn), ALARMS))
