"""Reading costs about the time of the library that reads the format, and less memory."""

import json
import subprocess
import sys

import pytest


@pytest.mark.slow
def test_readers_are_as_fast_as_their_libraries(root):
    """No bounded reader takes two and a half times its library's time, however busy the machine.

    Of formats read in a process of their own, writing the samples to files counts as the library's.
    Nor does one hold four minutes of a longer log, which its library does.
    """
    command = [sys.executable, "-W", "error", "-m", "studies.cost.reading.run", "--quick"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=root)
    assert done.returncode == 0, done.stdout + done.stderr
    answer = json.loads(done.stdout)
    assert all(answer["passed"].values()), answer["times"]
    assert all(answer["memory_passed"].values()), answer["memory"]
