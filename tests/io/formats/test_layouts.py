"""Layouts of text: shipped ones against samples, the example of the README, and wrong ones."""

from __future__ import annotations

import json
import pickle
import re
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import scipy.signal
from click.testing import CliRunner

from lmshealth._private.toml import decode
from lmshealth.batch.ingest import _Task
from lmshealth.cli.main import main
from lmshealth.errors import BadLog, BadTable
from lmshealth.io.column_map import ColumnMap, Layout, load_columns, load_layouts
from lmshealth.io.formats import dialect
from lmshealth.io.formats.dialect import Dialect, stated_dialect
from lmshealth.io.reading import read_log
from lmshealth.io.refusal import Unusable
from lmshealth.stage.proposal import moment_of

SHIPPED = Path(dialect.__file__).parent / "layouts"
SAMPLES = sorted((Path(__file__).parent / "layouts").iterdir())
# Names and units of the columns of each sample, its sample rate in Hz, and lines of its header.
HELD = {
    "klipper": ("time [s], accel_x [mm/s²], accel_y [mm/s²], accel_z [mm/s²]", None, 2),
    "labview": ("time [s], feed [m/s^2], pitch [g], Comment []", 1000, 16),
    "pi_gcs_array": ("Position Error [], Accel []", 1000, 10),
    "rigol": ("X [], CH1 [Volt], CH2 [Volt]", 1000, 2),
    "twincat_scope": ("time [ms], feed [m/s^2], pitch [mm/s^2], time [ms], slow [m/s^2]", 1000, 15),
}
RATE, FREQUENCY, DAMPING = 2000, 126.4, 0.015


def head_of(path: Path) -> list[str]:
    """Return the lines of a file."""
    return path.read_text(encoding="utf-8").splitlines(keepends=True)


