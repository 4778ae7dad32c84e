"""Does any damage of a file, a description or a store crash, hang or swell the program, or pass?

Method
    A log of 400 samples is written once in each form of `FORMS`, and damaged 2,000 times by one to
    four changes of bytes (`mutate`): replaced, inserted, cut off, set to zero, a bit flipped, an
    integer set to an end of its range. `read_log` must return a log that keeps its contract, or
    raise an `LmshealthError`. 100 mutated descriptions, column maps and manifests each, and the
    hostile ones of `HOSTILE`, are read in the same way. A store of two machines is
    damaged 200 times at random bytes: opening it and reading every outcome must give what
    it held, nothing, or a `StoreError`. In silence wrong is a log whose samples differ from those
    written, where the format has a checksum of them (gzip, packed MAT, Parquet with CRC, HDF5 with
    fletcher32). Measured are time, the memory by which this process grows, and the peak of the one
    that reads HDF5 and Parquet. Controls: a reader that raises a `KeyError` and one that returns
    other samples must be detected, one that ends its process, one that loops and one that takes
    memory must be refused.
Answer
    No. Of 20,000 mutants of ten forms, 369 texts and 200 stores none ends in another exception than
    a refusal, none is wrong in silence, none takes more than 10.1 s or 142 MB; all six controls are
    caught.
Run time
    About eight processor minutes.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.io import savemat

from lmshealth.errors import LmshealthError
from lmshealth.io import reading
from lmshealth.io.column_map import ColumnMap, load_columns
from lmshealth.io.formats import hdf5, isolation
from lmshealth.io.formats.content import Load
from lmshealth.io.manifest import read_manifest
from lmshealth.io.reading import read_log
from lmshealth.io.refusal import Unusable
from lmshealth.stage.description import load_stage
from studies.bad_inputs import logfiles, misbehave
from studies.common.cost import memory_bytes
from studies.harness.claims import Claim, controls_seen, counted
from studies.harness.study import Row, Study

STEP = "read"

N_MUTANTS, N_QUICK, N_TEXTS, N_STORES = 2000, 12, 100, 200
MOST_SECONDS, MOST_MEMORY = 30.0, 1e9
_SEED = 20261125
_N = 400
# Of the study, so that mutants on which a library loops do not take all of its time.
_PATIENCE = "10"
_ACC, _ERROR = "acc_feed_m_s2", "delta_e_um"
_META = {"stage": "demo-Y", "sample_rate_hz": "2000", "travel_km": "1",
         "recorded_at": "2026-03-01T08:30:00+01:00"}  # fmt: skip


def signals() -> dict[str, np.ndarray]:
    """Make the samples of the log, as float32."""
    rng = np.random.default_rng(_SEED)
    return {name: rng.normal(size=_N).astype(np.float32) for name in (_ERROR, _ACC)}


def _hdf5(path: Path, **options: Any) -> None:
    with h5py.File(path, "w") as file:
        for name, values in signals().items():
            file.create_dataset(name, data=values, **options)
        file.attrs.update(_META)


def _parquet(path: Path) -> None:
    table = pa.table(signals()).replace_schema_metadata(_META)
    pq.write_table(table, path, write_page_checksum=True, row_group_size=150)


def _other(path: Path) -> None:
    log = logfiles.LogFile(dict(signals()), dict(_META))
    logfiles.write(logfiles.Archive(path.parent), path, log)


_CHUNKS = {"chunks": (100,), "shuffle": True, "fletcher32": True}
# Name of the file, how it is written, and whether a checksum covers its samples.
FORMS: dict[str, tuple[Callable[[Path], None], bool]] = {
    "log.csv": (_other, False),
    "log.csv.gz": (_other, True),
    "log.parquet": (_parquet, True),
    "lzf.h5": (lambda path: _hdf5(path, compression="lzf", **_CHUNKS), True),
    "gzip.h5": (lambda path: _hdf5(path, compression="gzip", **_CHUNKS), True),
    "plain.h5": (_hdf5, False),
    "log.tdms": (_other, False),
    "log.uff": (_other, False),
    "packed.mat": (lambda path: savemat(path, signals() | _META, do_compression=True), True),
    "plain.mat": (lambda path: savemat(path, signals() | _META), False),
}


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage some bytes; half of all changes are at the beginning or the end, where headers are."""
    for _ in range(int(rng.integers(1, 5))):
        n = max(len(data), 1)
        near = int(rng.integers(min(n, 2048)))
        at = int(rng.choice([near, n - 1 - near, int(rng.integers(n)), int(rng.integers(n))]))
        width = int(rng.choice([1, 2, 4, 8]))
        edges = (0, 1, 2 ** (8 * width - 1), 2 ** (8 * width) - 1, n)
        new = {
            "random": rng.bytes(width),
            "zero": bytes(width),
            "edge": int(edges[rng.integers(5)] % 256**width).to_bytes(width, "little"),
            "bit": bytes([data[at] ^ 1 << int(rng.integers(8))]) if data else b"",
        }
        kind = str(rng.choice([*new, "insert", "cut"], p=[0.2, 0.2, 0.25, 0.25, 0.07, 0.03]))
        if kind == "cut":
            data = data[:at]
        elif kind == "insert":
            data = data[:at] + rng.bytes(width) + data[at:]
        else:
            data = data[:at] + new[kind] + data[at + len(new[kind]) :]
    return data


