"""Print how many bytes of memory reading a file takes: in blocks, and by the bare library."""

import re
import sys
from pathlib import Path

from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.registry import load


def bare(path: Path) -> object:
    """Read a whole file by the library of its format."""
    if path.suffix == ".tdms":
        from nptdms import TdmsFile

        return TdmsFile.read(path)
    if path.suffix == ".mat":
        from scipy.io import loadmat

        return loadmat(str(path))
    if path.suffix == ".h5":
        import h5py

        with h5py.File(path) as file:
            return {name: file[name][()] for name in file}
    if path.suffix == ".parquet":
        from pyarrow.parquet import read_table

        return [column.to_numpy() for column in read_table(path).columns]
    if path.suffix in (".csv", ".gz"):
        from pandas import read_csv

        return dict(read_csv(path).items())
    from pyuff import UFF

    return UFF(str(path)).read_sets()


def peak() -> int:
    """Give the most memory that this process ever had; `resource` would count its parent's too."""
    status = Path("/proc/self/status").read_text()
    found = re.search(r"VmHWM:\s*(\d+) kB", status)
    assert found is not None
    return int(found[1]) << 10


def main() -> None:
    """Read a short file first: imports and caches do not count."""
    short, path = Path(sys.argv[1]), Path(sys.argv[2])
    load(short, ColumnMap())
    bare(short)
    before = peak()
    raw = load(path, ColumnMap())
    blocks = peak()
    assert raw.columns
    bare(path)
    print(blocks - before, peak() - before)


main()
