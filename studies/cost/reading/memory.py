"""Print the peak memory and the processor time of reading a long file, as JSON.

The arguments are the file and a short file of the same format, which is read before: what is
imported once does not count.
"""

from __future__ import annotations

import json
import sys
import warnings
from functools import partial
from pathlib import Path

from lmshealth.io.column_map import ColumnMap
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
    before, found = memory_bytes(), {}
    for way, read in ways.items():
        seconds = cpu_s(partial(read, path))
        found[way] = {"bytes": memory_bytes() - before, "cpu_s": seconds}
    print(json.dumps(found))


if __name__ == "__main__":
    main()