def outcome(work: Callable[[], object]) -> str:
    """Return what a reader does: its reason, or the kind of a foreign exception."""
    try:
        verdict = work()
    except (LmshealthError, Unusable) as error:
        detail = str(error)
        if "Traceback" in detail or not all(c.isprintable() or c == "\n" for c in detail):
            return "not printable"
        if "crashes as it reads it" in detail:
            return "library crashed: refused"
        return f"refused: {getattr(error, 'reason', type(error).__name__)}"
    except Exception as error:  # what must not happen
        return f"FOREIGN {type(error).__name__}: {str(error)[:100]}"
    return str(verdict)


def judged(path: Path, checked: bool) -> str:
    """Read a log, and compare its samples with those that were written."""
    log = reading.read_log(path)
    for start, stop in log.pieces:
        if not all(np.isfinite(c.values[start:stop]).all() for c in log.channels):
            return "WRONG: samples that are no numbers"
    expected = {"delta_e": 1e-6 * signals()[_ERROR].astype(float), "acc_feed": signals()[_ACC]}
    renamed = False
    for channel in log.channels:
        # No checksum holds the names: of a column with another name the samples must be of one.
        own = [expected[channel.name]] if channel.name in expected else list(expected.values())
        renamed |= channel.name not in expected
        same = (
            channel.values.size == one.size and np.allclose(channel.values, one, rtol=1e-6, atol=0)
            for one in own
        )
        if checked and not any(same):
            return "WRONG: other samples in spite of a checksum"
    return "read, a column has another name" if checked and renamed else "read"


def mutants(name: str, n: int, seconds: float = 1e9) -> Row:
    """Read mutants of a form of the log, as many as are asked for or as the time allows."""
    write, checked = FORMS[name]
    os.environ["LMSHEALTH_MAX_SECONDS"] = _PATIENCE
    counts: Counter[str] = Counter()
    slowest, start, most, own = 0.0, time.monotonic(), 0, memory_bytes()
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        path = Path(folder) / name
        write(path)
        intact = path.read_bytes()
        assert judged(path, True) == "read"
        rng = np.random.default_rng([_SEED, list(FORMS).index(name)])
        for _ in range(n):
            data = mutate(intact, rng)
            path.write_bytes(data)
            before = time.monotonic()
            found = outcome(lambda: judged(path, checked))
            slowest = max(slowest, time.monotonic() - before)
            most = max(most, _memory_of_reader())
            counts[found] += 1
            if bad(found):
                keep = Path(tempfile.gettempdir()) / f"mutant-{counts[found]}-{name}"
                keep.write_bytes(data)
                print(f"{found}: kept as {keep}", file=sys.stderr)
            if time.monotonic() - start > seconds:
                break
    return {"form": name, "mutants": counts.total(), "outcomes": dict(counts),
            "slowest_s": round(slowest, 2),
            "peak_bytes": max(most, memory_bytes() - own)}  # fmt: skip


def bad(found: str) -> bool:
    """Return whether an outcome must not happen."""
    return found.startswith(("FOREIGN", "WRONG", "not printable"))


