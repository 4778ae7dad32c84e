"""By which code, and on which machine, a trial of a study is done."""

from __future__ import annotations

import ast
import hashlib
import os
import platform
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property, partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

PROJECT = Path(__file__).parents[2]
_PACKAGES = ("lmshealth", "models", "studies")
_LIBRARIES = ("numpy", "scipy", "emcee")
_CODE = ("*.py", "*.toml", "*.csv")
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef)
_HERE = Path(__file__).resolve()
# A part of a module is a name of it, all of it, or what runs when it is imported.
_Part = tuple[Path, str]
_Origins = dict[str, tuple[str, _Part | None]]
_Needs = dict[str, _Part]  # parts by the names that code has for them


@dataclass(eq=False)
class _Statement:
    """The code of a statement, and the parts that it needs."""

    code: str
    needs: _Needs

    @cached_property
    def defined(self) -> str:
        """Return the code with the definitions of the names in it."""
        uses = (f"{name}={_definition(own)}" for name, own in self.needs.items())
        return " ".join([self.code, *sorted(uses)])


_ALL, _RUN = "*", ""
_MAIN = ast.unparse(ast.parse('__name__ == "__main__"'))
_PROGRAMS = ("lmshealth/cli/*.py", "models/__main__.py")
# Decorators that hand a function to nobody.
_HARMLESS = {"cache", "contextmanager", "dataclass", "lru_cache", "overload"}
# Those that change run times alone.
_NO_VALUE = {"one_thread"}
# Reasons why a figure is not met: no value depends on them.
_WORDS = {"NOT_MET"}
# The package itself gathers names of all its modules: of it a trial needs those that it names.
_GATHERING = PROJECT / "lmshealth" / "__init__.py"


def commit() -> str:
    """Return the commit of the code, with a plus if it has changed since; empty without git."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(PROJECT), *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        return done.stdout.strip() if done.returncode == 0 else ""

    changed = git("status", "--porcelain", "--", *_CODE)
    return git("rev-parse", "--short=10", "HEAD") + ("+" if changed else "")


def machine() -> str:
    """Name the system, its processor and the number of these, without the name of the host."""
    info = Path("/proc/cpuinfo")
    text = info.read_text(encoding="utf-8") if info.exists() else ""
    model = re.search(r"^model name\s*: (.+)$", text, re.MULTILINE)
    name = model[1] if model else platform.processor() or platform.machine()
    return f"{platform.system()}, {os.cpu_count()} of {name}"


def bare(work: Callable[..., Any]) -> Any:
    """Return the function of which a work is a part."""
    return bare(work.func) if isinstance(work, partial) else work


def name_of(work: Callable[..., Any]) -> str:
    """Name a work by its file, its function, and the options that it is given."""
    given = work.keywords if isinstance(work, partial) else {}
    simple = {k: v for k, v in given.items() if isinstance(v, str | int | float | None)}
    return f"{_script(work).stem}.{bare(work).__qualname__}" + (str(simple) if simple else "")


def code_of(work: Callable[..., Any], also: tuple[str, ...] = ()) -> str:
    """Digest the code that a work depends on.

    This is the function with the functions, classes and constants of the project that it names,
    directly or not, what modules run when they are imported for it, the tables and descriptions
    whose file or folder this code names, and the versions of libraries. Comments, docstrings,
    layout, threads, code that it does not reach, and the module in which a definition stands do
    not count; which definition a name has does.
    """
    return _digest(_script(work), bare(work).__qualname__, also)


def code_of_script(script: Path, also: Iterable[str] = ()) -> str:
    """Digest the code that the function ``main`` of a script depends on, as `code_of`."""
    return _digest(script.resolve(), "main", tuple(sorted(also)))


def _script(work: Callable[..., Any]) -> Path:
    return Path(sys.modules[bare(work).__module__].__file__ or "").resolve()


@cache
def _digest(path: Path, name: str, also: tuple[str, ...]) -> str:
    files = (_file(*module.split(".")) for module in also)
    needed = _needed({(path, name)} | {(file, _ALL) for file in files if file is not None})
    total = hashlib.sha256(" ".join(version(library) for library in _LIBRARIES).encode())
    code = "".join(sorted(set().union(*needed.values())))
    total.update(code.encode())
    for part in _tables(code):
        total.update(part)
    return total.hexdigest()[:16]


def _tables(code: str) -> Iterator[bytes]:
    """Yield names and contents of the tables whose file or folder code names.

    Of those of the program only the sections whose attribute is read.
    """
    for package in ("lmshealth", "models"):
        for table in sorted((PROJECT / package).rglob("*")):
            named = f"'{table.name}'" in code or f"'{table.parent.name}'" in code
            if table.suffix not in (".toml", ".csv") or not named:
                continue
            yield table.name.encode()
            for section in re.split(rb"(?m)^(?=\[)", table.read_bytes()):
                key = re.match(rb"\[(\w+)", section)
                if table.name != "tables.toml" or not key or f"attr='{key[1].decode()}'" in code:
                    yield section


@cache
def _tree(path: Path) -> ast.Module:
    """Parse a module without its docstrings, those of constants too."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, _DOCUMENTED):
            node.body = [one for one in node.body if not _is_text(one)]
        if isinstance(node, ast.FunctionDef):
            kept = [one for one in node.decorator_list if ast.unparse(one) not in _NO_VALUE]
            node.decorator_list = kept
    return tree


