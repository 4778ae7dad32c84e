"""The most memory and the processor time that a long file takes, in a process of its own."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
import warnings
from functools import partial
from pathlib import Path

from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.registry import load
from studies.read_throughput.files import BARE


def needs(path: Path, short: Path) -> dict[str, dict[str, float]]:
    """Read a file by the reader and by its bare library: bytes at the peak, processor time in s.

    Parameters
    ----------
    path : Path
        The file.
    short : Path
        A short file of the same format, read before: what is imported once does not count.
    """
    command = [sys.executable, "-m", "studies.read_throughput.memory", str(path), str(short)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: dict[str, dict[str, float]] = json.loads(done.stdout)
    return found


def peak() -> int:
    """Return the peak memory of this process; `resource` would count its parent's too."""
    status = Path("/proc/self/status").read_text()
    (kilobytes,) = re.findall(r"VmHWM:\s*(\d+) kB", status)
    return int(kilobytes) << 10


def main() -> None:
    """Print both as JSON; the library comes last, because a peak never goes down."""
    warnings.simplefilter("ignore")
    path, short = Path(sys.argv[1]), Path(sys.argv[2])
    ways = {"reader": partial(load, columns=ColumnMap()), "library": BARE[path.name][0]}
    for read in ways.values():
        read(short)
    before = peak()
    found = {}
    for way, read in ways.items():
        start = time.process_time()
        read(path)
        found[way] = {"bytes": peak() - before, "cpu_s": time.process_time() - start}
    print(json.dumps(found))


if __name__ == "__main__":
    main()
