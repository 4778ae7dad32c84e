"""Files: whole or not at all, in their place and nowhere else."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import xarray as xr

from lmshealth._private.files import (
    _is_stream,
    remove_abandoned,
    write_bytes,
    write_draws,
    write_text,
)
from lmshealth.errors import BadTable


def test_folders_are_made_and_nothing_else_is_left(tmp_path: Path) -> None:
    """A text is written as UTF-8, twice over itself, with no partial file left."""
    target = tmp_path / "a" / "b" / "table.csv"
    for text in ("Δe\n", "again\n"):
        write_text(target, text)
        assert target.read_bytes().decode() == text
    assert os.listdir(target.parent) == ["table.csv"]


@pytest.mark.skipif(not Path("/dev/fd").exists(), reason="no streams with names on this system")
def test_a_stream_takes_what_is_written_and_stays(tmp_path: Path) -> None:
    """So does a device: as root, a file in its place would have replaced it for all programs.

    Elsewhere a pipe is replaced: without a reader, who opens it waits without end.
    """
    reader, writer = os.pipe()
    try:
        write_text(Path(f"/dev/fd/{writer}"), "one,")
        write_bytes(Path(f"/dev/fd/{writer}"), b"two")
        assert os.read(reader, 100) == b"one,two"
    finally:
        os.close(reader)
        os.close(writer)
    os.mkfifo(pipe := tmp_path / "pipe")
    (tmp_path / "link").symlink_to(os.devnull)
    others = [tmp_path / name for name in ("link", "", "none", "pipe")]
    assert not any(map(_is_stream, others))
    with TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as shared:
        (link := Path(shared) / "link").symlink_to(os.devnull)
        assert not _is_stream(link)
    assert _is_stream(Path(os.devnull)) and _is_stream(Path("/dev/stdout"))
    write_text(pipe, "a file")
    assert pipe.read_text() == "a file"


def test_a_link_in_the_place_of_a_file_is_replaced(tmp_path: Path) -> None:
    """What the link points to stays as it is, whether it is there or not."""
    outside = tmp_path / "outside.txt"
    outside.write_text("untouched")
    (tmp_path / "out").mkdir()
    for name, end in (("index.html", outside), ("page.html", tmp_path / "absent.txt")):
        target = tmp_path / "out" / name
        target.symlink_to(end)
        write_text(target, "new")
        assert target.read_text() == "new"
        assert not target.is_symlink()
    assert outside.read_text() == "untouched"
    assert not (tmp_path / "absent.txt").exists()


def test_a_file_is_as_readable_as_any_that_its_user_makes(tmp_path: Path) -> None:
    """Others may read a report where the user lets them read new files."""
    (tmp_path / "usual").touch()
    write_text(tmp_path / "ours", "text")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "usual").stat().st_mode


def test_an_interrupted_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until all is written nothing has changed, and the half file goes."""
    target = tmp_path / "table.csv"
    write_text(target, "old")

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", stop)
    with pytest.raises(KeyboardInterrupt):
        write_text(target, "new")
    assert os.listdir(tmp_path) == ["table.csv"]
    assert target.read_text() == "old"


def test_what_is_no_text_is_written_as_its_number(tmp_path: Path) -> None:
    """A lone half of a pair of signs keeps nothing from being written."""
    write_text(tmp_path / "x", "\udcff")
    assert (tmp_path / "x").read_bytes() == b"\\udcff"


def test_a_failure_to_write_is_an_error(tmp_path: Path) -> None:
    """The file and the system's reason are named."""
    (tmp_path / "file").touch()
    for target in (tmp_path / "file" / "below", tmp_path / ("long" * 100)):
        with pytest.raises(BadTable, match=r"cannot be written: [A-Z]"):
            write_bytes(target, b"")


HOLD = """
import sys, time
from pathlib import Path
from tempfile import TemporaryDirectory
from lmshealth._private.files import replacing
with replacing(Path(sys.argv[1])) as stream:
    print("writing", flush=True)
    time.sleep(60)
"""


def test_only_incomplete_files_of_killed_writers_are_removed(tmp_path: Path) -> None:
    """A file that another process writes stays until that is killed; other names stay for good."""
    pytest.importorskip("fcntl", reason="Windows removes no open file")
    others = [tmp_path / name for name in (".part", "a.part", ".0123.part", ".git")]
    for path in others:
        path.write_text("")
    command = [sys.executable, "-c", HOLD, str(tmp_path / "target.csv")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=Path(__file__).parents[1]) as writer:
        assert writer.stdout is not None and writer.stdout.readline()
        (part,) = set(tmp_path.iterdir()) - set(others)
        remove_abandoned(tmp_path)
        assert part.exists()
        writer.kill()
    remove_abandoned(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted(others)


def test_machines_whose_groups_would_have_one_name_keep_their_draws(tmp_path: Path) -> None:
    """A slash is none of a group's name: names that become equal are numbered."""
    machines = ["A/1", "A_1", "A/2", "a-2", "A_2"]
    trees = [
        xr.DataTree.from_dict({"posterior": xr.Dataset({"x": float(k)})})
        for k in range(len(machines))
    ]
    write_draws(tmp_path / "draws.nc", machines, trees)
    with xr.open_datatree(tmp_path / "draws.nc", engine="h5netcdf") as found:
        values = {name: float(found[f"{name}/posterior"]["x"]) for name in found.children}
    assert values == {"A_1-2": 0, "A_1": 1, "A_2-2": 2, "a-2": 3, "A_2": 4}


def test_draws_replace_a_link_and_leave_what_it_names(tmp_path: Path) -> None:
    """Draws appear whole under their name, as tables do."""
    other, link = tmp_path / "other", tmp_path / "draws.nc"
    other.write_text("kept")
    link.symlink_to(other)
    write_draws(link, ["A"], [xr.DataTree.from_dict({"posterior": xr.Dataset({"x": 1.0})})])
    assert other.read_text() == "kept"
    assert not link.is_symlink()
    with xr.open_datatree(link, engine="h5netcdf") as found:
        assert float(found["posterior"]["x"]) == 1.0