def _is_text(statement: ast.stmt) -> bool:
    value = statement.value if isinstance(statement, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)


def _needed(parts: set[_Part]) -> dict[Path, set[str]]:
    """Return, by module, the code that parts of modules need of the project.

    With each statement is what the names in it are.
    """
    found = dict[Path, set[str]]()
    for module, statement in _reached(parts):
        meanings = (f"{name}={_meaning(part)}" for name, part in statement.needs.items())
        found.setdefault(module, set()).add(" ".join([statement.code, *sorted(meanings)]))
    return found


def _reached(parts: set[_Part], *, imports: bool = True) -> Iterator[tuple[Path, _Statement]]:
    """Yield the statements that parts of modules need, directly or not, each with its module.

    With imports what runs when the modules are imported is among them.
    """
    seen, left = set[_Part](), list(parts)
    while left:
        module, name = part = left.pop()
        # Names that the package gathers count in their own modules. This module records by which
        # code a value was computed, and computes none.
        if part in seen or part == (_GATHERING, _RUN) or module == _HERE or not _exists(module):
            continue
        seen.add(part)
        if name in _WORDS:
            continue
        if imports:
            # Whoever imports from a package runs all that it begins with, and what this imports.
            left += [(module.parent / "__init__.py", _RUN), (module, _RUN)]
        for statement in _statements(module).get(name, ()):
            left += statement.needs.values()
            if statement.code:
                yield module, statement


@cache
def _exists(module: Path) -> bool:
    return module.exists()


@cache
def _meaning(part: _Part) -> str:
    """Return the digest of all code that a name depends on, wherever it is defined."""
    if part[1] in (_ALL, _RUN, *_WORDS):
        return ""
    rows = {statement.defined for _, statement in _reached({part}, imports=False)}
    return hashlib.sha256("".join(sorted(rows)).encode()).hexdigest()[:16]


@cache
def _definition(part: _Part) -> str:
    """Return the digest of the definition of a name alone."""
    module, name = part
    is_one = _exists(module) and name not in (_ALL, _RUN, *_WORDS)
    # A name that is imported is what its definition is.
    codes = sorted(
        one.code or "".join(map(_definition, one.needs.values()))
        for one in (_statements(module).get(name, ()) if is_one else ())
    )
    return hashlib.sha256("".join(codes).encode()).hexdigest()[:16]


