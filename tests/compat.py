"""Run the fast tests of io and signal on what this machine has: a table passed, failed, skipped.

Other Pythons and the lowest dependencies get an environment of their own, if their packages can be
installed without a compiler. ``OPENBLAS_CORETYPE`` selects kernels that other processors have.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
TESTS = ("tests/io", "tests/signal", "tests/modal/ambient", "tests/tracking")
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
KERNELS = ("Haswell", "SkylakeX", "Prescott")
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")


def cases() -> Iterator[tuple[str, str, Mapping[str, str]]]:
    """Yield name, interpreter and environment of each case; no interpreter where it is missing."""
    one = dict.fromkeys(_THREADS, "1")
    for kernel in KERNELS:
        yield f"kernel {kernel}", sys.executable, {**one, "OPENBLAS_CORETYPE": kernel}
    yield "many threads", sys.executable, dict.fromkeys(_THREADS, str(os.cpu_count()))
    for version in PYTHONS:
        for resolution in ("highest", "lowest-direct"):
            yield f"Python {version}, {resolution}", _environment(version, resolution), one


def _environment(version: str, resolution: str) -> str:
    """Make an environment, and return its interpreter; empty where that is not possible here."""
    python = shutil.which(f"python{version}")
    uv = shutil.which("uv", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    if python is None or uv is None:
        return ""
    folder = Path(tempfile.gettempdir()) / f"lmshealth-compat-{version}-{resolution}"
    own = folder / "bin" / "python"
    packages = ["--only-binary", ":all:", "--no-binary", "lmshealth", "--no-binary", "filterpy"]
    install = [uv, "pip", "install", "--quiet", "--python", str(own), "--resolution", resolution]
    commands = (
        [uv, "venv", "--quiet", "--allow-existing", "--python", python, str(folder)],
        [*install, *packages, "-e", f"{ROOT}[models,formats]", "filterpy", "pytest",
         "pytest-xdist", "hypothesis", "pytest-benchmark"],
    )  # fmt: skip
    for command in commands:
        if subprocess.run(command, capture_output=True, check=False).returncode:
            return ""
    return str(own)


def main() -> None:
    """Print a row for each case; the exit status is 1 if any has failed."""
    failed = False
    print("| case | result | last line |\n| --- | --- | --- |")
    for name, python, environment in cases():
        if not python:
            print(f"| {name} | skipped | no such Python, no uv, or no wheels |", flush=True)
            continue
        command = [python, "-m", "pytest", "-q", "-m", "not slow and not statistical", *TESTS]
        done = subprocess.run(
            command, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True,
            check=False,
        )  # fmt: skip
        failed |= done.returncode != 0
        last = (done.stdout.splitlines() or ["nothing"])[-1].strip("= ")
        print(f"| {name} | {'failed' if done.returncode else 'passed'} | {last} |", flush=True)
    raise SystemExit(int(failed))


if __name__ == "__main__":
    main()
