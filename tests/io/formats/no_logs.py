"""Files of other programs that hold no log, and what each is called in its refusal."""

from __future__ import annotations

import io
import json
import struct
import wave
import zipfile

import numpy as np

SAMPLES = np.random.default_rng(0).normal(size=2000)
NODES = b"    -1\n    15\n         1         0         0         8  1.00000e+00\n    -1\n"
LINES = b"    -1\n    82\n         1         2         0\nline\n         1         2\n    -1\n"


def sound() -> bytes:
    """Write a WAV file."""
    file = io.BytesIO()
    with wave.open(file, "wb") as out:
        out.setnchannels(1)
        out.setsampwidth(2)
        out.setframerate(8000)
        out.writeframes((3000 * SAMPLES).astype("<i2").tobytes())
    return file.getvalue()


def zipped(*names: str) -> bytes:
    """Write a zip archive of files."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as out:
        for name in names:
            out.writestr(name, "x")
    return file.getvalue()


NO_LOGS = {
    "a.wav": (sound(), "a sound file (WAV)"),
    "wav.csv": (sound(), "a sound file (WAV)"),
    "a.flac": (b"fLaC" + bytes(99), "a sound file (FLAC)"),
    "a.mp3": (b"ID3\x04" + bytes(99), "a sound file (MP3)"),
    "a.xlsx": (zipped("[Content_Types].xml", "xl/workbook.xml"), "a workbook (.xlsx)"),
    "a.zip": (zipped("a.csv", "b.csv"), "a zip archive of 2 files"),
    "pdf.csv": (b"%PDF-1.7\n1 0 obj\n", "a printed document"),
    "json.txt": (json.dumps(SAMPLES[:99].tolist()).encode(), "JSON"),
    "a.png": (b"\x89PNG\r\n\x1a\n" + bytes(99), "a picture (PNG)"),
    "geometry.uff": (NODES + LINES, "15 (nodes), 82 (lines of a geometry)"),
    "mesh.stl": (bytes(80) + struct.pack("<I", 9) + bytes(450), "a geometry (STL)"),
}
