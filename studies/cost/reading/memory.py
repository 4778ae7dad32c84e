"""Print the peak memory and the processor time of reading a long file, as JSON.

The arguments are the file and a short file of the same format, which is read before: what is
imported once does not count. The process that reads native formats counts with the one it reads
for.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats import isolation
from lmshealth.io.formats.registry import load
from studies.cost.reading.files import BARE, Call
from studies.harness.cost import cpu_s, memory_bytes

_MAX_MEMORY = 4 * 2**30


def main() -> None:
    """Read by our reader and by the bare library, which is last, because a peak never falls."""
    warnings.simplefilter("ignore")
    path, short = Path(sys.argv[1]), Path(sys.argv[2])
    # An ASCII UFF58 of ten minutes is above the limit of memory.
    reader = partial(load, columns=ColumnMap(), max_memory=_MAX_MEMORY)
    ways: dict[str, Call] = {"reader": reader, "library": BARE[path.name][0]}
    for read in ways.values():
        read(short)
    before, found = both_bytes(), {}
    for way, read in ways.items():
        seconds = both_s(partial(read, path))
        found[way] = {"bytes": both_bytes() - before, "cpu_s": seconds}
    print(json.dumps(found))


def both_bytes() -> int:
    """Return the peak memory of this process, and of that which reads for it, in bytes."""
    process = isolation._reader.process
    return memory_bytes() + (0 if process is None else memory_bytes(process=process.pid))


def both_s(work: Callable[[], object]) -> float:
    """Return the processor time of one call in s, with that of the process that reads for it."""
    process = isolation._reader.process
    if process is None:
        return cpu_s(work)
    status = Path(f"/proc/{process.pid}/schedstat")
    before = int(status.read_text().split()[0])
    spent = cpu_s(work)
    return spent + 1e-9 * (int(status.read_text().split()[0]) - before)


if __name__ == "__main__":
    main()
