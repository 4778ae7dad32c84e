"""Messages by the real apprise: to a server on this machine, and to addresses that fail."""

from __future__ import annotations

import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar

import pytest

from lmshealth.batch import alerts as alerting
from lmshealth.batch import constants
from lmshealth.batch.alerts import Alerts, run_command
from studies.harness.servers import free_port

pytestmark = pytest.mark.slow
pytest.importorskip("apprise", reason="the extra notify is not installed")

SECRET = "s3cr3t-word"
CONTENT = json.dumps(
    {"changes": [{"text": text, "severity": "serious"} for text in ("A: alarm roll", "B: silent")]}
).encode()


class Keeper(BaseHTTPRequestHandler):
    """Keep what is posted, and answer as the path says."""

    received: ClassVar[list[tuple[str, dict[str, str], dict[str, str]]]] = []

    def do_POST(self) -> None:
        """Answer with the status in the path, 200 without one."""
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.received.append((self.path, dict(self.headers), json.loads(body)))
        self.send_response(500 if self.path.startswith("/broken") else 200)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Print nothing."""


@pytest.fixture
def port() -> Iterator[int]:
    """Run a server on this machine."""
    Keeper.received.clear()
    server = ThreadingHTTPServer(("127.0.0.1", 0), Keeper)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server.server_port
    server.shutdown()
    thread.join()
    server.server_close()


def notify(addresses: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """Send two changes to addresses of the environment; return why that failed."""
    (command,) = Alerts(notify=True).channels().values()
    assert SECRET not in " ".join(command)
    monkeypatch.setenv("PYTHONPATH", str(Path(alerting.__file__).parents[2]))
    monkeypatch.setenv(constants.NOTIFY, addresses)
    assert SECRET not in "".join(v for k, v in os.environ.items() if k != constants.NOTIFY)
    return run_command(command, CONTENT)


def test_a_server_receives_a_message(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A webhook gets number and lines of the changes once, with the password of its address."""
    assert notify(f"json://me:{SECRET}@127.0.0.1:{port}/hook", monkeypatch) == ""
    ((path, headers, body),) = Keeper.received
    assert path.rstrip("/") == "/hook" and headers["Authorization"].startswith("Basic ")
    assert body["title"] == "lmshealth: 2 changes"
    assert body["message"] == "A: alarm roll (serious)\nB: silent (serious)"


@pytest.mark.parametrize("broken", ["json", "mail", "refuses", "unknown"])
def test_a_failure_names_no_secret(port: int, monkeypatch: pytest.MonkeyPatch, broken: str) -> None:
    """Where one of two addresses fails, the other gets its message, and no error quotes either."""
    addresses = {
        "json": f"json://me:{SECRET}@127.0.0.1:{port}/broken/{SECRET}",
        "mail": f"mailto://me:{SECRET}@example.org:{free_port()}?smtp=127.0.0.1&to=you@example.org",
        "refuses": f"json://me:{SECRET}@127.0.0.1:{free_port()}/{SECRET}",
        "unknown": f"nothing://me:{SECRET}@host",
    }
    good = f"json://127.0.0.1:{port}/good"
    why = notify(f"{good} {addresses[broken]}", monkeypatch)
    assert "ended with status 1" in why and constants.NOTIFY in why and SECRET not in why
    # An address that apprise does not know is a slip of the pen: nothing is sent.
    sent = [path for path, _, _ in Keeper.received if path.startswith("/good")]
    assert len(sent) == (broken != "unknown")


def test_a_server_that_hangs_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """A server that accepts and never answers does not hold the run."""
    monkeypatch.setattr(constants, "ALERT_TIMEOUT_S", 3.0)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        begin = time.monotonic()
        why = notify(f"json://me:{SECRET}@127.0.0.1:{listener.getsockname()[1]}/", monkeypatch)
        assert time.monotonic() - begin < 20
    assert why and SECRET not in why
