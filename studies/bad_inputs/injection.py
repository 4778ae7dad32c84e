"""Can the content of a log, a table or an address execute anything or reach outside the output?

Method
    An archive of hostile logs (`hostile.py`: SQL, markup, commands, paths, formulas,
    control characters, links, pipes) is run and reported on SQLite and, where installed,
    PostgreSQL, with debug logging. Every file around it is hashed before and after; the database
    has a table that must not change; all printed, written and stored text is searched for control
    characters, unescaped markup, passwords and contents of files outside. Links take the place of
    output files. Files that expand are read one by one and their memory is measured. Controls:
    each check is given what it must detect.
Answer
    Nothing is executed and nothing outside is changed: 32 machines are reported with their names,
    17 logs that reach outside or hold invisible characters are refused. No password is shown or
    stored in 14 forms of addresses, tried three times each. An expanding file takes at most 223 MB
    with all libraries.
Run time
    Eight minutes on one processor.
"""

from __future__ import annotations

import html
import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from sqlalchemy import create_engine

from studies.bad_inputs import guards, hostile
from studies.bad_inputs.damage import KINDS
from studies.bad_inputs.logfiles import DESCRIPTION, Archive, Columns, log_of, recordings
from studies.faults.driving import PROGRAM
from studies.harness import servers
from studies.harness.claims import Claim, controls_seen
from studies.harness.study import Row, Study

STEP = "batch"

PASSWORD = "s3cr3t-pa55w0rd"
# Ways to write a password into an address; some of them are no addresses at all.
ADDRESSES = (
    "postgresql+psycopg://u:{}@127.0.0.1:1/db",
    "postgresql://u:{}@127.0.0.1:1/db?connect_timeout=1",
    "postgresql://u:a/{}@127.0.0.1:1/db",
    "postgresql://u:a@{}@127.0.0.1:1/db",
    "postgresql://u:a?{}@127.0.0.1:1/db",
    "postgresql://u:a#{}@127.0.0.1:1/db",
    "postgresql://u@127.0.0.1:{}/db",
    "postgresql://u:%2F{}@127.0.0.1:1/db",
    "postgresql://127.0.0.1:1/db?password={}",
    "postgresql://127.0.0.1:1/db?sslpassword={}&bogus={}",
    "sqlite:////nowhere/store.sqlite?timeout={}",
    "mysql://u:{}@127.0.0.1/db",
    "u:{}@127.0.0.1/db",
    "host=127.0.0.1 password={}",
)
# What Python, its libraries and a minute of samples take, and the most that a bomb may add.
_MOST_MEMORY = 400 << 20
# Of the quick form, which reports once: every so many of the names: SQL and markup.
_EVERY = 19
_TALKATIVE = (
    "import logging, sys; logging.basicConfig(level=logging.DEBUG);"
    "from lmshealth.cli.main import main; main(sys.argv[1:])"
)
Done = subprocess.CompletedProcess[str]


def main() -> None:
    """Run the study; ``--quick`` does a part of it and records nothing."""
    study = Study(__file__, __doc__)
    quick, once = study.quick, partial(study.trials.once, also=PROGRAM)
    (base,) = recordings(1)
    answer: Row = {"stores": {}, "controls": controls()}
    with ExitStack() as stack:
        kinds = ["sqlite"]
        if not quick and servers.missing_postgres() is None:
            kinds.append("postgresql")
        for kind in kinds:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hostile-")))
            (folder / "out").mkdir()
            url, password = f"sqlite:///{folder / 'out' / 'lmshealth.sqlite'}", PASSWORD
            if kind == "postgresql":
                server = stack.enter_context(servers.postgres())
                url, password = stack.enter_context(server.database()), server.password
            own = partial(attack, folder, base, url, password, every=_EVERY if quick else 1)
            answer["stores"][kind] = once(own, kind)
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="addresses-")))
        # Addresses have tests of their own.
        answer["addresses"] = once(partial(addresses, folder), () if quick else ADDRESSES)
        answer["descriptions"] = [] if quick else descriptions(folder)
        answer["network"] = [] if quick else network(folder)
        answer["bombs"] = [] if quick else once(partial(bombs, folder, base))
    stores = answer["stores"].values()
    answer["passed"] = {
        **{
            name: not any(store["wrong"][name] for store in stores)
            for name in sorted(answer["stores"]["sqlite"]["wrong"])
        },
        "no address shows its password": not answer["addresses"]["shown"],
        "descriptions are refused in a line": not answer["descriptions"],
        "nobody is called": not answer["network"],
        "bombs stay small": all(
            row["refused"] and row["peak_mb"] < _MOST_MEMORY >> 20 for row in answer["bombs"]
        ),
        "controls are noticed": all(answer["controls"].values()),
    }
    study.conclude(answer)


