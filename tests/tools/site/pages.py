"""Collect the pages of the documentation site: READMEs, notebooks, and the public names.

``python -m tests.tools.site.pages FOLDER`` writes them for Sphinx. Pages keep their paths in the
repository, so that links between them hold. A linked source file becomes a page with its text, a
folder is its README; formulas become MathML, which needs no script.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import lmshealth

ROOT = Path(__file__).parents[3]
EXECUTED = ROOT / "demo" / "notebooks"
SOURCES = {".py": "python", ".toml": "toml", ".yml": "yaml", ".bib": "text"}
NAV = {
    "Tutorials": {
        "Notebooks": "studies/notebooks/README",
        "First look at a machine": "studies/notebooks/first_look",
        "A machine of my own": "studies/notebooks/own_machine",
        "A new machine, from drawing to remaining life": "studies/notebooks/new_machine/README",
        "A fleet": "studies/notebooks/fleet",
        "A frequency response": "studies/notebooks/frf",
        "When assumptions fail": "studies/notebooks/off_model",
    },
    "How-to guides": {
        "Read the pages": "lmshealth/report/README",
        "Read own files": "lmshealth/io/README",
        "Describe a machine": "lmshealth/stage/README",
        "Analyse archives": "lmshealth/batch/README",
        "Operate for years": "lmshealth/batch/OPERATING",
        "Simulate machines": "models/README",
        "Contribute": ".github/CONTRIBUTING",
    },
    "Reference": {
        "Commands": "lmshealth/cli/README",
        "Refusals: cause and cure": "lmshealth/report/REFUSALS",
        "Columns of tables": "lmshealth/report/TABLES",
        "Python": "reference/python",
        "Conventions and glossary": "lmshealth/README",
        "Changelog": "CHANGELOG",
    },
    "Explanation": {
        "Checks of samples": "lmshealth/io/CHECKS",
        "Signals": "lmshealth/signal/README",
        "Modes": "lmshealth/modal/README",
        "Ambient modes": "lmshealth/modal/ambient/README",
        "Excited modes": "lmshealth/modal/deterministic/README",
        "Tracking": "lmshealth/tracking/README",
        "Life": "lmshealth/life/README",
        "Posterior of a life": "lmshealth/life/posterior/README",
        "Service and next step": "lmshealth/machine/README",
        "Decisions of the design": "lmshealth/DECISIONS",
        "Evidence": "studies/README",
    },
}
SHOWN = {page for pages in NAV.values() for page in pages.values()}
HOME = Path("README.md")
LINK = re.compile(r"(!?\[(?:[^\[\]]|\[[^\]]*\])*\])\(([^()\s#]*)(#[^()\s]*)?\)")
BLOCK = re.compile(r"(?ms)(^ *```.*?^ *```)")
FORMULA = re.compile(r"(?<![\\$\w])\$(?=\S)([^$\n]+?)(?<=\S)\$(?![\w$])")


def main(folder: Path) -> None:
    """Write all pages, and the files that they link to."""
    shutil.rmtree(folder, ignore_errors=True)
    for path in tracked("*.md"):
        if "ISSUE_TEMPLATE" not in path.parts and path.name != "pull_request_template.md":
            write(folder, path, (ROOT / path).read_text(encoding="utf-8"))
    for path in tracked("studies/notebooks/*.py"):
        notebook(folder, path)
    write(folder, Path("reference/python.md"), "\n".join(reference()))


def tracked(pattern: str) -> list[Path]:
    """Return the files of the repository that match a pattern, of a folder without subfolders."""
    command = ["git", "ls-files", "--", f":(glob){pattern}" if "/" in pattern else pattern]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return [Path(name) for name in listed.stdout.splitlines()]


def write(folder: Path, path: Path, text: str) -> None:
    """Write a page; the home page lists the others, and those that it does not list are orphans."""
    parts = BLOCK.split(text)
    parts[::2] = [LINK.sub(lambda one: target(folder, path, one), part) for part in parts[::2]]
    text = formulas(parts)
    if path == HOME:
        text += "".join(contents())
    elif path.with_suffix("").as_posix() not in SHOWN:
        text = f"---\norphan: true\n---\n\n{text}"
    put(folder / ("index.md" if path == HOME else path), text.encode())


def put(path: Path, content: bytes) -> None:
    """Write a file and its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def contents() -> Iterator[str]:
    """Yield the contents of the site, hidden on the home page."""
    for caption, pages in NAV.items():
        lines = "\n".join(f"{title} <{page}>" for title, page in pages.items())
        yield f"\n```{{toctree}}\n:caption: {caption}\n:hidden:\n\n{lines}\n```\n"


