"""Nothing that an input says acts, and nothing is reached for outside of what was named."""

from __future__ import annotations

import ast
import stat
from pathlib import Path

import pytest
from click.testing import CliRunner

from lmshealth.batch.database import StoreError
from lmshealth.batch.run import run
from lmshealth.batch.store import Store, default_url
from lmshealth.cli.main import main
from lmshealth.errors import BadStage
from lmshealth.machine.summary import summarise
from lmshealth.report.pages import file_names
from lmshealth.stage.description import load_stage
from tests.assessments import worn
from tests.security.guards import acting, bad_names
from tests.security.hostile import BAD_STAGES, MACHINES, SECRET
from tests.signals import write_archive, write_archive_stage

_UNSAFE = {"pickle", "cPickle", "dill", "cloudpickle", "shelve", "marshal"}


def unsafe(source: str) -> list[str]:
    """List what in a module could run what a file says."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [a.name for a in node.names if a.name.split(".")[0] in _UNSAFE]
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            found += [module] if module.split(".")[0] in _UNSAFE else []
        elif isinstance(node, ast.keyword):
            value = isinstance(node.value, ast.Constant) and node.value.value
            found += [node.arg] if node.arg in ("allow_pickle", "shell") and value else []
        elif isinstance(node, ast.Call):
            name = getattr(node.func, "id", "")
            found += [name] if name in ("eval", "exec", "compile", "__import__") else []
    return [str(name) for name in found]


@pytest.mark.slow
def test_no_module_runs_what_files_say(root: Path) -> None:
    """There is no pickle, no evaluation of text and no shell in the package."""
    for path in sorted((root / "lmshealth").rglob("*.py")):
        assert unsafe(path.read_text(encoding="utf-8")) == [], path


def test_what_runs_files_is_noticed() -> None:
    """Negative control of the search."""
    source = "import pickle\nnp.load(x, allow_pickle=True)\neval(y)\nrun(z, shell=True)\n"
    assert sorted(unsafe(source)) == ["allow_pickle", "eval", "pickle", "shell"]


def test_pages_have_names_of_their_own_on_every_system() -> None:
    """Names of devices, of other folders, and those that differ by case get safe, unlike files."""
    names = list(file_names(MACHINES).values())
    assert len(names) == len(MACHINES)
    assert bad_names([*names, "index.html"]) == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", sorted(BAD_STAGES))
def test_a_bad_description_is_refused_without_a_word_of_other_files(
    tmp_path: Path, kind: str
) -> None:
    """The error is text without control characters and quotes nothing of what is named as a map."""
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "secret.txt").write_text(f"{SECRET}\n")
    path = tmp_path / "stages" / "bad.toml"
    path.parent.mkdir()
    path.write_text(BAD_STAGES[kind])
    with pytest.raises(BadStage) as caught:
        load_stage(str(path))
    assert SECRET not in str(caught.value)
    said = CliRunner().invoke(main, ["stage", str(path)])
    assert said.exit_code == 1
    assert acting(said.output) == []


@pytest.mark.slow
def test_links_in_the_output_are_replaced(tmp_path: Path) -> None:
    """Pages and tables take the place of links; what these point to stays as it is."""
    stage = load_stage(str(write_archive_stage(tmp_path / "stage", health=False)))
    logs, out = write_archive(tmp_path / "logs", 2), tmp_path / "out"
    victim = tmp_path / "victim"
    victim.write_text("as it was")
    out.mkdir()
    names = ("index.html", "test-A.html", "modes.csv", "refused.csv")
    for name in names:
        (out / name).symlink_to(victim)
    run(logs, [stage], out)
    assert victim.read_text() == "as it was"
    for name in names:
        assert not (out / name).is_symlink()
        # As readable to others as any file that this user makes.
        assert stat.S_IMODE((out / name).stat().st_mode) == stat.S_IMODE(victim.stat().st_mode)


def test_a_link_is_no_store(tmp_path: Path) -> None:
    """The store in the output is never somewhere else, whether the link's end is there or not."""
    (tmp_path / "lmshealth.sqlite").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(StoreError, match="is a link"):
        default_url(tmp_path)
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.slow
def test_sql_in_names_is_text(tmp_path: Path, store_url: str) -> None:
    """Names that hold statements are kept and found as they are, in either kind of store."""
    store = Store(store_url)
    refused, made = store.put_refused(()), worn(tmp_path)
    for name in MACHINES:
        store.publish(name, ["0" * 64], summarise(made, made.service()), refused)
    assert sorted(one.machine for one in store.published()) == sorted(MACHINES)
    store.close()
