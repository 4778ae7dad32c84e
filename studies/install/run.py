"""What do installation, import and `lmshealth --help` cost?

Method
    `pip install` of a copy of the project without extras into a fresh virtual environment; sizes
    of the files of each distribution and of their compiled forms. Processor times of fresh
    interpreters less that of an idle one, after a first turn that fills the disk cache; programs
    take turns, the least of each counts, and the median of the ratios to `import numpy, scipy,
    pandas`. Required: `import lmshealth` in 1.5 s.
Answer
    Met: 0.08 s, a seventh of numpy, scipy and pandas, because names are imported at first use;
    help takes 0.35 s, 0.6 times these; all names together 3.3 s, 5.3 times these (on a busy
    machine). An installation takes 508 MB in 34 distributions: scipy, pandas and numpy 295 MB,
    lmshealth 3.7 MB.
Run time
    Some minutes, mostly installation.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import venv
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from studies.harness.claims import Claim, number
from studies.harness.study import Row, Study

STEP = "batch"

ROOT = Path(__file__).parents[2]
SOURCES = ("pyproject.toml", "README.md", "LICENSE")
BARE, OURS, ALL, HELP = "import numpy, scipy, pandas", "import lmshealth", "all names", "--help"
PROGRAMS = {
    "nothing": ("-c", "pass"),
    BARE: ("-c", BARE),
    OURS: ("-c", OURS),
    ALL: ("-c", "from lmshealth import *"),
    HELP: ("-m", "lmshealth", "--help"),
}
IMPORT_S = 1.5
LARGEST = 12
# Run inside the new environment: bytes of every distribution.
_SIZES = """
import json
from importlib.metadata import distributions
sizes = {}
for one in distributions():
    places = {path.locate().resolve() for path in one.files or ()}
    sizes[one.name] = sum(place.stat().st_size for place in places if place.is_file())
print(json.dumps(sizes))
"""


def main() -> None:
    """Run the study; ``--quick`` measures once what is installed already, and records nothing."""
    study = Study(__file__, __doc__)
    answer: Row = {}
    if study.quick:
        answer["start"] = started(Path(sys.executable), ROOT, turns=1, warm=False)
    else:
        with tempfile.TemporaryDirectory() as name:
            python = installed(Path(name))
            answer["size"] = sizes(python, Path(name) / "venv")
            answer["start"] = started(python, Path(name), turns=11)
    start = answer["start"]
    answer["passed"] = {
        f"import in {IMPORT_S:g} s": start["cpu_s"][OURS] <= IMPORT_S,
        "import takes less than that of numpy, scipy and pandas": start["times_bare"][OURS] < 1,
        "so does help": start["times_bare"][HELP] < 1,
    }
    study.conclude(answer)


def installed(folder: Path) -> Path:
    """Install a copy of the project into a new environment, and give its interpreter."""
    source = folder / "source"
    source.mkdir()
    for name in SOURCES:
        shutil.copy(ROOT / name, source / name)
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "lmshealth", source / "lmshealth", ignore=ignored)
    venv.create(folder / "venv", with_pip=True)
    python = folder / "venv" / "bin" / "python"
    command = [python, "-m", "pip", "install", "--quiet", str(source)]
    subprocess.run(command, check=True, cwd=folder)
    return python


def sizes(python: Path, environment: Path) -> Row:
    """Return the megabytes of an environment, and of its largest distributions."""
    done = subprocess.run([python, "-c", _SIZES], check=True, capture_output=True, text=True)
    found = {name: size / 1e6 for name, size in json.loads(done.stdout).items()}
    found.pop("pip", None)
    largest = sorted(found, key=lambda name: -found[name])
    files = [path for path in environment.rglob("*") if path.is_file()]
    return {
        "environment_mb": round(sum(path.lstat().st_size for path in files) / 1e6, 1),
        "distributions_mb": round(sum(found.values()), 1),
        "distributions": len(found),
        "lmshealth_mb": round(found["lmshealth"], 2),
        "largest_mb": {name: round(found[name], 1) for name in largest[:LARGEST]},
    }


def started(python: Path, folder: Path, turns: int, *, warm: bool = True) -> Row:
    """Measure what fresh interpreters take, in turns, the first of which may count for nothing."""
    rounds = [
        {name: spent(python, words, folder) for name, words in PROGRAMS.items()}
        for _ in range(turns + warm)
    ][warm:]
    names = [name for name in PROGRAMS if name != "nothing"]
    own = {name: np.array([one[name] - one["nothing"] for one in rounds]) for name in names}
    return {
        "turns": turns,
        "cpu_s": {name: round(float(times.min()), 3) for name, times in own.items()},
        "times_bare": {
            name: round(float(np.median(times / own[BARE])), 3) for name, times in own.items()
        },
    }


def spent(python: Path, words: tuple[str, ...], folder: Path) -> float:
    """Processor time in s of one interpreter."""
    import resource  # POSIX

    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([python, *words], check=True, capture_output=True, cwd=folder)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def claims(answer: Row) -> Iterator[Claim]:
    """Claim what the package costs before it does anything."""
    start, size, passed = answer["start"], answer["size"], answer["passed"]
    own, bare = start["cpu_s"]["import lmshealth"], start["cpu_s"]["import numpy, scipy, pandas"]
    yield Claim(
        "import lmshealth, processor time",
        f"{number(own)} s",
        f"least of {start['turns']} turns",
        f"1.5 s required; numpy, scipy and pandas {number(bare)} s",
        passed["import in 1.5 s"],
    )
    yield Claim(
        "lmshealth --help, over the import of numpy, scipy and pandas",
        f"{number(start['times_bare']['--help'])} times",
        f"median of {start['turns']} turns",
        "less than once required",
        passed["so does help"],
    )
    yield Claim(
        "megabytes installed, of all distributions",
        number(size["distributions_mb"]),
        "",
        f"lmshealth itself {number(size['lmshealth_mb'])}",
    )


if __name__ == "__main__":
    main()