def target(folder: Path, path: Path, found: re.Match[str]) -> str:
    """Return a link of a page as the site has it; one to a folder without a README is its text."""
    text, address, anchor = found.groups(default="")
    if re.match(r"\w+:|#|$", address):
        return found[0]
    there = (ROOT / path.parent / address).resolve()
    if there.is_dir() and not (there / "README.md").exists():
        return text.strip("[]")
    if there.is_dir():
        address, there = f"{address.rstrip('/')}/README.md", there / "README.md"
    if there == ROOT / HOME:
        return f"{text}({address.removesuffix('README.md')}index.md{anchor})"
    if there.suffix == ".md" or not there.is_file():
        return f"{text}({address}{anchor})"  # the strict build fails where there is none
    here = there.relative_to(ROOT)
    if here.match("studies/notebooks/*.py"):
        return f"{text}({address.removesuffix('.py')}.md{anchor})"
    if here.suffix not in SOURCES:
        put(folder / here, there.read_bytes())
        return found[0]
    code = f"````{SOURCES[here.suffix]}\n{there.read_text(encoding='utf-8')}````\n"
    page = f"---\norphan: true\n---\n\n# {here.as_posix()}\n\n{code}"
    put(folder / f"{here.as_posix()}.md", page.encode())
    return f"{text}({address}.md)"


def formulas(parts: list[str]) -> str:
    """Join texts and blocks of code in turn; formulas become MathML."""
    from latex2mathml.converter import convert

    for k, part in enumerate(parts):
        if k % 2 == 0:
            plain = re.split(r"(`[^`\n]+`)", part)
            plain[::2] = [FORMULA.sub(lambda one: convert(one[1]), one) for one in plain[::2]]
            parts[k] = "".join(plain)
        elif part.lstrip().startswith("```math"):
            indent = part[: part.index("`")]
            formula = part.strip().removeprefix("```math").removesuffix("```").strip()
            parts[k] = f"{indent}{convert(formula, display='block')}"
    return "".join(parts)


def notebook(folder: Path, path: Path) -> None:
    """Write a notebook as a page, executed by `make notebooks` where that has been run."""
    import jupytext
    import nbformat
    from nbconvert import MarkdownExporter

    executed = EXECUTED / f"{path.stem}.ipynb"
    if executed.exists():
        cells = nbformat.read(executed, as_version=4)
    else:
        cells = jupytext.read(ROOT / path)
    text, resources = MarkdownExporter().from_notebook_node(cells)
    for name, content in resources["outputs"].items():
        own = f"{path.stem}_files/{name}"
        text = text.replace(f"]({name})", f"]({own})")
        put(folder / path.parent / own, content)
    parts = BLOCK.split(text)
    page = path.with_suffix(".md")
    parts[::2] = [
        LINK.sub(lambda one: one[0] if "_files/" in one[2] else target(folder, page, one), part)
        for part in parts[::2]
    ]
    put(folder / page, "".join(parts).encode())


def reference() -> Iterator[str]:
    """Yield the page of all public names, by the folder of the method."""
    yield from ("# Python", "", "Public names of `import lmshealth`, with an example each.")
    groups: dict[str, list[str]] = {}
    for name in sorted(lmshealth.__all__, key=str.casefold):
        groups.setdefault(home(name).split(".")[1], []).append(name)
    for group, names in groups.items():
        yield from ("", f"## {group}")
        for name in names:
            kind = "autoclass" if isinstance(getattr(lmshealth, name), type) else "autofunction"
            yield from ("", f"### {name}", "", "```{eval-rst}")
            yield from (f".. {kind}:: {home(name)}.{name}", "```")


def home(name: str) -> str:
    """Return the module of a public name."""
    return str(getattr(import_module("lmshealth"), name).__module__)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
