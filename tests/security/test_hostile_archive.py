"""The content of a log, a table or an address executes nothing and reaches nothing outside.

An archive of hostile logs (`hostile.py`: SQL, markup, commands, paths, formulas, control
characters, links, pipes) is run and reported on SQLite and PostgreSQL, with debug logging. Every
file around it is hashed before and after; the database has a table that must not change; all
printed, written and stored text is searched for control characters, unescaped markup, passwords and
contents of files outside. Each check is given what it must detect.
"""

from __future__ import annotations

import html
import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from sqlalchemy import create_engine

from studies.harness import servers
from studies.inputs.damaged.kinds import KINDS, Kind
from studies.inputs.damaged.logfiles import DESCRIPTION, Archive, log_of, recordings
from tests.security import guards, hostile
from tests.security.guards import ADDRESSES

Row = dict[str, Any]

PASSWORD = "s3cr3t-pa55w0rd"
# What Python, its libraries and a minute of samples take, and the most that a bomb may add.
_MOST_MEMORY_MB = 400
# Characters: two lines of a terminal for what is wrong, and a block of a description to copy.
_LONGEST_MESSAGE = 700
# On SQLite every so many of the names, SQL and markup, are tried; on PostgreSQL all.
_EVERY = 19
# Names, tables and links act by no number of samples: logs have two short channels.
_SECONDS, _LEFT_OUT = 3.0, "acc_pitch_m_s2"
_TALKATIVE = (
    "import logging, sys; logging.basicConfig(level=logging.DEBUG);"
    "{more}from lmshealth.cli.main import main; main(sys.argv[1:])"
)
# Pages have the pictures that the run drew from the same contents (`tests.batch.test_run`).
_NO_PICTURES = "from lmshealth.report import figures; figures.inline = lambda *_, **__: '';"
Done = subprocess.CompletedProcess[str]


