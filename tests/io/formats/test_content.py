"""Files that hold no log: the message states what a file is and what is needed."""

from __future__ import annotations

import gzip
import io
import json
import re
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import describe, frequency_column
from lmshealth.io.reading import read_log
from lmshealth.stage.proposal import propose
from tests.io.formats.no_logs import LINES, NO_LOGS, NODES, sound, zipped
from tests.io.formats.no_logs import SAMPLES as X
from tests.io.handmade import uff_set

FREQUENCY = np.arange(X.size) / 2
PSD = 1e-6 / ((FREQUENCY - 126) ** 2 + 4) + 1e-12 * X**2


def tarred() -> bytes:
    """Write a tar archive."""
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w") as out:
        out.addfile(tarfile.TarInfo("a.csv"))
    return file.getvalue()


FACET = (
    "facet normal 0 0 1\n outer loop\n  vertex 0 0 0\n  vertex 1 0 0\n  vertex 0 1 0\n endloop\n"
    "endfacet\n"
)
MESH = NODES.replace(b"    15", b"  2411") + LINES.replace(b"    82", b"  2412")


def function(kind: int) -> bytes:
    """Write a universal file with another function than a time record."""
    rows = "".join(f"{v:20.12e}" + "\n" * (k % 4 == 3) for k, v in enumerate(PSD[:400]))
    made = uff_set(rows.encode(), 400)
    return made.replace(b"    1         0    0         0", b"%5d         0    0         0" % kind)


