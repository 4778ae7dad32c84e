"""Folders of logs and their manifests."""

import os
from unicodedata import normalize

import pytest

from lmshealth.errors import BadLog, BadTable
from lmshealth.io.manifest import (
    MISSPELT,
    find_logs,
    name_of,
    read_manifest,
    read_rows,
    to_moments,
    to_numbers,
)
from lmshealth.io.reading import read_log

HEADER = "file,stage,travel_km,baseline\n"


def test_find_logs(tmp_path):
    """Logs are found by suffix, sorted; tables, texts and hidden files are none."""
    (tmp_path / "sub").mkdir()
    (tmp_path / ".git").mkdir()
    names = ["b.csv", "a.H5", "sub/c.csv.gz", "sub/manifest.csv", "maintenance.csv", "truth.csv"]
    for name in [*names, "notes.txt", "d.txt.gz", "sub/x.dat", ".git/d.csv", "._b.csv"]:
        (tmp_path / name).write_bytes(b"")
    found = find_logs(tmp_path)
    logs, refused = found
    assert (logs, refused) == (found.logs, found.refused)
    names = [str(p.relative_to(tmp_path)) for p in found.logs]
    assert names == ["a.H5", "b.csv", "d.txt.gz", "sub/c.csv.gz"]
    assert found.refused == ()


def test_links(tmp_path):
    """Links out of the folder, dangling links and pipes are refused; links inside are followed."""
    outside, root = tmp_path / "outside", tmp_path / "root"
    outside.mkdir()
    root.mkdir()
    (outside / "x.csv").write_bytes(b"")
    (root / "real.csv").write_bytes(b"")
    (root / "a.csv").symlink_to(outside / "x.csv")
    (root / "b.csv").symlink_to(root / "real.csv")
    (root / "c.csv").symlink_to(root / "gone.csv")
    (root / "d").symlink_to(outside)
    (root / "loop").symlink_to(root)
    os.mkfifo(root / "e.csv")
    found = find_logs(root)
    assert [p.name for p in found.logs] == ["b.csv", "real.csv"]
    refused = {r.log: r.reason for r in found.refused}
    assert refused == {
        "a.csv": "escapes",
        "d": "escapes",
        "c.csv": "missing-file",
        "e.csv": "missing-file",
    }


def test_manifest_overrides(make, tmp_path):
    """A row overrides the file; a manifest nearer to the log overrides the others."""
    (tmp_path / "sub").mkdir()
    path = make("sub/log.csv")
    (tmp_path / "manifest.csv").write_text(HEADER + "sub/log.csv,up,1,true\n")
    (tmp_path / "sub/manifest.csv").write_text("file, stage,remark\nlog.csv, near,x\n")
    manifest = read_manifest(tmp_path)
    log = read_log(path, overrides=manifest.overrides(path))
    assert (log.metadata.stage, log.metadata.travel, log.metadata.baseline) == ("near", 1e3, True)
    assert manifest.refused == () and manifest.overrides(tmp_path / "other.csv") == {}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_manifests_as_spreadsheets_write_them(make, tmp_path, delimiter, encoding):
    """Semicolons where the decimal mark is a comma, tabs in UTF-16; cells may have other marks."""
    path, other = make("größe.csv"), make("two.csv")
    rows = ["file,stage,travel_km,remark", "größe.csv,A,1.5,", "two.csv,B,2,one more"]
    text = "\r\n".join(rows).replace(",", delimiter) + (" or" if delimiter == "," else ", or")
    (tmp_path / "manifest.csv").write_bytes(text.encode(encoding))
    manifest = read_manifest(tmp_path)
    assert manifest.overrides(path) == {"stage": "A", "travel_km": "1.5"}
    assert read_log(path, overrides=manifest.overrides(path)).metadata.travel == 1500.0
    assert manifest.overrides(other)["stage"] == "B"


def test_a_number_with_a_decimal_comma_is_quoted(make, tmp_path):
    """It is not known whether 1,234 is more than one: the log is refused, its row quoted."""
    path = make("log.csv")
    (tmp_path / "manifest.csv").write_text("file;stage;travel_km\nlog.csv;A;1,234\n")
    with pytest.raises(BadLog, match=r"travel_km.*1,234") as caught:
        read_log(path, overrides=read_manifest(tmp_path).overrides(path))
    assert caught.value.reason == "metadata"


def test_a_misspelt_column_is_noticed(make, tmp_path):
    """It is quoted with the nearest key; columns of the user's own, and known ones, are not."""
    make("log.csv")
    names = "file,stage,Travel KM,temperatur_c,payload,payload_kg,remark,operator,shift"
    (tmp_path / "manifest.csv").write_text(f"{names}\nlog.csv,A,1,20,x,3,y,z,2\n")
    manifest = read_manifest(tmp_path)
    assert [(one.log, one.reason) for one in manifest.refused] == [("manifest.csv", MISSPELT)] * 2
    assert [one.detail for one in manifest.refused] == [
        "column Travel KM is not read, unlike travel_km; rename it if that is meant",
        "column temperatur_c is not read, unlike temperature_c; rename it if that is meant",
    ]
    assert manifest.overrides(tmp_path / "log.csv") == {"stage": "A", "payload_kg": "3"}


