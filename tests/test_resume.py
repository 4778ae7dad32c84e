"""Long studies go on after an interruption, with what was done by the same code alone."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from studies.harness import provenance
from studies.harness.study import Trials

SCRIPT = '''
from lmshealth.calibration.ranks import place

SCALE = 2.0
done = []


def draw(kind, number, power=1):
    """Draw one."""
    done.append((kind, number))
    return {"kind": kind, "draw": scaled(number) ** power, "none": float("nan")}


def scaled(number):
    return SCALE * number / 3  # no round number


def outcomes(rows):
    return len(rows)
'''
TASKS = [("a", k) for k in range(5)] + [("b", 0)]


def forget() -> None:
    """Forget what was known of all code."""
    for one in vars(provenance).values():
        if hasattr(one, "cache_clear"):
            one.cache_clear()


@pytest.fixture
def written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Write a script as a module, and forget what was known of all code."""

    def write(text: str) -> ModuleType:
        path = tmp_path / "script.py"
        path.write_text(text)
        forget()
        spec = spec_from_file_location("script_of_a_study", path)
        assert spec is not None and spec.loader is not None
        module = module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "script_of_a_study", module)
        spec.loader.exec_module(module)
        return module

    yield write
    forget()


def test_interrupted_goes_on(written: Any, tmp_path: Path) -> None:
    """A study that was interrupted does the rest only, and has the result of one that was not."""
    script, path = written(SCRIPT), tmp_path / "kept" / "study.jsonl"

    def failing(kind: str, number: int) -> Any:
        if (kind, number) == ("a", 3):
            raise KeyboardInterrupt
        return script.draw(kind, number)

    failing.__module__, failing.__qualname__ = "script_of_a_study", "draw"
    with pytest.raises(KeyboardInterrupt):
        Trials(path).collect(failing, TASKS)
    script.done.clear()
    found = Trials(path).collect(script.draw, TASKS)
    assert script.done == TASKS[3:]
    assert json.dumps(found) == json.dumps(Trials(None).collect(script.draw, TASKS))


def test_line_cut_off(written: Any, tmp_path: Path) -> None:
    """What was being written when a study ended is done again, and nothing else."""
    script, path = written(SCRIPT), tmp_path / "study.jsonl"
    whole = Trials(path).collect(script.draw, TASKS)
    path.write_text(path.read_text()[:-20])
    script.done.clear()
    again = Trials(path).collect(script.draw, TASKS)
    assert script.done == TASKS[-1:]
    assert json.dumps(again) == json.dumps(whole)


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        ("SCALE = 2.0", "SCALE = 3.0", False),
        ("number / 3", "number / 4", False),
        ("from lmshealth.calibration.ranks import place\n", "", True),
        ("return len(rows)", "return 2 * len(rows)", True),
        ('"""Draw one."""', '"""Draw another."""', True),
        ("# no round number", "", True),
    ],
)
def test_changed_code(written: Any, tmp_path: Path, old: str, new: str, same: bool) -> None:
    """Trials are done anew when what they need has changed, not for anything beside it."""
    path = tmp_path / "study.jsonl"
    Trials(path).collect(written(SCRIPT).draw, TASKS)
    assert old in SCRIPT
    script = written(SCRIPT.replace(old, new))
    found = Trials(path).collect(script.draw, TASKS)
    assert script.done == ([] if same else TASKS)
    assert json.dumps(found) == json.dumps(Trials(None).collect(script.draw, TASKS))


@pytest.mark.parametrize(
    ("new", "repeated"),
    [("number * SCALE / 3", 21), ("SCALE * number / 3 + (number == 151)", 200)],
)
def test_other_code_is_confirmed_by_a_sample(
    written: Any, tmp_path: Path, new: str, repeated: int
) -> None:
    """Where a sample of trials gives the same values, run times apart, the others are kept.

    One of a rare kind is always repeated. Control: it differs, and all are computed again.
    """
    path, tasks = tmp_path / "study.jsonl", [("b" if k == 151 else "a", k) for k in range(200)]
    text = SCRIPT.replace('"kind": kind', '"cpu_s": SCALE * len(done), "kind": kind')
    Trials(path).collect(written(text).draw, tasks)
    script, trials = written(text.replace("SCALE * number / 3", new)), Trials(path)
    found = trials.collect(script.draw, tasks)
    assert len(script.done) == repeated
    assert [row["draw"] for row in found] == [script.draw(*task)["draw"] for task in tasks]
    confirmed = (21, 179) if repeated == 21 else (0, 0)
    assert (trials.repeated, trials.taken_over) == confirmed
    script.done.clear()
    trials = Trials(path)
    again = trials.collect(script.draw, tasks)
    assert json.dumps(again) == json.dumps(found) and script.done == []
    assert (trials.repeated, trials.taken_over) == confirmed


