"""A package with entry points, as an installed one, and programs that have it or have it not."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.conftest import ROOT


def install(folder: Path, name: str, module: str, entry_points: str) -> Path:
    """Write a package of one module with its metadata; return its folder."""
    package = folder / "package"
    info = package / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (package / f"{name}.py").write_text(module)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(entry_points)
    return package


def run_script(
    script: str, *words: str, cwd: Path, package: Path | None
) -> subprocess.CompletedProcess[str]:
    """Run a script with this program and, unless it is None, a package."""
    paths = [ROOT] if package is None else [ROOT, package]
    return subprocess.run(
        [sys.executable, "-c", script, *words],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths))},
        capture_output=True,
        text=True,
        check=False,
    )
