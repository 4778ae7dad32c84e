"""Codes of refusals: each that the package can give has its cause and cure, and no other has."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from lmshealth._private.tables import REFUSALS
from lmshealth.io.log import WARNINGS
from lmshealth.tracking.contradictions import LEFT_OUT
from tests.tools.columns import pages

PACKAGE = Path(__file__).parents[2] / "lmshealth"
# Place of the reason among the arguments of what makes a refusal.
MAKERS = {"Unusable": 0, "BadLog": 1, "Refusal": 1, "Rejection": 0, "Label": 1}
NAMES = {"reason", "why", "nothing", "NO_MODE_REASON"}
CODE = re.compile(r"[a-z]+(-[a-z]+)*")


def given(source: str) -> Iterator[str]:
    """Yield the codes that a module gives: arguments, assigned reasons, pairs, keys of notes."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            if name in MAKERS:
                named = [one.value for one in node.keywords if one.arg == "reason"]
                yield from constants(*named, *node.args[MAKERS[name] :][:1])
            if name == "_listed":
                yield from (key for one in node.args[1:] for key in keys(one))
        elif isinstance(node, ast.Assign):
            yield from assigned(node)
        elif isinstance(node, ast.Return) and isinstance(node.value, ast.Tuple):
            parts = node.value.elts
            if len(parts) == 2 and isinstance(parts[1], ast.JoinedStr):
                yield from constants(parts[0])  # a reason and its detail


def assigned(node: ast.Assign) -> Iterator[str]:
    """Yield codes that are assigned to a reason, or are the key of a note."""
    target = node.targets[0]
    if isinstance(target, ast.Subscript) and getattr(target.value, "id", "") == "notes":
        yield from constants(target.slice)
    names = target.elts if isinstance(target, ast.Tuple) else [target]
    if getattr(names[0], "id", "") in NAMES:
        value = node.value.elts[0] if isinstance(node.value, ast.Tuple) else node.value
        yield from constants(value)


def constants(*nodes: ast.AST) -> Iterator[str]:
    """Yield the codes of constants and of choices between two."""
    for node in nodes:
        if isinstance(node, ast.IfExp):
            yield from constants(node.body, node.orelse)
        elif isinstance(node, ast.Constant) and CODE.fullmatch(str(node.value)):
            yield str(node.value)


def keys(node: ast.AST) -> list[str]:
    """Return the keys of a dictionary."""
    return [*constants(*filter(None, node.keys))] if isinstance(node, ast.Dict) else []


def codes() -> set[str]:
    """Return the codes that modules of the package give."""
    found = set(WARNINGS) | set(LEFT_OUT)
    for path in PACKAGE.rglob("*.py"):
        found |= set(given(path.read_text(encoding="utf-8")))
    return found


def test_every_code_has_its_cause_and_cure() -> None:
    """None is missing; those of a table of channels are given by their module's constants."""
    assert codes() - set(REFUSALS) == set()
    for code, one in REFUSALS.items():
        assert CODE.fullmatch(code) and len(one.cause) > 10 and len(one.cure) > 8, code
        assert not one.cause.endswith(".") and not one.cure.endswith("."), code


def test_no_code_is_left_from_earlier_versions() -> None:
    """Each is a text in some module outside of the report."""
    sources = [
        p.read_text(encoding="utf-8") for p in PACKAGE.rglob("*.py") if "report" not in p.parts
    ]
    quoted = {code for code in REFUSALS if any(f'"{code}"' in source for source in sources)}
    assert set(REFUSALS) - quoted == set()


@pytest.mark.parametrize(
    "source",
    [
        'raise Unusable("brand-new", f"{x}")',
        'raise BadLog(name, "brand-new", "x")',
        'reason = "brand-new" if a else "flat"',
        'def f():\n    return "brand-new", f"it is {x}"',
        '_listed(name, {"brand-new": detail})',
        'notes["brand-new"] = "x"',
    ],
)
def test_a_code_without_an_entry_is_found(source: str) -> None:
    """Control: in each place where the package writes one."""
    assert set(given(source)) - set(REFUSALS) == {"brand-new"}


def test_warnings_are_those_of_logs() -> None:
    """A warning of a channel is one in the table, and its page names the flag of its modes."""
    assert {code for code in WARNINGS if REFUSALS[code].what != "warning"} == set()
    assert pages()["REFUSALS.md"].count("have the flag") == len(
        [one for one in WARNINGS.values() if one]
    )


def test_the_page_is_that_of_the_table() -> None:
    """`python -m tests.tools.columns` has been run."""
    stored = (PACKAGE / "report" / "REFUSALS.md").read_text(encoding="utf-8")
    assert stored == pages()["REFUSALS.md"]
