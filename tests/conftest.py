"""What tests share: things a machine may lack, and paths."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from lmshealth.report.rendering import PdfError, load_pdf_library
from studies.harness import servers

ROOT = Path(__file__).parent.parent
pytest_plugins = ["pytester", "tests.claims"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what takes longest, so that no worker ends long after the other.

    These are statistical tests, then studies, then other whole chains, which stand beside them.
    """
    items.sort(
        key=lambda item: (
            item.get_closest_marker("statistical") is None,
            item.path.name != "test_studies.py",
            item.path.parent != ROOT / "tests",
        )
    )


def _missing(name: str) -> str | None:
    """Say why something a test needs is not there; None when it is."""
    if name == "chromium":
        return None if shutil.which("chromium") else "chromium is not installed (Debian: chromium)"
    if name == "data":
        folder = os.environ.get("LMSHEALTH_DATA", "")
        if not folder:
            return "LMSHEALTH_DATA is not set: it names the folder of real measurements"
        return None if Path(folder).is_dir() else f"LMSHEALTH_DATA={folder} is no folder"
    if name == "git":
        found = shutil.which("git") and (ROOT / ".git").exists()
        return None if found else "git is not installed, or this is no clone (Debian: git)"
    if name == "pdf":
        try:
            load_pdf_library()
        except PdfError as error:
            return str(error)
        return None
    if name == "postgres":
        return servers.missing_postgres()
    if name == "distributed":
        return servers.missing_distributed()
    raise ValueError(f"unknown need {name!r}")


@pytest.fixture(scope="session")
def needs() -> Callable[[str], None]:
    """Skip a test for want of something, or fail it where LMSHEALTH_REQUIRE names that thing."""

    def check(name: str) -> None:
        reason = _missing(name)
        if reason is None:
            return
        if name in os.environ.get("LMSHEALTH_REQUIRE", "").replace(",", " ").split():
            pytest.fail(f"required: {reason}")
        pytest.skip(reason)

    return check


@pytest.fixture(scope="session")
def root() -> Path:
    """Folder of the project."""
    return ROOT


@pytest.fixture(scope="session")
def postgres(needs: Callable[[str], None]) -> Iterator[servers.Postgres]:
    """Run a PostgreSQL server while tests run."""
    needs("postgres")
    with servers.postgres() as server:
        yield server


@pytest.fixture
def database(postgres: servers.Postgres) -> Iterator[str]:
    """Address of an empty PostgreSQL database that only one test sees."""
    with postgres.database() as url:
        yield url


@pytest.fixture(params=["sqlite", "postgres"])
def store_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Name a store that does not exist yet, of either kind."""
    if request.param == "sqlite":
        return f"sqlite:///{(tmp_path / 'store.sqlite').as_posix()}"
    return str(request.getfixturevalue("database"))


@pytest.fixture
def cluster(needs: Callable[[str], None]) -> Iterator[servers.Cluster]:
    """Run a Dask scheduler and two worker processes while one test runs."""
    needs("distributed")
    with servers.dask_cluster() as running:
        yield running
