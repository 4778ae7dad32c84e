"""Whatever a file holds: a log that keeps its contract, or an error of lmshealth."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lmshealth.errors import LmshealthError
from lmshealth.readers import read_log

_SPEC = importlib.util.spec_from_file_location("_writers", Path(__file__).with_name("conftest.py"))
_WRITERS = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(_WRITERS)

MUTATION = st.tuples(
    st.sampled_from(["flip", "cut", "insert", "zero"]),
    st.floats(0, 1, exclude_max=True),
    st.binary(min_size=1, max_size=8),
)


def mutate(data: bytes, mutations) -> bytes:
    """Damage a file's content."""
    for kind, where, what in mutations:
        i = int(where * len(data))
        if kind == "flip":
            data = data[:i] + what + data[i + len(what) :]
        elif kind == "cut":
            data = data[:i]
        elif kind == "insert":
            data = data[:i] + what + data[i:]
        else:
            data = data[:i] + bytes(len(what)) + data[i + len(what) :]
    return data


@pytest.fixture(scope="module", params=["log.csv", "log.csv.gz", "log.parquet", "log.h5"])
def valid(request, tmp_path_factory):
    """Write a small valid log."""
    path = tmp_path_factory.mktemp("fuzz") / request.param
    _WRITERS.write(path, _WRITERS.signals(64), _WRITERS.META)
    return path, path.read_bytes()


@settings(
    max_examples=150,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(mutations=st.lists(MUTATION, min_size=1, max_size=4))
def test_damaged_files(valid, mutations):
    """A damaged file never raises anything but an error of lmshealth."""
    path, data = valid
    path.write_bytes(mutate(data, mutations))
    try:
        log = read_log(path)
    except LmshealthError:
        return
    assert log.channels and log.pieces and log.sample_rate > 0
    for start, stop in log.pieces:
        for channel in log.channels:
            assert np.isfinite(channel.values[start:stop]).all()
