"""By which code, and on which machine, a trial of a study is done."""

from __future__ import annotations

import ast
import hashlib
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from functools import cache, partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

PROJECT = Path(__file__).parents[2]
_PACKAGES = ("lmshealth", "models", "studies")
_LIBRARIES = ("numpy", "scipy", "emcee")
_CODE = ("*.py", "*.toml", "*.csv")
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef)
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

    This is the function and what it needs of its own module, every module of the project that is
    imported for it, directly or not, all tables and descriptions of their packages, and the
    versions of libraries. Comments, docstrings and layout do not count.
    """
    return _digest(_script(work), bare(work).__qualname__, also)


def code_of_script(script: Path, also: Iterable[str] = ()) -> str:
    """Digest the code that the function ``main`` of a script depends on, as `code_of`."""
    return _digest(script.resolve(), "main", tuple(sorted(also)))


def _script(work: Callable[..., Any]) -> Path:
    return Path(sys.modules[bare(work).__module__].__file__ or "").resolve()


@cache
def _digest(path: Path, name: str, also: tuple[str, ...]) -> str:
    needed = _reached(_tree(path), {name.split(".")[0]})
    total = hashlib.sha256(" ".join(version(library) for library in _LIBRARIES).encode())
    total.update("".join(ast.dump(statement) for statement in needed).encode())
    roots = _imports(needed) | {_file(module.split(".")) for module in also}
    modules = sorted(_closure({root for root in roots if root is not None}))
    for module in modules:
        total.update(module.relative_to(PROJECT).as_posix().encode())
        total.update(_content(module))
    # Of the packages whose code it runs.
    used = {module.relative_to(PROJECT).parts[0] for module in modules}
    for package in sorted(used & {"lmshealth", "models"}):
        for table in sorted((PROJECT / package).rglob("*")):
            if table.suffix in (".toml", ".csv"):
                total.update(table.name.encode() + table.read_bytes())
    return total.hexdigest()[:16]


@cache
def _tree(path: Path) -> ast.Module:
    """Parse a module without its docstrings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, _DOCUMENTED) and ast.get_docstring(node):
            del node.body[0]
    return tree


@cache
def _content(path: Path) -> bytes:
    return ast.dump(_tree(path)).encode()


def _reached(tree: ast.Module, names: set[str]) -> list[ast.stmt]:
    """Return the statements of a module that define names, and what these need in turn."""
    wanted, left = set(names), list(tree.body)
    while more := [statement for statement in left if _defined(statement) & wanted]:
        left = [statement for statement in left if statement not in more]
        wanted |= {node.id for s in more for node in ast.walk(s) if isinstance(node, ast.Name)}
    return [statement for statement in tree.body if statement not in left]


def _defined(statement: ast.stmt) -> set[str]:
    if isinstance(statement, ast.Import | ast.ImportFrom):
        return {(alias.asname or alias.name).split(".")[0] for alias in statement.names}
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return {statement.name}
    return {
        node.id
        for node in ast.walk(statement)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    }


def _closure(roots: set[Path]) -> set[Path]:
    """Return modules and all that they import of the project."""
    found: set[Path] = set()
    left = set(roots)
    while left:
        module = left.pop()
        found.add(module)
        # Who imports from a package has all of it that it begins with.
        begun = {module.parent / "__init__.py"} - {_GATHERING}
        left |= {path for path in begun if path.exists()} | _imported(module)
        left -= found
    return found


@cache
def _imported(path: Path) -> set[Path]:
    return _imports(_tree(path).body)


def _imports(statements: Iterable[ast.stmt]) -> set[Path]:
    """Return the modules of the project that statements import, at the top or within functions."""
    found: set[Path | None] = set()
    for node in (node for statement in statements for node in ast.walk(statement)):
        if isinstance(node, ast.Import):
            found |= {_file(alias.name.split(".")) for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            package = (node.module or "").split(".")
            found |= {_source(package, alias.name) for alias in node.names}
    return {path for path in found if path is not None}


def _source(package: list[str], name: str) -> Path | None:
    """Return where a name comes from: a module of its own, or one that has it or gathers it."""
    path = _file([*package, name]) or _file(package)
    if path == _GATHERING:
        home = getattr(getattr(import_module(package[0]), name, None), "__module__", package[0])
        path = _file(home.split("."))
    return path


def _file(parts: list[str]) -> Path | None:
    """Find a module of the project; None for others."""
    if parts[0] not in _PACKAGES:
        return None
    path = PROJECT.joinpath(*parts)
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.exists()), None)
