"""Reading costs about what the library that reads the format costs."""

import json
import subprocess
import sys


def test_readers_are_as_fast_as_their_libraries(root):
    """No bounded reader takes two and a half times its library's time, however busy the machine."""
    command = [sys.executable, "-W", "error", "-m", "studies.read_throughput.run", "--quick"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=root)
    assert done.returncode == 0, done.stdout + done.stderr
    answer = json.loads(done.stdout)
    assert all(answer["passed"].values()), answer["times"]