def lmshealth(*words: str | Path, cwd: Path) -> Done:
    """Run a command at the most talkative level of logging."""
    command = [sys.executable, "-c", _TALKATIVE, *(str(word) for word in words)]
    paths = {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    return subprocess.run(
        command, capture_output=True, cwd=cwd, check=False, text=True, errors="surrogateescape",
        env=os.environ | paths,
    )  # fmt: skip


def attack(folder: Path, base: Columns, url: str, password: str, _kind: str, *, every: int) -> Row:
    """Run and report a hostile archive, and look at everything that came of it."""
    logs, out = folder / "logs", folder / "out"
    machines, refused = hostile.make_hostile(folder, base, every=every)
    (folder / "stage.toml").write_text(hostile.STAGE)
    links = _links(folder, out)
    guards.plant(url)
    before = guards.snapshot(folder, [out])
    words = ["--stage", folder / "stage.toml", "--store", url, "--workers", "1", "--epochs", "1"]
    done = [lmshealth("run", logs, *words, "--out", out, cwd=folder)]
    if every == 1:
        words = ["--store", url, "--workers", "1"]
        done.append(lmshealth("report", *words, "--out", out / "again", cwd=folder))
    # Who names a link means what it points to.
    named = [path for path in sorted(logs.glob("*.csv")) if not path.is_symlink()]
    styles = ("table", "csv", "json") if every == 1 else ()
    single = [lmshealth("modes", *named, "--format", style, cwd=folder) for style in styles]
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
    return {
        "machines": len(machines),
        "logs_refused": len(refused),
        "pages": len(names),
        "exit_status": [one.returncode for one in (*done, *single)],
        "wrong": wrong
        | in_words([printed, *written.values()], kept, password)
        | on_pages(pages, machines),
    }


def in_words(texts: Sequence[str], kept: str, password: str) -> dict[str, list[str]]:
    """Search what was printed first and written then, and what is kept, for what acts or leaks."""
    every = list(enumerate([*texts, kept]))
    return {
        "nothing printed or written acts": sorted(
            {sign for text in texts for sign in guards.acting(text)}
        ),
        # Of this study, or the system's users.
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


def addresses(folder: Path, forms: Sequence[str]) -> Row:
    """Try addresses that hold a password, as stores and as schedulers."""
    (folder / "logs").mkdir(exist_ok=True)
    (folder / "stage.toml").write_text(DESCRIPTION)
    shown, status = [], []
    for form in forms:
        address = form.format(*[PASSWORD] * 2)
        words = ["run", "logs", "--stage", "stage.toml", "--out", "out"]
        for more in (
            [*words, "--store", address],
            ["report", "--store", address, "--out", "out"],
            [*words, "--scheduler", address.replace("postgresql", "tcp")],
        ):
            done = lmshealth(*more, cwd=folder)
            status.append(done.returncode)
            if PASSWORD in done.stdout + done.stderr or "Traceback" in done.stderr:
                shown.append({"address": form, "command": more[0], "message": done.stderr[-600:]})
    return {"tried": len(status), "exit_status": sorted(set(status)), "shown": shown}


def descriptions(folder: Path) -> list[str]:
    """Load descriptions that must be refused in one line."""
    (folder / "outside").mkdir(exist_ok=True)
    (folder / "outside" / "secret.txt").write_text(hostile.SECRET + "\n")
    (folder / "stages").mkdir(exist_ok=True)
    wrong = []
    for name, content in hostile.BAD_STAGES.items():
        path = folder / "stages" / "bad.toml"
        path.write_text(content)
        done = lmshealth("stage", path, cwd=folder)
        messages = done.stderr
        fine = done.returncode == 1 and messages.count("\n") == 1 and not guards.acting(messages)
        if not fine or hostile.SECRET in messages + done.stdout:
            wrong.append(f"{name}: {done.returncode} {messages[-300:]}")
    return wrong


def network(folder: Path) -> list[str]:
    """Name files by addresses of a server, and see whether anybody calls it."""
    wrong = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.1)
        there = f"http://127.0.0.1:{server.getsockname()[1]}/x"
        commands = (
            ["modes", f"{there}.csv", f"{there}.h5", f"{there}.parquet"],
            ["stage", f"{there}.toml"],
            ["modes", "logs/none.csv", "--columns", f"{there}.toml"],
            ["track", f"{there}.csv", "--out", "track.csv"],
        )
        for words in commands:
            done = lmshealth(*words, cwd=folder)
            try:
                server.accept()[0].close()
                wrong.append(f"{words[0]} called")
            except TimeoutError:
                pass
            if done.returncode not in (1, 2):
                wrong.append(f"{words[0]} ended with {done.returncode}")
    return wrong


def bombs(folder: Path, base: Columns) -> list[Row]:
    """Read files that swell, and measure the memory that each takes."""
    rows = []
    archive = Archive(folder / "bombs")
    archive.folder.mkdir()
    log = log_of(base, 0, np.random.default_rng(0))
    for kind in (kind for kind in KINDS if kind.reason == "too-large"):
        for suffix in kind.suffixes:
            path = archive.folder / f"bomb{suffix}"
            kind.make(archive, path, log, np.random.default_rng(0))
            rows.append({"bomb": kind.name, "suffix": suffix, **_weigh(path)})
    return rows


def _weigh(path: Path) -> Row:
    """Read a log in a process of its own; return why it is refused, and its peak memory in MB."""
    import resource  # POSIX

    script = (
        "import json, resource, sys\nfrom lmshealth.io.reading import read_log\n"
        "from lmshealth.errors import BadLog\n"
        "try:\n    read_log(sys.argv[1]); reason = ''\n"
        "except BadLog as error:\n    reason = error.reason\n"
        "peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10\n"
        "print(json.dumps({'refused': reason, 'peak_mb': peak}))"
    )
    command = [sys.executable, "-c", script, str(path)]
    done = subprocess.run(
        command, capture_output=True, text=True, check=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30)),
    )  # fmt: skip
    found: Row = json.loads(done.stdout)
    return found