@cache
def _statements(module: Path) -> dict[str, list[_Statement]]:
    """Return the statements of each name of a module."""
    found = defaultdict[str, list[_Statement]](list)
    origins = _origins(_tree(module).body)
    for name, (code, part) in origins.items():
        for one in (name, _ALL):
            found[one].append(_Statement(code, {name: part} if part else {}))
        # What a module registers when it is imported counts for whoever imports it.
        found[_RUN].append(_Statement("", {name: (part[0], _RUN)} if part else {}))
    for statement in _tree(module).body:
        test = ast.unparse(statement.test) if isinstance(statement, ast.If) else ""
        if isinstance(statement, ast.Import | ast.ImportFrom) or test == _MAIN:
            continue
        names = _defined(statement)
        if test != "TYPE_CHECKING" and (not names or _registers(statement)):
            names.add(_RUN)
        uses = _uses(module, statement, origins)
        # What a module makes of its own place or name is of that module.
        is_placed = uses.keys() & {"__file__", "__name__", "__package__"}
        place = f"{module.parent.name}/{module.name}" if is_placed else ""
        row = _Statement(_dump(statement) + place, uses)
        for name in {*names, _ALL}:
            found[name].append(row)
    return dict(found)


def _dump(statement: ast.stmt) -> str:
    """Return the code of a statement, without the modules of the project that it names."""
    own = [
        node
        for node in ast.walk(statement)
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in _PACKAGES
    ]
    modules = [node.module for node in own]
    for node in own:
        node.module = None
    code = ast.dump(statement)
    for node, module in zip(own, modules, strict=True):
        node.module = module
    return code


def _uses(module: Path, statement: ast.stmt, origins: _Origins) -> _Needs:
    """Return the parts that a statement needs; of an imported module those after its dot."""
    nodes = list(ast.walk(statement))
    inner = {name: part for name, (_, part) in _origins(nodes).items() if part}
    known = {name: part for name, (_, part) in origins.items() if part} | inner
    modules = {name: file for name, (file, of) in known.items() if of == _ALL}
    dotted = {
        id(node.value): (node.value.id, node.attr)
        for node in nodes
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id in modules
    }
    names = {node.id for node in nodes if isinstance(node, ast.Name) and id(node) not in dotted}
    needs = {name: (module, name) for name in names}
    needs |= {n: part for n, part in inner.items() if n in names or part[1] != _ALL}
    for name, attribute in dotted.values():
        if part := _source(_words(modules[name]), attribute):
            needs[f"{name}.{attribute}"] = part
    words = {node.value for node in nodes if isinstance(node, ast.Constant)}
    if "-m" in words:
        # A program is started, whose commands are imported by their names.
        programs = (file for pattern in _PROGRAMS for file in PROJECT.glob(pattern))
        needs |= {file.name: (file, _ALL) for file in programs}
    return needs


def _registers(statement: ast.stmt) -> bool:
    """Return whether a definition may be used by who does not name it: a decorator has it."""
    decorators = getattr(statement, "decorator_list", [])
    return not all(ast.unparse(one).split("(")[0] in _HARMLESS for one in decorators)


def _defined(statement: ast.stmt) -> set[str]:
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return {statement.name}
    return {
        node.id
        for node in ast.walk(statement)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    }


def _origins(nodes: Iterable[ast.AST]) -> _Origins:
    """Return what names are imported as: the part of the project, or the code of any other."""
    found: _Origins = {}
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                file = _file(*alias.name.split("."))
                part = (file, _ALL) if file else None
                code = "" if part else ast.dump(alias)
                found[alias.asname or alias.name.split(".")[0]] = code, part
        elif isinstance(node, ast.ImportFrom):
            package = (node.module or "").split(".")
            for alias in node.names:
                part = _source(package, alias.name)
                code = "" if part else f"{node.module} {ast.dump(alias)}"
                found[alias.asname or alias.name] = code, part
    return found


def _source(package: list[str], name: str) -> _Part | None:
    """Return what a name is: a module of its own, or a name of one that has it or gathers it."""
    if file := _file(*package, name):
        return file, _ALL
    path = _file(*package)
    if path == _GATHERING:
        home = getattr(getattr(import_module(package[0]), name, None), "__module__", package[0])
        path = _file(*home.split("."))
    return (path, name) if path else None


def _words(file: Path) -> list[str]:
    """Return the name of a module of the project, in its parts."""
    parts = list(file.relative_to(PROJECT).with_suffix("").parts)
    return parts[:-1] if parts[-1] == "__init__" else parts


@cache
def _file(*parts: str) -> Path | None:
    """Find a module of the project; None for others."""
    if parts[0] not in _PACKAGES:
        return None
    path = PROJECT.joinpath(*parts)
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.exists()), None)