def dialect_of(path: Path, *layouts: Layout) -> Dialect:
    """Return the dialect that a layout states."""
    found = stated_dialect(head_of(path), ColumnMap(layouts=layouts))
    assert found is not None
    return found


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda path: path.name)
def test_a_sample_is_recognised_by_its_layout_alone(sample: Path) -> None:
    """Every shipped layout has a sample; columns, units and rate are read from its header."""
    assert {path.stem for path in SAMPLES} == {path.stem for path in SHIPPED.glob("*.toml")}
    text = sample.read_text(encoding="utf-8")
    (own,) = [one for one in load_layouts(SHIPPED) if one.recognises(text)]
    assert own == decode((SHIPPED / f"{sample.stem}.toml").read_bytes(), Layout)
    found = dialect_of(sample)
    columns, rate, start = HELD[sample.stem]
    assert ", ".join(f"{one.name} [{one.unit}]" for one in found.channels) == columns
    of_one = found.channels[1].rate
    assert of_one == (None if rate is None else pytest.approx(rate))
    assert found.start == start


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda path: path.name)
@pytest.mark.parametrize("filling", [" ", "\t", ",", "a,", "# NAME0 = ", "Start,Increment", "1"])
def test_a_hostile_header_is_read_in_linear_time(sample: Path, filling: str) -> None:
    """The patterns of shipped layouts do not go back: long lines of any kind take no minutes."""
    lines = head_of(sample)[:20]
    long = filling * (20_000 // len(filling))
    begin = time.process_time()
    for k, line in enumerate(lines):
        for part in (line.strip(), *re.findall(r"^.*?[=,\t]", line)):
            with suppress(Unusable):
                stated_dialect([*lines[:k], f"{part}{long}\n", *lines[k + 1 :]], ColumnMap())
    assert time.process_time() - begin < 2


@pytest.fixture(scope="module")
def example() -> tuple[str, str]:
    """Return layout and beginning of a file from the README."""
    page = (SHIPPED.parents[1] / "README.md").read_text(encoding="utf-8")
    section = page.partition("## Add a vendor")[2].partition("\n## ")[0]
    (layout,) = re.findall(r"^```toml\n(.*?)^```$", section, re.S | re.M)
    (sample,) = re.findall(r"^```text\n(.*?)^```$", section, re.S | re.M)
    return layout, sample


@pytest.fixture
def folder(tmp_path: Path, example: tuple[str, str]) -> Path:
    """Write the layout, and a file that goes on with the response of a mode to noise."""
    layout, sample = example
    (tmp_path / "layouts").mkdir()
    (tmp_path / "layouts" / "acme.toml").write_text(layout, encoding="utf-8")
    w = 2 * np.pi * FREQUENCY
    equation = np.array([1.0, 0.0, 0.0]), np.array([1.0, 2 * DAMPING * w, w**2])
    mode = scipy.signal.cont2discrete(equation, 1 / RATE)
    noise = np.random.default_rng(3).normal(0, 1, (2, 10 * RATE))
    x = scipy.signal.lfilter(mode[0][0], mode[1], noise[0]) + 0.1 * noise[1]
    rows = [f"{k};{a:.5f};{b:.5f}".replace(".", ",") for k, (a, b) in
            enumerate(zip(x.tolist(), noise[1].tolist(), strict=True), 4)]  # fmt: skip
    (tmp_path / "log.txt").write_text(sample + "\n".join([*rows, ""]), encoding="utf-8")
    return tmp_path


def test_the_example_of_the_page_is_read(folder: Path) -> None:
    """The command line identifies the mode by the layout, and reads no such file without it."""
    command = ["modes", str(folder / "log.txt"), "--band", "80", "180", "--format", "json"]
    answer = CliRunner().invoke(main, [*command, "--layouts", str(folder / "layouts")])
    assert answer.exit_code == 0, answer.output
    (mode,) = json.loads(answer.stdout)["modes"]
    assert mode["frequency_hz"] == pytest.approx(FREQUENCY, abs=3 * mode["frequency_std_hz"])
    assert CliRunner().invoke(main, command).exit_code != 0
    columns = ColumnMap(layouts=load_layouts(folder / "layouts"))
    log = read_log(folder / "log.txt", columns=columns)
    assert [channel.name for channel in log.channels] == ["acc_Feed", "acc_Pitch"]
    assert (log.sample_rate, log.metadata.stage) == (RATE, "axis-7")
    moment, where = moment_of(folder / "log.txt", log, columns.layouts)
    assert moment.startswith("2026-01-05T08:15:30") and "header" in where


def test_init_reads_by_layouts(folder: Path) -> None:
    """The proposal is tried with the layouts, and the next command names them."""
    layouts = str(folder / "layouts")
    given = [str(folder / "log.txt"), "--out", str(folder), "--layouts", layouts]
    answer = CliRunner().invoke(main, ["init", *given])
    assert answer.exit_code == 0, answer.output
    assert f"--layouts {layouts}" in " ".join(answer.output.split())
    assert set(load_columns(folder / "map.toml").columns.values()) == {"Feed", "Pitch"}


def test_a_layout_of_the_user_does_not_read_files_of_others(folder: Path) -> None:
    """Samples of other programs, and plain tables, are read as without it."""
    own = load_layouts(folder / "layouts")
    for sample in SAMPLES:
        assert dialect_of(sample, *own) == dialect_of(sample)
    plain = ["time_s,acc_x_g\n", *(f"{k / 1000},{k % 3}\n" for k in range(50))]
    assert stated_dialect(plain, ColumnMap(layouts=own)) is None


def test_a_file_of_two_layouts_is_refused(folder: Path) -> None:
    """Both are named; one of the same name replaces a shipped one."""
    text = (folder / "layouts" / "acme.toml").read_text(encoding="utf-8")
    (folder / "layouts" / "other.toml").write_text(text.replace("ACME rec", "The rec", 1), "utf-8")
    layouts = load_layouts(folder / "layouts")
    assert len(layouts) == 2
    with pytest.raises(BadLog, match="ACME recorder, The recorder are its layouts; give recognise"):
        read_log(folder / "log.txt", columns=ColumnMap(layouts=layouts))
    (klipper,) = [one for one in load_layouts(SHIPPED) if one.name.startswith("Klipper")]
    (sample,) = [path for path in SAMPLES if path.stem == "klipper"]
    text = (SHIPPED / "klipper.toml").read_text(encoding="utf-8").replace("mm/s²", "g")
    (folder / "layouts" / "other.toml").write_text(text, encoding="utf-8")
    own = [one for one in load_layouts(folder / "layouts") if one.name == klipper.name]
    assert [one.unit for one in dialect_of(sample, *own).channels[1:]] == ["g"] * 3


@pytest.mark.parametrize(
    ("old", "new", "needed"),
    [
        ('name = "ACME recorder"\n', "", "name: missing"),
        ("decimal", "decimals", "decimals: unknown key.*most like it is decimal"),
        (r"'\AACME recorder', ", "'(', ", r"recognise: '\(' is no regular expression"),
        (r"'\AACME recorder', ", "'a{99999999999}', ", "is no regular expression"),
        ("names = '^(Channel{d}", "names = '^([C-{d}]hannel", "is no regular expression"),
        (r"['\AACME recorder', '^\[Data\]']", "['^[A-Z0-9]', ';']", "also fits other tables"),
        ('delimiter = ";"', 'delimiter = ";;"', "got ';;', needed one character, or a group"),
        ('decimal = ","', "decimal = 7", "Expected"),
        ("stage = ", "machine = ", "metadata: got machine; known keys are stage"),
        ("[start]", "[start]\nzone = 1", "start.zone: unknown key"),
    ],
)
def test_a_wrong_layout_is_refused(folder: Path, old: str, new: str, needed: str) -> None:
    """The file, the key, what was found and what is needed are named before a log is read."""
    path = folder / "layouts" / "acme.toml"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(BadTable, match=f"(?s)acme.toml: .*{needed}"):
        load_layouts(path.parent)
    answer = CliRunner().invoke(main, ["modes", "none.csv", "--layouts", str(path.parent)])
    assert answer.exit_code != 0 and "acme.toml" in answer.output


def test_a_folder_has_layouts_of_different_names(folder: Path) -> None:
    """A folder without layouts, and two of one name, are refused."""
    with pytest.raises(BadTable, match=r"holds no layout; needed files \*.toml"):
        load_layouts(folder / "nothing")
    text = (folder / "layouts" / "acme.toml").read_text(encoding="utf-8")
    (folder / "layouts" / "b.toml").write_text(text, encoding="utf-8")
    with pytest.raises(BadTable, match="another file of the folder has 'ACME recorder'"):
        load_layouts(folder / "layouts")


@pytest.mark.parametrize(
    ("old", "new", "reason", "needed"),
    [
        ("rows_after = '^", "rows_after = '^Never", "corrupt", "is a ACME recorder without a line"),
        ('delimiter = ";"', "delimiter = '^Axis(:..)'", "corrupt", "the delimiter ': a'"),
        (
            'delimiter = ";"',
            'delimiter = ","',
            "corrupt",
            "the delimiter ',', the decimal mark ','",
        ),
        ("names = '^", "names = '^No", "corrupt", "its header has no row of names"),
        ("rows_after", "required = ['Gain']\nrows_after", "corrupt", "without a line Gain before"),
        ('"%d.%m', '"%d/%m', "metadata", "starts at '05.01.2026 08:15:30', no %d/%m"),
    ],
)
def test_a_header_without_what_its_layout_needs_is_refused(
    folder: Path, old: str, new: str, reason: str, needed: str
) -> None:
    """The file was recognised: it is read by no other layout and not guessed."""
    path = folder / "layouts" / "acme.toml"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    columns = ColumnMap(layouts=load_layouts(path.parent))
    with pytest.raises(BadLog, match=needed) as caught:
        read_log(folder / "log.txt", columns=columns)
    assert caught.value.reason == reason


def test_a_log_that_is_read_by_another_layout_is_another_log(folder: Path) -> None:
    """Layouts are a part of the key of a result, and reach other processes."""
    columns = ColumnMap(layouts=load_layouts(folder / "layouts"))
    path = folder / "log.txt"
    copied = pickle.loads(pickle.dumps(columns))
    tasks = (_Task(path, "log", {}, "digest", how) for how in (None, ColumnMap(), columns, copied))
    keys = {task.key("stage") for task in tasks}
    assert len(keys) == 3


NUMBERED = """
name = "numbered"
recognise = ['\\ALogger']
rows_after = '^$'
delimiter = "\\t"
names = '^CH(?P<column>\\d): (.*)'
interval = '^Step: (.*) us'
interval_unit = "us"
[start]
find = ['^T0 (.*)']
format = "unix"
"""


def test_values_in_a_line_for_each_column(tmp_path: Path) -> None:
    """Columns count from 1 where there is a last one; units stand behind names."""
    (tmp_path / "numbered.toml").write_text(NUMBERED, encoding="utf-8")
    (layout,) = load_layouts(tmp_path)
    head = ["Logger\n", "CH2: b [g]\n", "CH1: a (mm)\n", "Step: 500 us\n", "T0 86400\n", "\n"]
    found = stated_dialect([*head, "1,5\t2\n"], ColumnMap(layouts=(layout,)))
    assert found is not None
    assert [(c.name, c.unit) for c in found.channels] == [("a", "mm"), ("b", "g")]
    assert [c.rate for c in found.channels] == pytest.approx([2000, 2000])
    assert (found.decimal, found.start) == (",", 6)
    assert found.metadata == {"recorded_at": "1970-01-02T00:00:00+00:00"}
