"""Links and paths out of a folder: refused, followed on request, and never quoted."""

import os
from pathlib import Path

import pytest
from click.testing import CliRunner

from lmshealth._private.files import read_table
from lmshealth.cli.main import main
from lmshealth.errors import BadStage, BadTable
from lmshealth.io.column_map import load_columns
from lmshealth.io.manifest import find_logs, read_manifest
from lmshealth.stage.description import load_stage

SHIPPED = Path(__file__).parents[1] / "lmshealth" / "stage" / "descriptions"
SECRET = "what-nobody-may-see"


@pytest.fixture
def stage(tmp_path):
    """Write a description whose modal map may lie anywhere, and return how."""
    (tmp_path / "inside").mkdir()
    (tmp_path / "outside.csv").write_bytes((SHIPPED / "lms-y.map.csv").read_bytes())
    (tmp_path / "secret.csv").write_text(f'{SECRET}\n"{SECRET}",1,{SECRET}\n')
    text = (SHIPPED / "lms-y.toml").read_text("utf-8")

    def write(file: object) -> str:
        path = tmp_path / "inside" / "stage.toml"
        path.write_text(text.replace('"lms-y.map.csv"', f'"{file}"'), "utf-8")
        return str(path)

    return write


@pytest.mark.parametrize("way", ["parts", "absolute", "symlink"])
def test_maps_outside(stage, tmp_path, way):
    """A map out of the folder of its description is read only with follow_links."""
    (tmp_path / "inside" / "link.csv").symlink_to("../outside.csv")
    file = {"parts": "../outside.csv", "absolute": tmp_path / "outside.csv", "symlink": "link.csv"}
    path = stage(file[way])
    with pytest.raises(BadStage, match=r"map\.file: it leaves the folder .* --follow-links"):
        load_stage(path)
    assert load_stage(path, follow_links=True).modal_map is not None


@pytest.mark.parametrize("file", ["/etc/passwd", "../secret.csv", "../binary"])
def test_content_is_not_quoted(stage, tmp_path, file):
    """Nothing of a file that is no map is quoted, even if it may be read."""
    (tmp_path / "binary").write_bytes(SECRET.encode() + bytes(range(256)))
    for follow in (False, True):
        with pytest.raises(BadStage) as caught:
            load_stage(stage(file), follow_links=follow)
        assert SECRET not in str(caught.value) and "root:" not in str(caught.value)
        assert "Error tokenizing" not in str(caught.value)


@pytest.mark.parametrize("file", ["a\\u0000b", "\\u202Ecba", "a\\u200Bb", "é" * 200, "x" * 10_000])
def test_a_map_of_a_name_that_no_file_has(stage, file):
    """Names with NUL or invisible characters, and very long ones, are errors in clear text."""
    with pytest.raises(BadStage, match=r"map\.file: ") as caught:
        load_stage(stage(file))
    assert str(caught.value).isprintable() and len(str(caught.value)) < 1000


@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_no_device_is_read(tmp_path, kind):
    """Pipes and devices are refused before they are opened, by links too."""
    path = tmp_path / "columns.toml"
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    with pytest.raises(BadTable, match="no regular file"):
        load_columns(path)
    with pytest.raises(BadStage, match="no regular file"):
        load_stage(str(path))
    with pytest.raises(OSError, match="no regular file"):
        read_table(path)


def test_logs_outside(tmp_path):
    """Links out of a folder of logs are refused with the option that follows them."""
    folder, outside = tmp_path / "logs", tmp_path / "outside"
    for one in (folder, outside):
        one.mkdir()
    (outside / "log.csv").write_text("acc_x_g\n1\n")
    (outside / "manifest.csv").write_text("file,stage\nlog.csv,axis-7\n")
    for name in ("log.csv", "manifest.csv"):
        (folder / name).symlink_to(outside / name)
    (folder / "device.csv").symlink_to("/dev/zero")
    found = find_logs(folder)
    assert not found.logs and {one.reason for one in found.refused} == {"escapes"}
    assert "--follow-links" in found.refused[-1].detail
    assert not read_manifest(folder).rows
    found = find_logs(folder, follow_links=True)
    assert found.logs == (folder / "log.csv",)
    assert [(one.log, one.reason) for one in found.refused] == [("device.csv", "missing-file")]
    manifest = read_manifest(folder, follow_links=True)
    assert manifest.overrides(folder / "log.csv") == {"stage": "axis-7"}


def test_option(stage, tmp_path):
    """The command line has the option, wherever it stands."""
    path = stage("../outside.csv")
    refused = CliRunner().invoke(main, ["plan", "--stage", path])
    assert refused.exit_code and "--follow-links" in refused.output + refused.stderr
    for words in ([path, "--follow-links"], ["--follow-links", path]):
        assert CliRunner().invoke(main, ["stage", *words]).exit_code == 0
