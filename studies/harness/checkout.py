"""The code of an earlier revision, for comparisons in the same run."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[2]


@contextmanager
def checkout(revision: str, folder: Path) -> Iterator[Path]:
    """Make a worktree of a revision while a block runs, unless the folder has it already."""

    def git(*words: str | Path) -> None:
        subprocess.run(["git", "worktree", *words], cwd=ROOT, check=True, capture_output=True)

    if folder.exists():
        yield folder
        return
    git("add", "--detach", "-f", folder, revision)
    try:
        yield folder
    finally:
        git("remove", "--force", folder)