FILES = {
    **NO_LOGS,
    "sound.tdms": (sound(), "a sound file (WAV)"),
    "b.mp3": (b"\xff\xfb\x90\x00" + bytes(50), "a sound file (MP3)"),
    "a.csv": (b"\xff\xd8\xff\xe0" + bytes(50), "a picture (JPEG)"),
    "a.pdf": (b"%PDF-1.7\n1 0 obj\n", "a printed document"),
    "xlsx.csv": (zipped("[Content_Types].xml", "xl/workbook.xml"), "a workbook (.xlsx)"),
    "a.ods": (zipped("mimetype", "content.xml"), "a workbook or text of OpenDocument"),
    "a.docx": (zipped("[Content_Types].xml", "word/document.xml"), "an office file"),
    "a.xls": (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(50), "an office file of the old kind"),
    "cut.zip": (zipped("a.csv")[:40], "a zip archive"),
    "a.tar": (tarred(), "an archive (tar)"),
    "a.tar.gz": (gzip.compress(tarred()), "an archive (tar)"),
    "sound.csv.gz": (gzip.compress(sound()), "a sound file (WAV)"),
    "a.npz": (zipped("x.npy"), "arrays of NumPy"),
    "a.json": (json.dumps({"rate": 2000, "x": X.tolist()}).encode(), "JSON"),
    "list.csv": (json.dumps(X.tolist()).encode(), "JSON"),
    "lines.txt": (json.dumps([{"t": 0, "x": 1}], indent=1).encode(), "JSON"),
    "a.html": (b"<!DOCTYPE html><html></html>", "a page of the web"),
    "xml.csv": (b'<?xml version="1.0"?>\n<m><x>1</x></m>', "an XML file"),
    "a.stl": (b"solid cube\n" + 12 * FACET.encode() + b"endsolid", "a geometry (STL)"),
    "stl.csv": (b"solid cube\n" + 12 * FACET.encode() + b"endsolid", "a geometry (STL)"),
    "a.obj": (b"# mesh\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "a geometry (OBJ)"),
    "a.unv": (MESH, "2411 (nodes), 2412 (elements)"),
    "uff.txt": (NODES + LINES, "a universal file (UFF); rename it to .uff"),
    "psd.uff": (function(9), "function type 9 (power spectral density)"),
    "frf.uff": (function(4), "function type 4 (frequency response)"),
    "coherence.uff": (function(6), "function type 6 (coherence)"),
    "spectrum.uff": (function(2), "function type 2 (spectrum)"),
    "note.txt": (b"The logs of axis 7.\nRecorded in May.\n", "text without rows of numbers"),
    "a.xml": (b'<?xml version="1.0"?>\n<m><x>1</x></m>', "an XML file with no records"),
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("read", [read_log, propose])
def test_what_a_file_is(tmp_path: Path, name: str, read: Callable[[Path], object]) -> None:
    """The message names the kind and what is needed, and advises no column map."""
    content, what = FILES[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(BadLog, match=re.escape(what)) as refused:
        read(tmp_path / name)
    assert refused.value.reason in ("format", "columns")
    assert "column map" not in refused.value.detail


TABLES = ["Frequency [Hz],PSD [g²/Hz]", "frequency_hz,acc_x_g", "f (Hz),Sxx", "Hz,acc_x_g"]


@pytest.mark.parametrize("names", [*TABLES, "# sample_rate_hz: 2000\nFrequency,acc_x_g"])
def test_a_table_over_frequency(tmp_path: Path, names: str) -> None:
    """A spectrum is no log, whatever its columns are called and whoever asks for them."""
    path = tmp_path / "a.csv"
    rows = (f"{f},{p:.6e}" for f, p in zip(FREQUENCY.tolist(), PSD.tolist(), strict=True))
    path.write_text("\n".join([names, *rows, ""]), encoding="utf-8")
    for read in (read_log, propose, lambda path: propose(path, rate=2000.0)):
        with pytest.raises(BadLog, match="is a table over frequency") as refused:
            read(path)
        assert "column map" not in refused.value.detail


def test_a_spectrum_without_names(tmp_path: Path) -> None:
    """What has one sign and rises far above its mean is not proposed."""
    path = tmp_path / "a.csv"
    rows = (f"{f},{p:.6e}" for f, p in zip(FREQUENCY.tolist(), PSD.tolist(), strict=True))
    path.write_text("\n".join([*rows, ""]))
    with pytest.raises(BadLog, match="has one sign, as a spectrum"):
        propose(path, rate=2000.0)


@pytest.mark.parametrize(
    "text",
    [
        "# sample_rate_hz: 2000\nacc_x_g,frequency\n",
        "# sample_rate_hz: 2000\n[axis 7]\nacc_x_g,MZ\n",
        "# sample_rate_hz: 2000\nMZ,acc_x_g\n",
        "# sample_rate_hz: 2000\nv,acc_x_g\n",
        "# sample_rate_hz: 2000\nfreq_converter,acc_x_g\n",
    ],
)
def test_a_log_is_no_other_file(tmp_path: Path, text: str) -> None:
    """Texts that begin like other files are read."""
    rows = "".join(f"{a:.4f},{b:.4f}\n" for a, b in zip(X, X[::-1], strict=True))
    (tmp_path / "a.csv").write_text(text + rows)
    assert read_log(tmp_path / "a.csv").sample_rate == 2000.0


def test_a_measured_frequency_beside_a_map(tmp_path: Path) -> None:
    """A column map may name samples beside a column of frequencies."""
    path = tmp_path / "a.csv"
    rows = "".join(f"50.0,{a:.4f}\n" for a in X)
    path.write_text("Frequency,a\n" + rows)
    columns = ColumnMap(columns={"acc_x_g": "a"}, sample_rate_hz=2000.0)
    assert read_log(path, columns=columns).sample_rate == 2000.0


def test_real_files_are_no_other_files(needs: Callable[[str], None]) -> None:
    """No sample of a format is described as another file."""
    needs("data")
    import os

    found = [p for p in Path(os.environ["LMSHEALTH_DATA"]).rglob("*") if p.is_file()]
    logs = [p for p in found if p.suffix in (".csv", ".tdms", ".mat", ".gz")]
    assert len(logs) > 20 and not any(describe(p.read_bytes()[:4096], p) for p in logs)


def test_names_of_frequencies() -> None:
    """Only a first column that is called a frequency makes a table over frequency."""
    assert frequency_column(["f [Hz]", "x"]) and not frequency_column(["x", "f [Hz]"])
    assert not frequency_column(["F [N]"]) and not frequency_column([])
