"""The judgement of statistical claims: Holm's rule, its error rate, and how it fails a run."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from lmshealth.calibration.ranks import holm
from tests.claims import Claims, Part, generator
from tests.statistical import evidence
from tests.statistical.sizes import LEVEL, TESTS


def test_holm_steps_down() -> None:
    """Levels grow from level over number; after the first p value that is not below, none is."""
    asked, rejected = holm([0.01, 0.04, 0.03, 0.005], 0.05, 4)
    np.testing.assert_allclose(asked, [0.05 / 3, 0.05, 0.025, 0.0125])
    assert rejected.tolist() == [True, False, False, True]
    asked, rejected = holm([0.03, 0.001], 0.05, 2)
    assert rejected.tolist() == [True, True]


def test_claims_that_are_missing_reject_nothing() -> None:
    """Of four claims of which one was made, it is held to a fourth of the level."""
    assert holm([0.0124], 0.05, 4)[1].all()
    assert not holm([0.0126], 0.05, 4)[1].any()
    assert holm([], 0.05, 4)[1].size == 0


@pytest.mark.parametrize("common", [0.0, 0.8])
def test_the_family_fails_as_seldom_as_stated(common: float) -> None:
    """Of 5,000 suites of 50 true claims, and of some false ones, 5 % at most reject a true one.

    Also where p values depend on each other. Negative control: without the rule nearly all do.
    """
    rng = np.random.default_rng(1)
    n, m, false = 5_000, 50, 10
    shared = rng.standard_normal((n, 1))
    z = np.sqrt(common) * shared + np.sqrt(1 - common) * rng.standard_normal((n, m))
    p = stats.norm.sf(z)
    p[:, :false] = 1e-9
    wrong = sum(bool(holm(own, 0.05, m)[1][false:].any()) for own in p)
    assert evidence.at_most(wrong, n, 0.05) > 1e-6
    if common == 0:
        assert evidence.as_often(wrong, n, 1 - (1 - 0.05 / 40) ** 40) > 1e-6
        assert np.mean((p[:, false:] < 0.05).any(axis=1)) > 0.8


@pytest.mark.slow
def test_p_values_are_those_of_chance() -> None:
    """Of 300 true claims of each kind as many as 5 %, and no more, have a p value below 5 %.

    What is counted can only be less. Negative control: places that are drawn too near the middle.
    """
    rng, n = np.random.default_rng(2), 300
    places, off = rng.uniform(size=(n, 60)), rng.standard_normal((n, 60))
    kinds = {
        "places": [evidence.uniform(own) for own in places],
        "errors": [evidence.covered(own) for own in off],
        "squares": [evidence.sum_of_squares(float(own @ own), own.size) for own in off],
        "at most": [evidence.at_most(np.sum(own < 0.1), own.size, 0.1) for own in places],
        "at least": [evidence.at_least(np.sum(own < 0.1), own.size, 0.1) for own in places],
    }
    for name, p in kinds.items():
        below = int(np.sum(np.array(p) <= 0.05))
        assert evidence.at_most(below, n, 0.05) > 1e-4, name
    squares = int(np.sum(np.array(kinds["squares"]) <= 0.05))
    assert evidence.as_often(squares, n, 0.05) > 1e-4
    assert np.mean([evidence.uniform(0.5 + 0.5 * (own - 0.5)) < 1e-4 for own in places[:20]]) == 1


def test_generators_depend_on_seed_and_name_alone() -> None:
    """The same test draws the same numbers, another test or another seed draws others."""
    first = generator(1, "a.py::test").standard_normal(3)
    np.testing.assert_array_equal(first, generator(1, "a.py::test").standard_normal(3))
    assert (first != generator(1, "a.py::other").standard_normal(3)).all()
    assert (first != generator(2, "a.py::test").standard_normal(3)).all()


def settled(claims: Claims) -> str:
    """Return what a test fails with, or nothing."""
    try:
        claims.settle()
    except pytest.fail.Exception as failure:
        return str(failure)
    return ""


def test_a_test_answers_for_its_claims() -> None:
    """What is rejected alone, not claimed, or has no control or a blind one, fails the test."""
    part = Part(10, ("one", "two"))

    def made(p: dict[str, float], control: dict[str, float]) -> str:
        claims = Claims("link", part, 0.01, 100)
        for name, value in p.items():
            claims.claim(name, value)
        for name, value in control.items():
            claims.control(name, value)
        return settled(claims)

    seen = {"one": 1e-9, "two": 1e-9}
    assert made({"one": 0.5, "two": 1.1e-4}, seen) == ""
    assert made({"one": 0.5, "two": 0.9e-4}, seen).startswith("two: p = 9e-05, rejected")
    assert made({"one": 0.5}, seen) == "two: not claimed"
    assert made({"one": 0.5, "two": 0.5}, {"one": 1e-9}) == "two: no control"
    assert "could not have seen" in made({"one": 0.5, "two": 0.5}, seen | {"two": 1.1e-4})
    assert "two: p = nan" in made({"one": 0.5, "two": np.nan}, seen)
    assert "has p = nan" in made({"one": 0.5, "two": 0.5}, seen | {"two": np.nan})


def test_of_several_controls_the_least_seen_counts() -> None:
    """A blind control is not hidden by one that is seen, whichever comes first."""
    for order in ((0.5, 1e-9), (1e-9, 0.5)):
        claims = Claims("link", Part(10, ("one",)), 0.01, 100)
        for p in order:
            claims.control("one", p)
        assert claims.controls == {"one": 0.5}


def test_every_statistical_test_has_its_size(root: Path) -> None:
    """The tests of the folder are those of the table, and no claim is told twice."""
    found = []
    for path in sorted((root / "tests" / "statistical").glob("test_*.py")):
        nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        found += [n.name for n in nodes if isinstance(n, ast.FunctionDef) and n.name[:5] == "test_"]
    assert sorted(found) == sorted(TESTS)
    for part in TESTS.values():
        assert len(set(part.claims)) == len(part.claims) > 0
    assert LEVEL <= 0.01


INNER = """
import pytest
from tests.claims import KEY, Claims, Part

