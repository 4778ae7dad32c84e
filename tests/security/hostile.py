"""Hostile inputs: names, tables, links, and files that refer to others."""

from __future__ import annotations

import os
import unicodedata
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from studies.inputs.damaged.logfiles import Archive, Columns, LogFile, log_of, write, write_table

SECRET = "what-nobody-may-see-7d1f"  # content of files that must not be read
# What a name that is run as a command would make.
MARK = "somebody-ran-this"

# Names of machines that are only text: they are tracked and reported unchanged.
MACHINES = (
    "x'); DROP TABLE canary; --", 'x"; DELETE FROM canary; --', "x' OR '1'='1", "%s %d {0} \\",
    "../../outside/escaped", "/etc/passwd", "..", ".", "CON", "nul.txt", "C:\\outside", "a:b",
    "trailing dot.", "index", "INDEX", "Case", "CASE",
    "ﬁ",  # folds to "fi"
    "fi", "<script>alert(1)</script>", '" onmouseover="alert(1)',
    "</style><img src=x onerror=alert(1)>", "javascript:alert(1)", "{{ 7 * 7 }}{% for x in y %}",
    "[red]markup[/red] [/wrong]", ":bomb: https://example.com/x.js",
    '=HYPERLINK("http://example.com","x")', "@SUM(1+1)",
    f"$(touch {MARK})`touch {MARK}`; touch {MARK}", "long " + "ä" * 190,
)  # fmt: skip
# One machine, however its letters are written.
ACCENTED = tuple(unicodedata.normalize(form, "Kä-Y") for form in ("NFC", "NFD"))
# Names that hold what cannot be seen: their logs are refused.
UNSEEN = (
    "nul\0byte", "\x1b[2J\x1b]0;title\x07", "turned\u202eabout", "two\nlines", "carriage\rreturn",
    "line\u2028separator", "zero\u200bwidth", "c1\x9b31m", "long " * 60,
)  # fmt: skip
FILES: tuple[bytes, ...] = (
    b"x'); DROP TABLE canary; --.csv", b"$(touch %s).csv" % MARK.encode(), b"=cmd|'calc'!A0.csv",
    b"<img src=x onerror=alert(1)>.csv", b"[red].csv", b"{{ 7 * 7 }}.csv", b"-rf.csv",
    b" space.csv", b"back\\slash.csv", b"\xff\xfe latin.csv", b"\xff\xfd latin.csv",
    b"\x1b[31mred.csv", b"two\nlines.csv", "turned\u202eabout.csv".encode(), "Kä.csv".encode(),
    unicodedata.normalize("NFD", "Kä.csv").encode(), b"n" * 251 + b".csv",
)  # fmt: skip
STAGE = """name = "<b>../{{ 7 * 7 }}</b>"
source = "</script><script>alert(1)</script>"
[[mode]]
name = "roll'); DROP TABLE canary; --"
frequency_hz = 126.4
damping_ratio = 0.0147
[[mode]]
name = "<script>alert(1)</script>[/wrong]"
frequency_hz = 136.6
damping_ratio = 0.0153
"""
# Descriptions that must be refused, without a word of what they point to.
BAD_STAGES = {
    "control characters": STAGE.replace("[/wrong]", "\\u001b[2J"),
    "nested a thousandfold": STAGE + "x = " + "[" * 20_000 + "]" * 20_000,
    "much of the same": STAGE + "[[mode]]\n" * 10_000,
    "a string without end": STAGE + 'x = """\n' + "a\n" * 30_000,
    "no end": STAGE + "[[mode]]\n" * 40_000,
    "another file for a map": STAGE
    + """[[parameter]]
name = "guide_preload"
prior = { kind = "lognormal", median = 1.0, sigma = 0.3 }
[map]
file = "../outside/secret.txt"
""",
}