def _memory_of_reader() -> int:
    """Return the peak memory in bytes of the process that reads files, if it runs."""
    process = isolation._reader.process
    return 0 if process is None else memory_bytes(process=process.pid)


_STAGE = logfiles.DESCRIPTION.encode()
_MAP = b"""sample_rate_hz = 2000
[columns]
delta_e_um = "PE(0)"
acc_x = "AI 3"
[units]
acc_x = 0.0981
[metadata]
stage = "axis-7"
[csv]
delimiter = ";"
skip_rows = 3
"""
_MANIFEST = b"""file,stage,recorded_at,travel_km,temperature_c
log.csv,axis-7,2026-01-05T08:00:00+01:00,0,21.4
other.csv,axis-7,2026-02-02T08:00:00+01:00,310,22.0
"""
_INVISIBLE = "\u00ad\ufeff\u200b\U000e0041\u202e\u2066\u061c"
# Texts that are no settings, for each reader of them.
HOSTILE: tuple[bytes, ...] = (
    b"a." * 60_000 + b"a = 1",
    b"\n".join(b"a" + b".a" * 15 + b".b%d = 1" % k for k in range(2000)),
    b"[" + b"a." * 60_000 + b"a]",
    b'"' * 120_000,
    b"'a'." * 30_000 + b"a = 1",
    b"a = " + b"[" * 60_000,
    b"a = {" + b"b = {" * 20_000,
    b"[[mode]]\n" * 14_000,
    b"x" * 130_000 + b" = 1",
    b"a = 1\n" * 20_000,
    b"x = " + b"9" * 100_000,
    b"\xff\xfe" + "name = 1".encode("utf-16-le"),
    b"file" + b",c%d" * 20_000 % tuple(range(20_000)) + b"\n" + b"a\n" * 20_000,
    b"file\n" + b'"\n' * 200_000,
    b"file\n" + b"a,b\n" * 1_100_000,
    b"file\n../../etc/passwd\n/etc/passwd\n\\\\host\\share\n" + b"." * 100_000,
    *(_STAGE.replace(b'"roll"', f'"roll{c}"'.encode()) for c in _INVISIBLE),
)


def _manifest_rows(path: Path) -> str:
    """Read a manifest, which refuses rows."""
    return "rows refused" if read_manifest(path.parent).refused else "read"


def texts(n: int) -> list[Row]:
    """Read mutated and hostile descriptions, column maps and manifests."""
    readers: dict[str, tuple[bytes, Callable[[Path], object]]] = {
        "stage.toml": (_STAGE, lambda path: load_stage(str(path)) and "read"),
        "columns.toml": (_MAP, lambda path: load_columns(path) and "read"),
        "manifest.csv": (_MANIFEST, _manifest_rows),
    }
    rows = []
    for k, (name, (intact, read)) in enumerate(readers.items()):
        rng = np.random.default_rng([_SEED, 100 + k])
        counts: Counter[str] = Counter()
        slowest = 0.0
        with tempfile.TemporaryDirectory(prefix="texts-") as folder:
            path = Path(folder) / name
            for data in (*HOSTILE, *(mutate(intact, rng) for _ in range(n))):
                path.write_bytes(data)
                start = time.monotonic()
                counts[outcome(lambda read=read, path=path: read(path))] += 1
                slowest = max(slowest, time.monotonic() - start)
        rows.append({"text": name, "cases": counts.total(), "outcomes": dict(counts),
                     "slowest_s": round(slowest, 2)})  # fmt: skip
    return rows


def controls() -> dict[str, bool]:
    """Detect readers that fail, one after the other."""

    def caught(change: Callable[[Any], object]) -> str:
        def read(path: Path) -> Any:
            return change(read_log(path))

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "lzf.h5"
            FORMS["lzf.h5"][0](path)
            reading.read_log = read
            try:
                return outcome(lambda: judged(path, True))
            finally:
                reading.read_log = read_log

    def raise_key(log: Any) -> Any:
        raise KeyError("of a library")

    def change(log: Any) -> Any:
        log.channels[0].values.setflags(write=True)
        log.channels[0].values[3] *= 1.5
        return log

    def isolated(load: Load) -> str:
        form = replace(hdf5.HDF5, load=load)
        with patch.dict(os.environ, LMSHEALTH_MAX_SECONDS="1"):
            return outcome(lambda: isolation.read_isolated(form, Path(__file__), ColumnMap(), 1e9))

    return {
        "an exception of a library": bad(caught(raise_key)),
        "another sample": bad(caught(change)),
        "no fault": caught(lambda log: log) == "read",
        "a reader that ends its process": isolated(misbehave.crash) == "library crashed: refused",
        "a reader that loops": isolated(misbehave.loop) == "refused: too-slow",
        "a reader that takes memory": isolated(misbehave.swell) == "refused: too-large",
    }


