"""How large is a plain installation, and of what?

Method
    `pip install` of a copy of the project into a fresh virtual environment, with control, and, for
    the negative control, with the extra that has pyarrow. Size is that of the files that each
    distribution lists, in MB of 10⁶ bytes, with the byte code that pip compiles and without
    (`pip install --no-compile`). A plain installation is the package with all that it requires, its
    core the libraries that the user asked for, with what these require; pip does not count.
Run time
    A minute, most of it the installation.
"""

from __future__ import annotations

import shutil
import subprocess
import sysconfig
import tempfile
import venv
from collections.abc import Collection, Iterator, Mapping
from importlib.metadata import Distribution, distributions
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from studies.harness.checkout import ROOT
from studies.harness.claims import Claim, number
from studies.harness.study import Row, Study

Installed = Mapping[str, Distribution]

CORE = ("numpy", "scipy", "pandas", "emcee", "filterpy", "control")
MOST_MB, MOST_OVER_CORE = 350.0, 1.25
LARGEST = 8  # distributions beyond the core that are recorded
KEYS = "mb", "bare_mb"  # with and without byte code
NOT_MET = {"as pip installs": "the core with its byte code takes more by itself"}


def main() -> None:
    """Run the study; ``--quick`` measures what is installed already, and records nothing."""
    study = Study(__file__, __doc__)
    answer = measured(sysconfig.get_path("purelib")) if study.quick else installed()
    whole, core = answer["whole"], answer["core"]
    passed = {
        "as pip installs": whole["mb"] <= MOST_MB,
        "without byte code": whole["bare_mb"] <= MOST_MB,
        "little beyond": core["mb"] < whole["mb"] <= MOST_OVER_CORE * core["mb"],
        "with pyarrow it is beyond": answer["control"]["bare_mb"] > MOST_MB,
    }
    study.conclude(answer | {"passed": passed}, not_met=NOT_MET)


def installed() -> Row:
    """Install a copy of the project into a new environment, and measure it."""
    with tempfile.TemporaryDirectory() as name:
        source, environment = Path(name) / "source", Path(name) / "environment"
        shutil.copytree(ROOT / "lmshealth", source / "lmshealth")
        for file in ("pyproject.toml", "README.md", "LICENSE"):
            shutil.copy(ROOT / file, source)
        venv.create(environment, with_pip=True)
        pip: list[str | Path] = [environment / "bin" / "python", "-m", "pip", "install", "--quiet"]
        subprocess.run([*pip, f"{source}[formats]", "control"], check=True)
        return measured(next(environment.glob("lib/*/site-packages")))


def measured(site: str | Path) -> Row:
    """Return the MB of distributions that are installed in a folder, by part."""
    there = {str(canonicalize_name(one.name)): one for one in distributions(path=[str(site)])}
    whole, control = needed(there, "lmshealth"), needed(there, "lmshealth", {"formats"})
    core = set().union(*(needed(there, name) for name in CORE))
    sizes = {name: size(there[name]) for name in core | control}
    beyond = sorted(whole - core, key=lambda name: -sizes[name][0])[:LARGEST]
    parts = {"core": core, "whole": whole, "control": control} | {name: {name} for name in beyond}
    return {
        part: {key: round(sum(sizes[name][k] for name in own), 1) for k, key in enumerate(KEYS)}
        for part, own in parts.items()
    }


def needed(there: Installed, name: str, extras: Collection[str] = ()) -> set[str]:
    """Return the names of a distribution and of all that it requires, of those that are there."""
    found, to_do = set[str](), [(name, extras)]
    while to_do:
        name, extras = to_do.pop()
        found.add(name)
        for one in map(Requirement, there[name].requires or ()):
            other, places = canonicalize_name(one.name), [{"extra": own} for own in ("", *extras)]
            holds = one.marker is None or any(map(one.marker.evaluate, places))
            if holds and other in there.keys() - found:
                to_do.append((other, one.extras))
    return found


def size(one: Distribution) -> tuple[float, float]:
    """Return the MB of the files of a distribution, and without byte code."""
    files = [Path(str(one.locate_file(file))) for file in one.files or ()]
    sizes = {file: file.stat().st_size / 1e6 for file in files if file.exists()}
    return sum(sizes.values()), sum(n for file, n in sizes.items() if file.suffix != ".pyc")


def claims(record: Row) -> Iterator[Claim]:
    """Claim the size with and without byte code, and how it compares with that of the core."""
    passed, whole, core = record["passed"], record["whole"], record["core"]
    for check, key in zip(("as pip installs", "without byte code"), KEYS, strict=True):
        more = number(record["control"][key])
        beside = f"at most {MOST_MB:g} MB required; core {number(core[key])}, with pyarrow {more}"
        mb = f"{number(whole[key])} MB"
        yield Claim(f"a plain installation, {check}", mb, "", beside, passed[check])
    parts = {name: own["mb"] for name, own in record.items() if "mb" in own and own["mb"] < 100}
    beside = ", ".join(f"{name} {number(mb)} MB" for name, mb in parts.items())
    times = f"{number(whole['mb'] / core['mb'])} times"
    beside = f"at most {MOST_OVER_CORE:g}; beyond the core {beside}"
    yield Claim("a plain installation over its core", times, "", beside, passed["little beyond"])


if __name__ == "__main__":
    main()