def controls() -> dict[str, bool]:
    """Return every guard what it must notice."""
    with tempfile.TemporaryDirectory(prefix="controls-") as name:
        folder = Path(name)
        victim, link = folder / "victim", folder / "out" / "index.html"
        link.parent.mkdir()
        victim.write_text("as it was")
        link.symlink_to(victim)
        before = guards.snapshot(folder, [link.parent])
        link.write_text("followed")
        followed = guards.differences(before, guards.snapshot(folder, [link.parent]))
        url = f"sqlite:///{folder / 'store.sqlite'}"
        guards.plant(url)
        engine = create_engine(url)
        raw = engine.raw_connection()
        raw.driver_connection.executescript(  # type: ignore[union-attr]
            f"CREATE TABLE t_1 (name TEXT); INSERT INTO t_1 VALUES ('{hostile.MACHINES[0]}');"
        )
        raw.close()
        engine.dispose()
        names = ["CON.html", "a.html", "A.html"]
        return {
            "a link that is followed": followed == [repr(os.fsencode(victim))],
            "a name in a statement": guards.touched(url) == ["the table is gone"],
            "markup that is not escaped": bool(guards.scripts("<p><script>alert(1)</script></p>")),
            "an attribute that is not closed": bool(
                guards.loaded('<p title="" onmouseover="alert(1)">')
            ),
            "a page that loads": bool(guards.loaded('<script src="https://example.com/x.js">')),
            "control characters": bool(guards.acting(hostile.UNSEEN[1])),
            "writing turned about": bool(guards.acting(hostile.UNSEEN[2])),
            "names of devices and twins": guards.bad_names(names) == names,
        }


def claims(answer: Row) -> Iterator[Claim]:
    """Claim that the content of names, tables and addresses is never executed."""
    for kind, row in answer["stores"].items():
        wrong = [line for found in row["wrong"].values() for line in found]
        yield Claim(
            f"what hostile names and metadata do ({kind})",
            f"{len(wrong)} of {len(row['wrong'])} forbidden effects",
            f"{row['machines']} machines",
            controls_seen(answer["controls"]),
            not wrong,
        )
    if peaks := [row["peak_mb"] for row in answer["bombs"]]:
        yield Claim(
            "memory for a file that decodes to many times its size, with all libraries",
            f"{max(peaks)} MB at most",
            f"{len(peaks)} kinds",
            "",
            answer["passed"]["bombs stay small"],
        )
    tried = answer["addresses"]
    yield Claim(
        "addresses that show or keep their password",
        f"{len(tried['shown'])} of {tried['tried']}",
        met=not tried["shown"],
    )


if __name__ == "__main__":
    main()