@pytest.mark.parametrize(("of_file", "of_row"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_accents_are_composed_or_not(make, tmp_path, of_file, of_row):
    """A name is the same with its accents as letters of their own, as macOS writes them."""
    path = make(normalize(of_file, "größe.csv"))
    (tmp_path / "manifest.csv").write_text(HEADER + normalize(of_row, "größe.csv") + ",one,1,\n")
    manifest = read_manifest(tmp_path)
    assert manifest.refused == () and manifest.overrides(path)["stage"] == "one"


def test_no_manifest(tmp_path):
    """A folder may have no manifest."""
    assert read_manifest(tmp_path).rows == {}


def test_bad_value_refuses_one_log(make, tmp_path):
    """A bad cell refuses its log and no other."""
    path = make("log.csv")
    (tmp_path / "manifest.csv").write_text(HEADER + "log.csv,A,many,\n")
    with pytest.raises(BadLog, match="travel_km is 'many'"):
        read_log(path, overrides=read_manifest(tmp_path).overrides(path))


def test_rows_without_log(tmp_path):
    """Rows that leave the folder or name nothing are refused, the others count."""
    (tmp_path / "in").mkdir()
    (tmp_path / "x.csv").write_bytes(b"")
    (tmp_path / "in/manifest.csv").write_text(
        HEADER + "../x.csv,A,1,\n/etc/passwd,A,1,\nno.csv,A,,\n"
    )
    refused = read_manifest(tmp_path / "in").refused
    assert [r.reason for r in refused] == ["escapes", "escapes", "missing-file"]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"", "empty"),
        (b"stage\nA\n", "columns"),
        (b"file,file\na,b\n", "columns"),
        (b"file stage\na b\n", "columns"),
        ("file,stage\na,b\n".encode("utf-16-le"), "columns"),  # without its mark
    ],
)
def test_manifests_that_say_nothing(tmp_path, text, reason):
    """A table that cannot be understood as a whole is one refusal, under its name."""
    (tmp_path / "manifest.csv").write_bytes(text)
    manifest = read_manifest(tmp_path)
    assert [(r.log, r.reason) for r in manifest.refused] == [("manifest.csv", reason)]
    assert manifest.rows == {}


def test_bad_rows_cost_their_log_only(make, tmp_path):
    """A log whose row cannot be read or is contradicted is refused; the rows around it count."""
    logs = {name: make(f"{name}.csv") for name in "abcde"}
    (tmp_path / "manifest.csv").write_bytes(
        b"file,stage,travel_km,remark\n"
        b"a.csv,A,1,\xff is not used\n"
        b"b.csv,B,1,,too,many\n"
        b'c.csv,"C,1,\n'
        b"d.csv,D,1,,,\n"
        b",E,1,\n"
        b"e.csv,E,1,\n./e.csv,E,2,\n./d.csv,D,1,twice the same\n"
        b"f\0.csv,F,1,\n"
    )
    manifest = read_manifest(tmp_path)
    assert manifest.overrides(logs["a"]) == {"stage": "A", "travel_km": "1"}
    assert manifest.overrides(logs["d"]) == {"stage": "D", "travel_km": "1"}
    for name, needle in {
        "b": "line 3 of manifest.csv: 6 cells",
        "c": "line 4",
        "e": "another row",
    }.items():
        with pytest.raises(BadLog, match=needle) as caught:
            manifest.overrides(logs[name])
        assert caught.value.reason == "bad-row"
    assert [(r.log, r.reason, r.detail.split(":")[0]) for r in manifest.refused] == [
        ("manifest.csv", "bad-row", "line 6"),
        ("manifest.csv", "bad-row", "line 10"),
    ]


def test_names_are_fit_to_be_printed_and_differ(tmp_path):
    """Control characters, turned writing and foreign bytes are escaped; no two names become one."""
    names = [b"a\x1b[31m.csv", b"a\\x1b[31m.csv", b"\xff.csv", b"\xfe.csv", "\u202eb.csv".encode()]
    for name in names:
        open(os.path.join(os.fsencode(tmp_path), name), "wb").close()
    shown = [name_of(path, tmp_path) for path in find_logs(tmp_path).logs]
    assert len(set(shown)) == len(names)
    assert all(name.isprintable() for name in shown)
    assert {r"a\x1b[31m.csv", r"a\\x1b[31m.csv", r"\udcff.csv", r"\u202eb.csv"} <= set(shown)