def fuzz(seconds: float) -> None:
    """Read mutants of all forms for some seconds, from another seed each time."""
    global _SEED
    _SEED = int.from_bytes(os.urandom(4), "little")
    print(f"seed {_SEED}")
    failed = False
    for name in FORMS:
        row = mutants(name, 1 << 30, seconds / len(FORMS))
        failed |= any(map(bad, row["outcomes"])) or not within([row])
        print(row)
    raise SystemExit(int(failed))


def within(rows: Sequence[Row]) -> bool:
    """Return whether no file took too long or too much memory."""
    return all(
        row["slowest_s"] <= MOST_SECONDS and row.get("peak_bytes", 0) <= MOST_MEMORY for row in rows
    )


def main() -> None:
    """Run the study, or mutate for ``--seconds`` without a record."""
    study = Study(__file__, __doc__, seconds=0.0)
    if study.options.seconds:
        fuzz(study.options.seconds)
    n = N_QUICK if study.quick else N_MUTANTS
    files = study.trials.collect(mutants, [(name, n) for name in FORMS])
    settings = texts(10 if study.quick else N_TEXTS)
    stores = damaged_stores(5 if study.quick else N_STORES)
    seen = controls()
    rows = [*files, *settings, stores]
    answer = {
        "seed": _SEED,
        "mutants_of_files": files,
        "texts": settings,
        "stores": stores,
        "controls": seen,
        "passed": {
            "nothing foreign, nothing wrong in silence": not any(
                bad(found) for row in rows for found in row["outcomes"]
            ),
            "every file within 30 s and 1 GB": within(rows),
            "controls are caught": all(seen.values()),
        },
    }
    study.conclude(answer)


def damaged_stores(n: int) -> Row:
    """Damage a store at random bytes, and read all that it holds."""
    from lmshealth.batch.store import Identified, OutcomeRow, Store, StoreError
    from lmshealth.io.log import Refusal

    held = {
        f"key-{k}": Identified((Refusal(f"log-{k}", "corrupt", "x" * (7 * k)),)) for k in range(80)
    }
    counts: Counter[str] = Counter()
    slowest = 0.0
    rng = np.random.default_rng([_SEED, 200])
    with tempfile.TemporaryDirectory(prefix="stores-") as folder:
        path = Path(folder) / "store.sqlite"
        store = Store(f"sqlite:///{path}")
        for key, one in held.items():
            store.put_identified([OutcomeRow.of(key, f"digest-{key}", one)])
        store.close()
        intact = path.read_bytes()

        def read() -> str:
            try:
                store = Store(f"sqlite:///{path}")
            except StoreError:
                return "refused: StoreError"
            try:
                found = dict(store.identified(held))
            finally:
                store.close()
            other = [key for key, one in found.items() if one.outcome != held[key].outcome]
            return "WRONG: another outcome" if other else "read"

        for _ in range(n):
            path.write_bytes(mutate(intact, rng))
            start = time.monotonic()
            counts[outcome(read)] += 1
            slowest = max(slowest, time.monotonic() - start)
    return {"stores": counts.total(), "outcomes": dict(counts), "slowest_s": round(slowest, 2)}


def claims(answer: Row) -> Iterator[Claim]:
    """Claim that no damage has a consequence for anything but its own file."""
    rows = [*answer["mutants_of_files"], *answer["texts"], answer["stores"]]
    n = sum(sum(row["outcomes"].values()) for row in rows)
    wrong = sum(k for row in rows for found, k in row["outcomes"].items() if bad(found))
    yield counted(
        "damaged files, texts and stores that are refused or read right",
        n - wrong,
        n,
        controls_seen(answer["controls"]),
        met=not wrong,
    )


if __name__ == "__main__":
    main()