def make_hostile(root: Path, base: Columns, *, every: int = 1) -> tuple[list[str], list[str]]:
    """Write an archive of hostile logs, and files around it that must not change.

    Below ``root`` are the folders ``logs`` and ``outside`` then; logs are copies of a recording,
    each with noise of its own, of every so many of the names. Returns the machines that are to be
    followed, and the logs that are to be refused.
    """
    archive = Archive(root / "logs")
    archive.folder.mkdir()
    (root / "outside").mkdir()
    (root / "outside" / "secret.txt").write_text(SECRET + "\n")
    write(Archive(root / "outside"), root / "outside" / "log.h5", _log(base, 900, SECRET))
    machines, refused = list(MACHINES[::every]), []
    for k, name in enumerate([*machines, *ACCENTED]):
        write(archive, archive.folder / f"machine-{k:02d}.h5", _log(base, k, name))
    for k, name in enumerate(UNSEEN[::every]):
        path = archive.folder / f"unseen-{k:02d}.parquet"
        write(archive, path, _log(base, 100 + k, name))
        refused.append(path.name)
    for k, raw in enumerate(FILES[::every]):
        plain = archive.folder / "plain.csv"
        write(archive, plain, _log(base, 200 + k, "files"))
        os.rename(plain, os.path.join(os.fsencode(archive.folder), raw))
    refused += _reaching(root, archive, base)
    _tables(archive)
    return [*machines, ACCENTED[0], "files"], refused


def _log(base: Columns, number: int, stage: str) -> LogFile:
    log = log_of(base, 6 * number, np.random.default_rng([1, number]))
    return replace(log, metadata=log.metadata | {"stage": stage})


def _reaching(root: Path, archive: Archive, base: Columns) -> list[str]:
    """Write logs that refer to other files."""
    outside = root / "outside"
    (archive.folder / "link.h5").symlink_to(outside / "log.h5")
    (archive.folder / "passwd.csv").symlink_to("/etc/passwd")
    (archive.folder / "folder").symlink_to(outside)
    os.mkfifo(archive.folder / "pipe.csv")
    (archive.folder / "device.csv").symlink_to("/dev/zero")
    for name, link in (
        ("external.h5", h5py.ExternalLink(str(outside / "log.h5"), "acc_feed_m_s2")),
        ("soft.h5", h5py.SoftLink("/delta_e_um")),
    ):
        write(archive, archive.folder / name, _log(base, 300 + len(name), "reaching"))
        with h5py.File(archive.folder / name, "a") as file:
            del file["acc_feed_m_s2"]
            file["acc_feed_m_s2"] = link
    write(archive, archive.folder / "storage.h5", _log(base, 320, "reaching"))
    with h5py.File(archive.folder / "storage.h5", "a") as file:
        del file["acc_feed_m_s2"]
        place = [(str(outside / "secret.txt"), 0, 8)]
        file.create_dataset("acc_feed_m_s2", (1,), "f8", external=place)
    names = ("link.h5", "passwd.csv", "pipe.csv", "device.csv", "external.h5", "soft.h5")
    return [*names, "storage.h5", "folder"]


def _tables(archive: Archive) -> None:
    """Write tables with rows that reach outside, and cells that are more than text."""
    moment = "2026-03-01T00:00:00Z"
    rows = [
        ["../outside/log.h5", SECRET, moment, "1", ""],
        ["/etc/passwd", "", "", "", ""],
        ["\x1b[2J.csv", "", "", "", ""],
        ["nul\0.csv", "", "", "", ""],
        ["http://127.0.0.1:1/log.csv", "", "", "", ""],
        ["n" * 5000 + ".csv", "", "", "", ""],
        ["machine-00.h5", "", "", "", "'; DROP TABLE canary; --<script>alert(1)</script>"],
    ]
    work = [
        [MACHINES[0], moment, "0", "regrease"],
        ["<script>alert(1)</script>\x1b[2J", moment, "0", "servo"],
        [MACHINES[0], moment, "0", "'); DROP TABLE canary; --<script>alert(1)</script>\x1b[2J"],
        [MACHINES[0], f"$(touch {MARK})\u202e", "0", "servo"],
    ]
    write_table(archive.folder, "manifest", rows, "servo_id")
    write_table(archive.folder, "maintenance", work)
