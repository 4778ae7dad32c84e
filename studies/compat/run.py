"""Do the tests pass on other Pythons, dependencies, kernels and numbers of threads?

Method
    The fast tests of reading, spectra, identification of ambient modes and tracking, once for each
    case that this machine has. Other Pythons (from the path or a pyenv) get an environment with the
    newest and one with the lowest declared dependencies, if these can be installed without a
    compiler. `OPENBLAS_CORETYPE` selects kernels that other processors have. Tests that hold
    numbers to tolerances are the same in all cases. Control, which must fail: a scipy whose
    Fourier transforms are 1 % too large.
Answer
    Yes: ten cases of 1,492 tests: three kernels, two threads, Python 3.11 to 3.13 with the newest
    and the lowest dependencies. The first run found a MAT reader that fails with the newest scipy,
    and three lower bounds that do not work. Python 3.14 is tested by the workflow `compat`.
Run time
    A quarter of an hour on one processor, or half an hour with the installations.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from studies.harness.claims import Claim
from studies.harness.study import Row, Study

STEP = "batch"

ROOT = Path(__file__).parents[2]
TESTS = ("tests/io", "tests/signal", "tests/modal/ambient", "tests/tracking")
QUICK_TESTS = ("tests/signal/test_segments.py",)
PYTHONS, RESOLUTIONS = ("3.11", "3.12", "3.13", "3.14"), ("highest", "lowest-direct")
KERNELS = ("Haswell", "SkylakeX", "Prescott")
CONTROL = "control: Fourier transforms 1 % too large"
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
_TOOLS = ("pytest", "pytest-xdist", "hypothesis", "pytest-benchmark")
# Of source distributions only those that need no compiler.
_WHEELS = ("--only-binary", ":all:", "--no-binary", "lmshealth", "--no-binary", "filterpy")
# A module that every interpreter of the control imports first.
_FAULT = (
    "from scipy import fft\n_rfft = fft.rfft\nfft.rfft = lambda *a, **k: 1.01 * _rfft(*a, **k)\n"
)


def main() -> None:
    """Run the study; ``--quick`` runs a few tests with one kernel, and records nothing."""
    study = Study(__file__, __doc__)
    tests = QUICK_TESTS if study.quick else TESTS
    one = dict.fromkeys(_THREADS, "1")
    rows = []
    for kernel in KERNELS[:1] if study.quick else KERNELS:
        case = {"kernel": kernel, "dependencies": "as developed"}
        rows.append(case | tested(sys.executable, one | {"OPENBLAS_CORETYPE": kernel}, tests))
    if not study.quick:
        many = dict.fromkeys(_THREADS, str(os.cpu_count()))
        case = {"kernel": f"of this processor, {os.cpu_count()} threads"}
        rows.append(case | {"dependencies": "as developed"} | tested(sys.executable, many, tests))
        for version in PYTHONS:
            for resolution in RESOLUTIONS:
                case = {"python": version, "kernel": "of this processor"}
                python, why = environment(version, resolution)
                done = tested(python, one, tests) if python else {"result": "skipped", "why": why}
                rows.append(done | case | {"dependencies": resolution})
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "sitecustomize.py").write_text(_FAULT, encoding="utf-8")
        path = os.pathsep.join([folder, os.environ.get("PYTHONPATH", "")])
        control = tested(sys.executable, one | {"PYTHONPATH": path}, ("tests/signal",))
    passed = {
        "no case fails": all(row["result"] != "failed" for row in rows),
        "transforms that are 1 % too large fail": control.get("failed", 0) > 0,
    }
    study.conclude({"tests": tests, "cases": rows, "control": control, "passed": passed})


def environment(version: str, resolution: str) -> tuple[str, str]:
    """Make an environment; return its interpreter, or nothing and why that is not possible."""
    own = Path(sys.executable).parent
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    # Before the path, which may lead to a shim for another version.
    places = [*map(str, sorted(pyenv.glob(f"{version}.*/bin"))), os.environ["PATH"]]
    python = shutil.which(f"python{version}", path=os.pathsep.join(places))
    uv = shutil.which("uv", path=os.pathsep.join([str(own), *places]))
    if python is None or uv is None:
        return "", f"no Python {version} here" if uv else "no uv here"
    folder = Path(tempfile.gettempdir()) / f"lmshealth-compat-{version}-{resolution}"
    made = folder / "bin" / "python"
    install = (uv, "pip", "install", "--quiet", "--python", str(made), *_WHEELS)
    commands = (
        (uv, "venv", "--quiet", "--clear", "--python", python, str(folder)),
        (*install, "--resolution", resolution, "-e", f"{ROOT}[models,formats]"),
        (*install, *_TOOLS),
    )
    for command in commands:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            # Addresses of registries are none of the record's business.
            lines = re.sub(r"\S+://\S+", "", done.stderr).strip().splitlines() or ["uv failed"]
            return "", " ".join(line.strip() for line in lines[:4])[:300]
    return str(made), ""


def tested(python: str, variables: dict[str, str], tests: tuple[str, ...]) -> Row:
    """Run tests with an interpreter; return numbers of tests by outcome, and what failed."""
    fast = "not slow and not study and not statistical"
    command = [python, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", fast, *tests]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | variables, capture_output=True, text=True, check=False
    )
    last = (done.stdout.splitlines() or ["nothing"])[-1]
    counts = {word: int(n) for n, word in re.findall(r"(\d+) (passed|failed|skipped|error)", last)}
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    result = "failed" if done.returncode else "passed"
    version = subprocess.run([python, "-VV"], capture_output=True, text=True, check=True).stdout
    row = {"python": version.split()[1], "result": result, **counts}
    return row | ({"tests_failed": failed[:20]} if failed else {})


def claims(answer: Row) -> Iterator[Claim]:
    """Claim the result of each case."""
    for row in answer["cases"]:
        name = f"Python {row['python']}, {row['dependencies']}, kernel {row['kernel']}"
        beside = f"skipped tests {row.get('skipped', 0)}"
        if row["result"] == "failed":
            beside = f"failed {row.get('failed', 0)}: {', '.join(row.get('tests_failed', []))}"
        beside = row.get("why", beside)
        figure = f"{row['result']}, {row['passed']:,} tests" if "passed" in row else row["result"]
        yield Claim(name, figure, beside=beside, met=row["result"] != "failed")
    control = answer["control"]
    yield Claim(
        CONTROL,
        f"{control['result']}, {control.get('failed', 0)} tests",
        met=answer["passed"]["transforms that are 1 % too large fail"],
    )


if __name__ == "__main__":
    main()
