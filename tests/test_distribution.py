"""What is distributed: the wheel holds the whole package, and dependencies have known licences."""

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Callable
from importlib.metadata import Distribution, distribution, distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from studies.cost.installation import needed

ROOT = Path(__file__).parents[1]
# Extras that people install to use the package; `peers` and `dev` stay with who develops it.
EXTRAS = ("models", "formats", "pdf", "postgres", "notify", "distributed")
PERMISSIVE = re.compile(
    r"0BSD|Apache|BSD|CC0|HPND|ISC|MIT|PSF|Python[- ](2|Software)|Unlicense|Zlib|MPL|Mozilla"
)
STRONG_COPYLEFT = re.compile(r"(?<![A-Z])A?GPL")
# Libraries that are imported and not changed, in extras only.
WEAK_COPYLEFT = {"nptdms", "psycopg", "psycopg-binary", "pyphen"}


def _first(one: Distribution, field: str) -> str:
    return (one.metadata.get_all(field) or [""])[0]


def licence(one: Distribution) -> str:
    """Return the licence that a distribution states: as expression, classifiers or first line."""
    stated = _first(one, "License-Expression")
    classifiers = one.metadata.get_all("Classifier") or ()
    stated = stated or " ".join(c for c in classifiers if c.startswith("License ::"))
    return stated or _first(one, "License").strip().partition("\n")[0]


def refused(licences: dict[str, str]) -> dict[str, str]:
    """Return the distributions whose licence is neither permissive nor known."""
    return {
        name: text
        for name, text in licences.items()
        if name not in WEAK_COPYLEFT
        and (not PERMISSIVE.search(text) or STRONG_COPYLEFT.search(text))
    }


def test_licences_of_dependencies() -> None:
    """All dependencies have a permissive licence, or are named; a strong copyleft is refused."""
    there: dict[str, Distribution] = {canonicalize_name(one.name): one for one in distributions()}
    found = needed(there, "lmshealth", {*EXTRAS}) - {"lmshealth"}
    assert {"numpy", "scipy", "pandas", "emcee", "filterpy", "jinja2"} <= found
    licences = {name: licence(there[name]) for name in found}
    unstated = {"partd"}  # its licence is a file: BSD-3-Clause
    assert not refused({k: v for k, v in licences.items() if k not in unstated})
    strange = {"other": "GPL-3.0-or-later", "both": "MIT AND AGPL-3.0", "none": ""}
    assert refused(strange) == strange


def test_core_has_no_copyleft() -> None:
    """Without extras nothing is under any copyleft but MPL."""
    there: dict[str, Distribution] = {canonicalize_name(one.name): one for one in distributions()}
    assert not WEAK_COPYLEFT & needed(there, "lmshealth")


def wrong_versions(version: str, changelog: str, tags: list[str]) -> list[str]:
    """Return which places of a release state another version; clones may have no tags."""
    headings = re.findall(r"^## (\S+)", changelog, re.M)
    wrong = [] if version in headings else [f"CHANGELOG.md: {headings}"]
    return wrong + [tag for tag in tags if tag.startswith("v") and tag != f"v{version}"]


def test_a_release_states_one_version() -> None:
    """Project file, changelog and a tag of this commit agree."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    changelog = (ROOT / "CHANGELOG.md").read_text()
    command = ["git", "tag", "--points-at", "HEAD"]
    tags = ""
    if shutil.which("git"):
        tags = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout
    assert not wrong_versions(version, changelog, tags.split())
    assert len(wrong_versions("9.9", changelog, ["v0.1.0"])) == 2


def test_lock_holds_what_is_declared() -> None:
    """The lock file for development has every direct dependency, with hashes and no address."""
    text = (ROOT / "tests" / "requirements.lock").read_text()
    locked = {canonicalize_name(name) for name in re.findall(r"^([\w.\-]+)==", text, re.M)}
    requirements = map(Requirement, distribution("lmshealth").requires or ())
    direct = {
        canonicalize_name(r.name)
        for r in requirements
        if not r.marker or any(r.marker.evaluate({"extra": e}) for e in (*EXTRAS, "dev", ""))
    }
    assert direct - locked == {"lmshealth"} & direct
    assert text.count("--hash=sha256:") >= len(locked)
    assert "://" not in text


@pytest.mark.slow
def test_wheel_works_on_its_own(tmp_path: Path, needs: Callable[[str], None]) -> None:
    """A wheel built from the sdist has all modules and data, and its program runs elsewhere."""
    needs("git")
    source = tmp_path / "source"
    tracked = subprocess.run(
        ["git", "ls-files", "lmshealth", "pyproject.toml", "README.md", "LICENSE"],
        cwd=ROOT, check=True, capture_output=True, text=True,
    ).stdout.split()  # fmt: skip
    for name in tracked:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, source / name)
    built = tmp_path / "built"
    # Without a format both are built: the sdist, and the wheel from it.
    subprocess.run(
        [sys.executable, "-m", "build", "--outdir", built, source], check=True, capture_output=True
    )
    (wheel,) = built.glob("*.whl")
    assert list(built.glob("*.tar.gz"))
    inside = set(zipfile.ZipFile(wheel).namelist())
    expected = {n for n in tracked if n.startswith("lmshealth/") and not n.endswith(".md")}
    assert expected <= inside
    assert not [n for n in inside if n.split("/")[0] in ("models", "tests", "studies")]

    place = tmp_path / "installed"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(place)
    libraries = Path(pytest.__file__).parents[1]
    program = "import lmshealth.cli.main as m, sys; print(m.__file__); m.main()"
    answer = subprocess.run(
        [sys.executable, "-I", "-c", f"import sys; sys.path[:0] = [{str(place)!r}]; {program}",
         "stage", "lms-y"],
        cwd=tmp_path, check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    assert str(libraries) not in answer.splitlines()[0]
    assert answer.startswith(str(place))
    assert "guide_preload" in answer
