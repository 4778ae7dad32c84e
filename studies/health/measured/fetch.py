"""Fetch the recordings of ``dropbear_ds8``, ``shake_3storey`` and ``palisaden_building``.

They stay where their authors published them, under CC BY-SA 4.0, BSD-2 and MIT; nothing of them is
part of this project. ``git`` is needed, and some 130 MB.
"""

import gzip
import re
import subprocess
import sys
import tempfile
from pathlib import Path

BEAM = (
    "https://github.com/High-Rate-SHM-Working-Group/"
    "Dataset-8-DROPBEAR-Acceleration-vs-Roller-Displacement",
    "28955a71b7b00cbca47dec9f0ff8fd9adc591cf3",
    "data/Slow Postional Displacement/trial data/10steps",
)
FRAME = (
    "https://github.com/chrystalchern/mdof",
    "4f0e831cae79a1c021bd4081e9d952c0f6f6e3b4",
    "notebooks/uploads/mini_shake_table/Flexible vs. Stiff",
)
# Test data of pyOMA2.
BUILDING = (
    "https://github.com/dagghe/pyOMA-test-data",
    "f179b41267e21c6624db0a8eb0ef40cea38f9c39",
    "test_data/palisaden",
)


def fetch(folder: Path) -> None:
    """Write the recordings under the names that studies read."""
    for name in ("dropbear_ds8/open", "shake_3storey/open", "palisaden_building"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        for path in checked_out(*BEAM, f"{scratch}/beam").glob("test*.txt"):
            packed = gzip.compress(path.read_bytes(), mtime=0)
            (folder / f"dropbear_ds8/open/10steps_{path.name}.gz").write_bytes(packed)
        for path in checked_out(*FRAME, f"{scratch}/frame").glob("*3 story/*/(*.csv"):
            frame, floor, name = path.parts[-3].split()[0], path.parts[-2][:3], path.name
            event = re.split(r"[()]", name)[1].replace(" ", "")
            target = folder / f"shake_3storey/open/{frame}_{event}_{floor}.csv"
            target.write_bytes(path.read_bytes())
        building = checked_out(*BUILDING, f"{scratch}/building") / "Palisaden_dataset.npy"
        (folder / "palisaden_building" / building.name).write_bytes(building.read_bytes())


def checked_out(repository: str, commit: str, part: str, at: str) -> Path:
    """Check out a part of a repository at a commit."""
    clone = ["clone", "--quiet", "--filter=blob:none", "--no-checkout", repository, at]
    for words in (clone, ["-C", at, "checkout", "--quiet", commit, "--", part]):
        subprocess.run(["git", *words], check=True)
    return Path(at) / part


if __name__ == "__main__":
    fetch(Path(sys.argv[1]))