def test_run_times_are_never_taken_over(written: Any, tmp_path: Path) -> None:
    """A study of run times repeats all trials of other code."""
    path, tasks = tmp_path / "study.jsonl", [("a", k) for k in range(200)]
    Trials(path).collect(written(SCRIPT).draw, tasks)
    script = written(SCRIPT.replace("SCALE * number / 3", "number * SCALE / 3"))
    Trials(path, takes_over=False).collect(script.draw, tasks)
    assert script.done == tasks


PLACE, READ = "lmshealth.calibration.ranks import place", "lmshealth import read_log as place"


def needed_by(script: Any) -> dict[str, str]:
    """Return the code that the trials of a script need, by the names of its modules."""
    found = provenance._needed({(Path(script.__file__ or ""), "draw")})
    return {module.name: "".join(codes) for module, codes in found.items()}


@pytest.mark.parametrize(
    ("module", "old", "new", "counts"),
    [
        ("script.py", "SCALE = 2.0", "SCALE = 4.0", True),
        ("script.py", "def outcomes(rows):", "def outcomes(rows, more=1):", False),
        ("ranks.py", "def place(", "def place(more: int, ", True),
        # Threads, and a function of the same module that nothing here calls.
        ("ranks.py", "def place(", "@one_thread\ndef place(", False),
        ("ranks.py", "def share_row(", "def share_row(more: int, ", False),
        # What is needed through another module, and what that runs when it is imported.
        ("arrays.py", "FloatArray = ", "FloatArray = None or ", True),
        ("arrays.py", "FloatArray = ", "print(1)\nFloatArray = ", True),
    ],
)
def test_code_that_is_reached_counts(
    written: Any, monkeypatch: pytest.MonkeyPatch, module: str, old: str, new: str, counts: bool
) -> None:
    """Trials are done anew when code has changed that they reach, however indirectly."""
    text = SCRIPT.replace("SCALE *", "place.__name__ and SCALE *")
    before = provenance.code_of(written(text).draw)
    assert provenance.code_of(written(text).draw) == before
    script, read, changed = written(text), Path.read_text, []

    def other(path: Path, *words: Any, **named: Any) -> str:
        content = read(path, *words, **named)
        if path.name == module and old in content:
            changed.append(path)
            content = content.replace(old, new, 1)
        return content

    monkeypatch.setattr(Path, "read_text", other)
    assert (provenance.code_of(script.draw) != before) == counts
    assert changed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "second", "same"),
    [("lives", "check", True), ("constants", "check", True), ("check", "lives", False)],
)
@pytest.mark.parametrize(
    "uses",
    [
        "names",
        "modules",
        "inner",
    ],
)
@pytest.mark.parametrize("name", ["sign", "constant", "through"])
def test_a_definition_counts_wherever_it_is(
    written: Any,
    monkeypatch: pytest.MonkeyPatch,
    first: str,
    second: str,
    same: bool,
    uses: str,
    name: str,
) -> None:
    """Trials stay valid where a definition moves; not where two of one name change places.

    It is a function, a constant, or a function of the same text that names such a constant;
    imported by its name, by its module, or inside of a function.
    """
    values = {"lives": "1", "constants": "1", "check": "2"}
    read = Path.read_text

    def other(path: Path, *words: Any, **named: Any) -> str:
        content, value = read(path, *words, **named), values.get(path.stem)
        if value is None or path.parent.name != "calibration":
            return content
        return (
            f"{content}\nconstant = {value}\ndef sign(x):\n    return {value} * x\n"
            "def through(x):\n    return constant * x\n"
        )

    def code(*homes: str) -> str:
        script, lines, body = written(SCRIPT), [], "first, second"
        for alias, home in zip(("first", "second"), homes, strict=True):
            if uses == "modules":
                lines.append(f"from lmshealth.calibration import {home} as {alias}")
                body = f"first.{name}, second.{name}"
            else:
                lines.append(f"from lmshealth.calibration.{home} import {name} as {alias}")
        imports = "\n".join(lines)
        text = SCRIPT.replace("SCALE *", f"place.__name__ and ({body}) and SCALE *")
        if uses == "inner":
            inner = imports.replace("\n", "\n    ")
            text = text.replace("def scaled(number):", f"def scaled(number):\n    {inner}")
        else:
            text = f"{imports}\n{text}"
        Path(script.__file__).write_text(text)
        return provenance.code_of(script.draw)

    monkeypatch.setattr(Path, "read_text", other)
    assert (code(first, second) == code("lives", "check")) == same


