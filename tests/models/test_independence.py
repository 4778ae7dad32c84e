"""Test that the simulated truth shares no code with the program that it judges."""

import subprocess
import sys

import pytest


@pytest.mark.slow
def test_models_never_imports_lmshealth():
    """Importing the command line of the models loads nothing of lmshealth."""
    code = (
        "import sys, models.__main__; "
        "print([m for m in sys.modules if m.split('.')[0] == 'lmshealth'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