@pytest.fixture
def claims(request):
    own = request.node.stash[KEY] = Claims("link", Part(5, (request.node.name,)), 0.05, 4)
    return own
"""
CASES = """
import pytest

@pytest.mark.parametrize("p", {p})
def test_claim(claims, p):
    (name,) = claims.part.claims
    claims.control(name, 0.0)
    claims.claim(name, p)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("p", "rejected", "code"), [((0.5, 0.9), 0, 0), ((0.01, 0.015, 0.9), 2, 1)]
)
def test_a_run_gathers_the_claims_of_all_workers(
    pytester: pytest.Pytester, root: Path, monkeypatch: pytest.MonkeyPatch,
    p: tuple[float, ...], rejected: int, code: int,
) -> None:  # fmt: skip
    """The table has all claims, least probable first, by Holm's levels, and a rejection fails."""
    monkeypatch.setenv("PYTHONPATH", str(root))
    pytester.makeconftest(INNER)
    pytester.makepyfile(CASES.format(p=list(p)))
    done = pytester.runpytest_subprocess("-n", "2", "-p", "tests.claims", "-p", "no:cacheprovider")
    assert done.ret == code
    done.stdout.fnmatch_lines(["*statistical claims*", "claim *trials*p *held to*control"])
    rows = [line for line in done.outlines if line.startswith("link: ")]
    assert [float(row.split()[3]) for row in rows] == sorted(p)
    assert [row.endswith("REJECTED") for row in rows] == [k < rejected for k in range(len(p))]
    assert [float(row.split()[4]) for row in rows] == pytest.approx(
        [0.05 / (4 - k) for k in range(len(p))], rel=0.06
    )
    done.stdout.fnmatch_lines([f"{len(p)} of 4 claims made, {rejected} rejected by Holm's*"])