def test_reasons_and_places_of_modules(written: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reasons why a figure is not met compute nothing; what a module makes of its place counts."""
    text = SCRIPT.replace("SCALE *", "(NOT_MET or 1) and SCALE *")
    codes = [
        provenance.code_of(written(f"NOT_MET = {{'a': {reason!r}}}\n{text}").draw)
        for reason in ("one", "other")
    ]
    assert codes[0] == codes[1]
    read = Path.read_text

    def other(path: Path, *words: Any, **named: Any) -> str:
        more = "\nHERE = __file__\n" if path.stem in ("lives", "constants") else ""
        return read(path, *words, **named) + more

    monkeypatch.setattr(Path, "read_text", other)
    found = set()
    for home in ("lives", "constants"):
        script = written(SCRIPT)
        text = SCRIPT.replace("SCALE *", "place.__name__ and HERE and SCALE *")
        Path(script.__file__).write_text(
            f"from lmshealth.calibration.{home} import HERE\n"
            f"from lmshealth.calibration import constants, lives\n{text}"
        )
        found.add(provenance.code_of(script.draw))
    assert len(found) == 2


def test_tables_that_are_read_count(written: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the tables of the program the sections that the code reads."""
    text = SCRIPT.replace(PLACE, "lmshealth.machine.status import notices as place")
    text = text.replace("SCALE *", "place.__name__ and SCALE *")
    read = Path.read_bytes
    for section, counts in (("[notices]", True), ("[refusals]", False)):
        script = written(text)
        before = provenance.code_of(script.draw)
        with monkeypatch.context() as patched:
            patched.setattr(
                Path, "read_bytes",
                lambda path, at=section: read(path).replace(at.encode(), f"{at} # x".encode()),
            )  # fmt: skip
            provenance._digest.cache_clear()
            assert (provenance.code_of(script.draw) != before) == counts


def test_gathered_names(written: Any) -> None:
    """Of the package a trial needs the homes of the names it uses, and what these register."""
    text = SCRIPT.replace(PLACE, READ).replace("SCALE *", "place.__name__ and SCALE *")
    names = needed_by(written(text))
    assert "name='read_log'" in names["reading.py"]
    assert {"errors.py", "native.py"} <= names.keys()
    assert not {"pages.py", "__main__.py", "kalman_filters.py"} & names.keys()


def test_a_program_that_is_started_counts_whole(written: Any) -> None:
    """Its commands are imported by their names, which no import states."""
    assert "log_commands.py" not in needed_by(written(SCRIPT))
    assert "log_commands.py" in needed_by(written(SCRIPT.replace("SCALE *", '"-m" and SCALE *')))


def test_options_and_names_part_trials(written: Any, tmp_path: Path) -> None:
    """The same numbers given to other work, or with other options, are other trials."""
    script, path = written(SCRIPT), tmp_path / "study.jsonl"
    plain, squared = (
        Trials(path).once(work, "a", 2) for work in (script.draw, partial(script.draw, power=2))
    )
    assert squared["draw"] == pytest.approx(plain["draw"] ** 2)
    assert Trials(path).once(script.scaled, 2) == plain["draw"]


def test_kept_time_is_told(written: Any, tmp_path: Path) -> None:
    """A study knows how long those trials took that it did not do again."""
    script, path = written(SCRIPT), tmp_path / "study.jsonl"
    Trials(path).collect(script.draw, TASKS)
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    path.write_text("".join(json.dumps(row | {"seconds": 2.0}) + "\n" for row in rows))
    trials = Trials(path)
    trials.collect(script.draw, [*TASKS, ("b", 1)])
    assert trials.kept_s == pytest.approx(2.0 * len(TASKS))


def test_pool(written: Any, tmp_path: Path) -> None:
    """In a pool trials come in the order of their tasks, and are kept alike."""
    script, path = written(SCRIPT), tmp_path / "study.jsonl"
    with ThreadPoolExecutor(2) as pool:
        found = Trials(path).collect(script.draw, TASKS, pool=pool)
    assert json.dumps(found) == json.dumps(Trials(None).collect(script.draw, TASKS))
    script.done.clear()
    Trials(path).collect(script.draw, TASKS)
    assert script.done == []