def write_samples(path, n=200):
    """Write rows of numbers below a header."""
    path.parent.mkdir(exist_ok=True)
    path.write_text("time_s;acc_x_m_s2\n" + "".join(f"{k * 1e-3};-1,5e-3\n" for k in range(n)))
    return path


def test_texts_that_hold_samples_are_logs(tmp_path):
    """Rows of numbers decide, not the suffix; notes, short tables, JSON and copies are no logs."""
    write_samples(tmp_path / "a.txt")
    write_samples(tmp_path / "b.dat", 10_000)
    (tmp_path / "c.asc").write_text((tmp_path / "a.txt").read_text(), encoding="utf-16")
    write_samples(tmp_path / "short.txt", 99)
    (tmp_path / "notes.txt").write_text("2026-01-05 the belt was loose\n" * 500)
    (tmp_path / "events.dat").write_text("2026-01-05 08:00:00 started\n" * 5000)
    (tmp_path / "x.json").write_text("[\n" + "1.5,\n" * 500)
    (tmp_path / "photo.dat").write_bytes(bytes(range(256)) * 500)
    for name in ("a.txt.bak", "a.txt~"):
        write_samples(tmp_path / name)
    os.mkfifo(tmp_path / "pipe.txt")
    found = find_logs(tmp_path)
    assert [path.name for path in found.logs] == ["a.txt", "b.dat", "c.asc"]
    assert found.refused == ()


def test_samples_under_another_suffix_are_refused(tmp_path):
    """They are no notes, and their format is not known."""
    write_samples(tmp_path / "a.prn")
    found = find_logs(tmp_path)
    assert [(r.log, r.reason) for r in found.refused] == [("a.prn", "skipped")] and not found.logs


def test_every_row_of_a_manifest_is_a_log_or_a_refusal(tmp_path):
    """A listed file is read whatever its suffix; one that is hidden, a table or gone is refused."""
    (tmp_path / "in").mkdir()
    names = ["a.txt", "in/b.prn", ".hidden.csv", "truth.csv"]
    for name in names:
        (tmp_path / name).write_text("notes\n")
    rows = [f"{name},A,1," for name in (*names, "in/gone.csv")]
    (tmp_path / "manifest.csv").write_text(HEADER + "\n".join(rows) + "\n")
    (tmp_path / "in" / "manifest.csv").write_text(HEADER + "gone too.csv,A,1,\n")
    manifest = read_manifest(tmp_path)
    found = find_logs(tmp_path, manifest=manifest)
    assert [name_of(path, tmp_path) for path in found.logs] == ["a.txt", "in/b.prn"]
    assert {r.log: r.reason for r in (*found.refused, *manifest.refused)} == {
        ".hidden.csv": "bad-row",
        "truth.csv": "bad-row",
        "in/gone.csv": "missing-file",
        "in/gone too.csv": "missing-file",
    }


def test_only_a_register_of_logs_omits_logs(tmp_path):
    """A table of corrections lists what it corrects; one of machines and dates lists all logs."""
    (tmp_path / "in").mkdir()
    (tmp_path / "manifest.csv").write_text("file,travel_km\nin/a.csv,1\n")
    for name in ("a.csv", "b.csv"):
        (tmp_path / "in" / name).write_bytes(b"")
    assert not read_manifest(tmp_path).omits(tmp_path / "in" / "b.csv")
    register = "file,stage,recorded_at\na.csv,A,2026-01-05T08:00:00Z\n"
    (tmp_path / "in" / "manifest.csv").write_text(register)
    manifest = read_manifest(tmp_path)
    assert manifest.omits(tmp_path / "in" / "b.csv")
    assert not manifest.omits(tmp_path / "in" / "a.csv")
    assert not manifest.omits(tmp_path / "c.csv")


def test_no_folder(tmp_path):
    """Anything but a folder is an error."""
    for verb in (find_logs, read_manifest):
        with pytest.raises(BadTable, match="no folder"):
            verb(tmp_path / "absent")


@pytest.mark.parametrize(
    "text", ["a,b\n1,2\n\n \n3,x\n", "\ufeff\na,b\n\n1,2,\n3,x,\n", "a,b\n\n,\n\n3,x"]
)
def test_lines_of_a_table_are_those_of_the_file(tmp_path, text):
    """Blank lines above, below the names and between rows are counted, and hold no row."""
    path = tmp_path / "table.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(BadTable, match="line 5: b is 'x'"):
        to_numbers(path, read_rows(path, ()), ["b"])
    path.write_text(text.replace("b", "recorded_at", 1).replace("2", "2026-01-05T08:00Z"), "utf-8")
    with pytest.raises(BadTable, match="line 5: recorded_at is 'x'"):
        to_moments(path, read_rows(path, ()))