def lmshealth(*words: str | Path, cwd: Path, more: str = "") -> Done:
    """Run a command at the most talkative level of logging, after more code."""
    script = _TALKATIVE.format(more=more)
    command = [sys.executable, "-c", script, *(str(word) for word in words)]
    paths = {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    return subprocess.run(
        command, capture_output=True, cwd=cwd, check=False, text=True, errors="surrogateescape",
        env=os.environ | paths,
    )  # fmt: skip


def attack(folder: Path, url: str, password: str, *, every: int) -> dict[str, list[str]]:
    """Run and report a hostile archive; return what is wrong, by what is required."""
    logs, out = folder / "logs", folder / "out"
    (base,) = recordings(1, _SECONDS)
    del base[_LEFT_OUT]
    machines, refused = hostile.make_hostile(folder, base, every=every)
    (folder / "stage.toml").write_text(hostile.STAGE)
    links = _links(folder, out)
    guards.plant(url)
    before = guards.snapshot(folder, [out])
    words = [
        "--stage",
        str(folder / "stage.toml"),
        "--store",
        url,
        "--workers",
        "1",
        "--epochs",
        "1",
    ]
    done = [lmshealth("run", logs, *words, "--out", out, cwd=folder)]
    if every == 1:
        words = ["--store", url, "--workers", "1", "--out", str(out / "again")]
        done.append(lmshealth("report", *words, cwd=folder, more=_NO_PICTURES))
    # Who names a link means what it points to.
    named = [path for path in sorted(logs.glob("*.csv")) if not path.is_symlink()]
    # Names are the same in all modes: a band spares most of the time.
    styles = (["table"], ["csv", "--band", "100", "140"], ["json", "--band", "100", "140"])
    single = [
        lmshealth("modes", *named, "--format", *style, cwd=folder) for style in styles if every == 1
    ]
    printed = "".join(one.stdout + one.stderr for one in (*done, *single))
    changed = guards.differences(before, guards.snapshot(folder, [out]))
    written = {
        path: path.read_text() for path in out.rglob("*") if path.suffix in (".html", ".csv")
    }
    pages = [text for path, text in written.items() if path.suffix == ".html"]
    kept = guards.everything_in(url).decode("utf-8", "replace")
    status = json.loads((out / "status.json").read_text(encoding="utf-8"))
    reported = [one["stage"] for one in status["machines"]]
    lost = set(pd.read_csv(out / "refused.csv", dtype=str, keep_default_na=False)["log"])
    names = [path.name for path in out.iterdir() if path.suffix == ".html"]
    wrong = {
        "nothing outside the output is changed": changed,
        "no SQL is executed": guards.touched(url),
        "every machine is told as it is named": sorted({*machines} ^ {*reported}),
        "every reaching log is refused": sorted({*refused} - lost),
        "pages have names of their own": guards.bad_names(names)
        # Beside those of machines the one of all, and the examples.
        + ([] if len(names) == len(machines) + 2 else [f"{len(names)} pages"]),
        "no command is run": [str(p) for p in folder.rglob(hostile.MARK)],
        "links are replaced and not followed": [str(link) for link in links if link.is_symlink()],
        "the exit status is that of refused logs": []
        if [one.returncode for one in done] == [3, 0][: len(done)]
        else [f"{one.returncode}: {one.stderr[-500:]}" for one in done],
    }
    return (
        wrong | in_words([printed, *written.values()], kept, password) | on_pages(pages, machines)
    )


def in_words(texts: Sequence[str], kept: str, password: str) -> dict[str, list[str]]:
    """Search what was printed first and written then, and what is kept, for what acts or leaks."""
    every = list(enumerate([*texts, kept]))
    return {
        "nothing printed or written acts": sorted(
            {sign for text in texts for sign in guards.acting(text)}
        ),
        # Of this test, or the system's users.
        "no file outside is read": [
            f"text {k}" for k, text in every if hostile.SECRET in text or "root:x:0" in text
        ],
        "no password is shown or kept": [f"text {k}" for k, text in every if password in text],
        "no traceback": ["there is one"] if "Traceback" in texts[0] else [],
    }


def on_pages(pages: Sequence[str], machines: Sequence[str]) -> dict[str, list[str]]:
    """Search pages for what they load and run, and for machines by their names."""
    shown = [html.unescape(text) for text in pages]
    own = {script for text in pages for script in guards.scripts(text)}
    return {
        "pages load and run nothing": sorted(
            {found for text in pages for found in guards.loaded(text)}
            | {script[:200] for script in own if "alert" in script}
        ),
        "no template is filled in": [
            name for name in machines if not any(name in text for text in shown)
        ],
    }


def _links(folder: Path, out: Path) -> list[Path]:
    """Lay links in the places of files that will be written; that of the last has no target."""
    names = ("index.html", "modes.csv", "refused.csv", "files.html", "health.csv", "track.csv")
    for name in names:
        victim = folder / "outside" / f"victim-{name}"
        if name != names[-1]:
            victim.write_text("as it was")
        (out / name).symlink_to(victim)
    return [out / name for name in names]


def _weigh(path: Path) -> Row:
    """Read a log in a process of its own; return why it is refused, and its peak memory in MB."""
    # The high-water mark of the process: what `getrusage` gives starts at that of its parent.
    script = (
        "import json, resource, sys\n"
        "resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))\n"
        "from lmshealth.io.reading import read_log\n"
        "from lmshealth.errors import BadLog\n"
        "try:\n    read_log(sys.argv[1]); reason = ''\n"
        "except BadLog as error:\n    reason = error.reason\n"
        "(peak,) = [line.split()[1] for line in open('/proc/self/status') if line[:5] == 'VmHWM']\n"
        "print(json.dumps({'refused': reason, 'peak_mb': int(peak) >> 10}))"
    )
    command = [sys.executable, "-c", script, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: Row = json.loads(done.stdout)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_a_hostile_archive_is_only_text(
    tmp_path: Path, kind: str, needs: Callable[[str], None]
) -> None:
    """Names, tables and links act nowhere, are reported as they are, or refused; nothing leaks."""
    (tmp_path / "out").mkdir()
    if kind == "sqlite":
        url = f"sqlite:///{tmp_path / 'out' / 'lmshealth.sqlite'}"
        wrong = attack(tmp_path, url, PASSWORD, every=_EVERY)
    else:
        needs("postgres")
        with servers.postgres() as server, server.database() as url:
            wrong = attack(tmp_path, url, server.password, every=1)
    assert not {name: found for name, found in wrong.items() if found}


@pytest.mark.slow
@pytest.mark.parametrize("form", ADDRESSES)
def test_no_address_shows_its_password(tmp_path: Path, form: str) -> None:
    """An address with a password, as a store and as a scheduler, is reported without it."""
    (tmp_path / "logs").mkdir()
    (tmp_path / "stage.toml").write_text(DESCRIPTION)
    address = form.format(*[PASSWORD] * 2)
    words = ["run", "logs", "--stage", "stage.toml", "--out", "out"]
    for more in (
        [*words, "--store", address],
        ["report", "--store", address, "--out", "out"],
        [*words, "--scheduler", address.replace("postgresql", "tcp")],
    ):
        done = lmshealth(*more, cwd=tmp_path)
        assert PASSWORD not in done.stdout + done.stderr
        assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", hostile.BAD_STAGES)
def test_a_hostile_description_is_refused_by_one_short_message(tmp_path: Path, name: str) -> None:
    """The message acts on no terminal and quotes no other file."""
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "secret.txt").write_text(hostile.SECRET + "\n")
    path = tmp_path / "stages" / "bad.toml"
    path.parent.mkdir()
    path.write_text(hostile.BAD_STAGES[name])
    done = lmshealth("stage", path, cwd=tmp_path)
    # The log record of the message comes first.
    _, found, message = done.stderr.partition("\nlmshealth: ")
    assert (done.returncode, found, message.count("lmshealth: ")) == (1, "\nlmshealth: ", 0)
    assert len(message) < _LONGEST_MESSAGE
    assert guards.acting(done.stderr) == []
    assert hostile.SECRET not in done.stderr + done.stdout


@pytest.mark.slow
def test_no_address_of_a_file_is_called(tmp_path: Path) -> None:
    """Files that are named by addresses of a server are not fetched."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.1)
        there = f"http://127.0.0.1:{server.getsockname()[1]}/x"
        for words in (
            ["modes", f"{there}.csv", f"{there}.h5", f"{there}.parquet"],
            ["stage", f"{there}.toml"],
            ["modes", "logs/none.csv", "--columns", f"{there}.toml"],
            ["track", f"{there}.csv", "--out", "track.csv"],
        ):
            done = lmshealth(*words, cwd=tmp_path)
            with pytest.raises(TimeoutError):
                server.accept()
            assert done.returncode in (1, 2)


BOMBS = [(kind, suffix) for kind in KINDS if kind.reason == "too-large" for suffix in kind.suffixes]


@pytest.mark.slow
@pytest.mark.skipif(
    not Path("/proc/self/status").exists(), reason="reads memory from Linux's /proc"
)
@pytest.mark.parametrize(("kind", "suffix"), BOMBS, ids=[f"{k.name}{s}" for k, s in BOMBS])
def test_a_file_that_swells_is_refused(tmp_path: Path, kind: Kind, suffix: str) -> None:
    """A file that decodes to many times its size is refused within little memory."""
    rng = np.random.default_rng(0)
    path = tmp_path / f"bomb{suffix}"
    kind.make(Archive(tmp_path), path, log_of(recordings(1)[0], 0, rng), rng)
    found = _weigh(path)
    assert found["refused"]
    assert found["peak_mb"] < _MOST_MEMORY_MB


def test_what_acts_is_noticed(tmp_path: Path) -> None:
    """Negative controls: each guard notices what it is for."""
    victim, link = tmp_path / "victim", tmp_path / "out" / "index.html"
    link.parent.mkdir()
    victim.write_text("as it was")
    link.symlink_to(victim)
    before = guards.snapshot(tmp_path, [link.parent])
    link.write_text("followed")
    followed = guards.differences(before, guards.snapshot(tmp_path, [link.parent]))
    assert followed == [repr(os.fsencode(victim))]
    url = f"sqlite:///{tmp_path / 'store.sqlite'}"
    guards.plant(url)
    engine = create_engine(url)
    raw = engine.raw_connection()
    assert raw.driver_connection is not None
    raw.driver_connection.executescript(
        f"CREATE TABLE t_1 (name TEXT); INSERT INTO t_1 VALUES ('{hostile.MACHINES[0]}');"
    )
    raw.close()
    engine.dispose()
    assert guards.touched(url) == ["the table is gone"]
    assert guards.scripts("<p><script>alert(1)</script></p>")
    assert guards.loaded('<p title="" onmouseover="alert(1)">')
    assert guards.loaded('<script src="https://example.com/x.js">')
    assert guards.acting(hostile.UNSEEN[1])
    assert guards.acting(hostile.UNSEEN[2])
    names = ["CON.html", "a.html", "A.html"]
    assert guards.bad_names(names) == names
