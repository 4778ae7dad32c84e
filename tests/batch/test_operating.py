"""OPERATING.md: its commands run in their order, its units can be read, and it stays short."""

from __future__ import annotations

import configparser
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from click import Context

from lmshealth.cli.main import main
from tests.signals import write_archive, write_archive_stage

_BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.fixture
def guide(root: Path) -> str:
    """Return the text of the guide."""
    return (root / "lmshealth/batch/OPERATING.md").read_text(encoding="utf-8")


def blocks(guide: str, kind: str) -> list[str]:
    """Return the blocks of a kind, in their order."""
    return [text for own, text in _BLOCK.findall(guide) if own == kind]


def test_the_guide_stays_short(guide: str) -> None:
    """It has at most 150 lines."""
    assert len(guide.splitlines()) <= 150


@pytest.mark.slow
def test_its_commands_run_in_their_order(root: Path, guide: str, tmp_path: Path) -> None:
    """The nightly run, backup, restore and comparison after an upgrade; a wrong one would fail."""
    write_archive(tmp_path / "logs", 2)
    write_archive_stage(tmp_path, health=False).rename(tmp_path / "my-stage.toml")
    tools = tmp_path / "bin"
    tools.mkdir()
    called = "from lmshealth.cli.main import main; main()"
    for name, more in (("python3", ""), ("lmshealth", f" -c {shlex.quote(called)}")):
        (tools / name).write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)}{more} "$@"\n')
        (tools / name).chmod(0o755)
    path = {"PATH": f"{tools}:/usr/bin:/bin", "PYTHONPATH": str(root), "HOME": str(tmp_path)}
    commands = blocks(guide, "sh")
    assert len(commands) == 4
    for command in commands:
        done = subprocess.run(
            ["bash", "-euc", command], cwd=tmp_path, env=path, capture_output=True, text=True
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    assert (tmp_path / "result/index.html").is_file()
    failed = subprocess.run(["bash", "-euc", "lmshealth run none/"], cwd=tmp_path, env=path)
    assert failed.returncode == 2


def test_every_option_that_it_names_is_one(guide: str) -> None:
    """Options of commands that cannot run here, of cron lines and of units."""
    whole = "\n".join(text for _, text in _BLOCK.findall(guide))
    found = re.findall(r"lmshealth (run|report|watch)\b(.*)", whole)
    assert len(found) >= 6
    for command, rest in found:
        params = main.get_command(Context(main), command).params  # type: ignore[union-attr]
        known = {option for one in params for option in one.opts}
        assert set(re.findall(r"(?<= )--[a-z-]+", rest)) <= known, rest


def test_units_can_be_read(guide: str) -> None:
    """Service and timer have the sections that systemd needs, and 3 is no failure."""
    service, timer = (configparser.ConfigParser(interpolation=None) for _ in range(2))
    for unit, text in zip((service, timer), blocks(guide, "ini"), strict=True):
        unit.read_string(text)
    assert service["Service"]["SuccessExitStatus"] == "3"
    assert service["Service"]["ExecStart"].startswith("/opt/lmshealth/bin/lmshealth run ")
    assert timer["Timer"]["OnCalendar"] and timer["Install"]["WantedBy"] == "timers.target"
