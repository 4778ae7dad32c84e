"""Mutants of a module: its source with one small change, by the operators of mutmut.

Not made is what changes nothing that a module computes: in type annotations, decorators, imports,
docstrings and ``__all__``; in errors, assertions, warnings, logging, and strings that are text
(they have a space, are formatted, or have triple quotes); in aliases of types and ``cast``; in
``strict`` of ``zip``, which asks for what holds. Nor is a change that leaves the syntax tree as it
was. Whether another mutant computes the same is not decided by a rule: it is made.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import takewhile

import libcst as cst
from libcst import matchers as m
from libcst.metadata import MetadataWrapper, PositionProvider
from mutmut.mutation.mutators import mutation_operators

_TOLD = (cst.Annotation, cst.Decorator, cst.Import, cst.ImportFrom, cst.Raise, cst.Assert,
         cst.FormattedString)  # fmt: skip
_TELLS = re.compile(r"\w*(Error|Warning|TypeVar|NewType|cast)")
_LOGGERS = re.compile(r"_?(log|logger|logging|warnings)", re.IGNORECASE)
_ASKS = ("strict", "stacklevel")


@dataclass(frozen=True, slots=True)
class Mutant:
    """One small change of a module."""

    kind: str  # What the operator changes
    line: int  # Where
    old: str  # The lines that differ, before and after
    new: str
    code: str  # The module with the change


class Mutants:
    """All mutants of a source, each made when it is asked for."""

    def __init__(self, source: str) -> None:
        self._source = source
        wrapper = MetadataWrapper(cst.parse_module(source))
        finder = _Finder()
        wrapper.visit(finder)
        self._module, self._found = wrapper.module, finder.found

    def __len__(self) -> int:
        return len(self._found)

    def make(self, index: int) -> Mutant | None:
        """Make one; None where it is no program, or the same one."""
        kind, line, old, new = self._found[index]
        code = self._module.deep_replace(old, new).code  # type: ignore[arg-type]
        try:
            tree = ast.parse(code)
        except SyntaxError:
            return None
        if ast.dump(tree) == ast.dump(ast.parse(self._source)):
            return None
        return Mutant(kind, line, *_differing(self._source, code), code)


class _Finder(cst.CSTVisitor):
    """Gathers what operators give for every node that computes something."""

    METADATA_DEPENDENCIES = (PositionProvider,)

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, int, cst.CSTNode, cst.CSTNode]] = []
        self._depth = 0

    def on_visit(self, node: cst.CSTNode) -> bool:
        self._depth += isinstance(node, cst.FunctionDef | cst.ClassDef)
        alias = m.matches(node, m.Assign(value=m.Subscript())) or isinstance(node, cst.TypeAlias)
        if _tells(node) or (self._depth == 0 and alias):
            return False
        for of, operator in mutation_operators:
            if isinstance(node, of):
                kind = operator.__name__.removeprefix("operator_").replace("_", " ")
                line = self.get_metadata(PositionProvider, node, None)
                for new in operator(node):
                    if line is not None and not any(map(_tells, _gone(node, new))):
                        self.found.append((kind, line.start.line, node, new))
        return True

    def on_leave(self, original_node: cst.CSTNode) -> None:
        self._depth -= isinstance(original_node, cst.FunctionDef | cst.ClassDef)


def _tells(node: cst.CSTNode) -> bool:
    """Whether a node is text, type or demand, by the rules above."""
    match node:
        case cst.SimpleString():
            return " " in node.value or node.quote in ('"""', "'''")
        case cst.Arg(keyword=cst.Name(name)):
            return name in _ASKS
        case cst.Assign(targets=[cst.AssignTarget(target=cst.Name(name))]):
            return name == "__all__"
        case cst.Call(func=cst.Name(name)):
            return _TELLS.fullmatch(name) is not None
        case cst.Call(func=cst.Attribute(value=cst.Name(name))):
            return _LOGGERS.fullmatch(name) is not None
    return isinstance(node, _TOLD)


def _gone(old: cst.CSTNode, new: cst.CSTNode) -> Iterable[cst.CSTNode]:
    """Return the arguments of a call that a mutant does not have, or has changed."""
    if not isinstance(old, cst.Call) or not isinstance(new, cst.Call):
        return []
    return [arg for arg in old.args if not any(arg is other for other in new.args)]


def _differing(old: str, new: str) -> tuple[str, str]:
    """Return the lines that two texts do not share at their beginning and end."""
    a, b = old.splitlines(), new.splitlines()
    first = _shared(a, b)
    last = _shared(a[first:][::-1], b[first:][::-1])
    told = (" ".join(line.strip() for line in text[first : len(text) - last]) for text in (a, b))
    return next(told), next(told)


def _shared(a: list[str], b: list[str]) -> int:
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(a, b, strict=False)))


def planted(source: str, line: int) -> str:
    """Make the function that holds a line fail, or the module, where no function does."""
    body = _body(ast.parse(source), line) or ast.parse(source).body
    kept = (ast.Expr, ast.ImportFrom)  # docstring and __future__
    after = next((node for node in body if not isinstance(node, kept)), body[-1])
    decorators = getattr(after, "decorator_list", [])
    first = min(node.lineno for node in (after, *decorators))
    lines = source.splitlines()
    lines.insert(first - 1, " " * after.col_offset + 'raise RuntimeError("planted")')
    return "\n".join(lines) + "\n"


def reach(source: str, line: int) -> int:
    """Return the lines of which a test must run one to see a change, as bits of a number.

    They are those of the statement, without what it holds; of the function's body where it is the
    head of one; of all functions where it stands in none.
    """
    tree = ast.parse(source)
    body = _body(tree, line)
    if body is not None:
        statement = _innermost(body, line)
        if not isinstance(statement, ast.FunctionDef):
            return bits(range(statement.lineno, _head_end(statement) + 1))
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    heads = [node for node in functions if node.lineno <= line < node.body[0].lineno]
    return bits(k for node in heads or functions for k in _inside(node))


def bits(lines: Iterable[int]) -> int:
    """Write lines as bits of a number."""
    return sum(1 << line for line in set(lines))


def _inside(node: ast.FunctionDef) -> range:
    return range(node.body[0].lineno, (node.end_lineno or node.lineno) + 1)


def _body(tree: ast.AST, line: int) -> list[ast.stmt] | None:
    """Return the body of the innermost function that holds a line in it."""
    functions = (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))
    holding = [node for node in functions if line in _inside(node)]
    return max(holding, key=lambda node: node.lineno).body if holding else None


def _innermost(body: list[ast.stmt], line: int) -> ast.stmt:
    nodes = (node for statement in body for node in ast.walk(statement))
    statements = (node for node in nodes if isinstance(node, ast.stmt))
    inside = [node for node in statements if node.lineno <= line <= (node.end_lineno or 0)]
    return max(inside, key=lambda node: node.lineno)


def _head_end(node: ast.stmt) -> int:
    inner = getattr(node, "body", None)
    return inner[0].lineno - 1 if inner else (node.end_lineno or node.lineno)
