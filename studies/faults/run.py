"""What can go wrong around a batch, and does it then end as if nothing had happened?

Each part has its question, method and answer:

- `kills`: runs killed at random moments, on a SQLite file and on PostgreSQL
- `losses`: a full disk, a lost database
- `workers`: Dask workers killed one after the other, a scheduler lost
- `together`: two runs at once on one store
- `damaged`: damaged logs of every kind among good ones
- `injection`: hostile names, metadata and addresses

Each is a program of its own with a record of its own, ``python -m studies.faults.kills``; this one
carries them all out.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

PARTS = ("kills", "losses", "workers", "together", "damaged", "injection")


def main() -> None:
    """Carry out all parts; ``--quick`` does a small part of each and records nothing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    quick = ["--quick"] if parser.parse_args().quick else []
    failed = []
    for part in PARTS:
        command = [sys.executable, "-m", f"studies.faults.{part}", *quick]
        if subprocess.run(command, check=False, cwd=Path(__file__).parents[2]).returncode:
            failed.append(part)
    if failed:
        sys.exit(f"not as asked: {failed}")


if __name__ == "__main__":
    main()
