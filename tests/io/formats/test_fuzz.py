"""Whatever a file holds: a log that keeps its contract, or an error of lmshealth."""

import os
import signal

import numpy as np
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lmshealth.errors import LmshealthError
from lmshealth.io.reading import read_log
from tests.io import conftest as writers

# Windows has no such measure of memory, and no alarm.
resource = pytest.importorskip("resource")

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


EXAMPLES = int(os.environ.get("LMSHEALTH_FUZZ_EXAMPLES", "150"))
LONGEST_S = 10
# What reading an honest log of this size takes is far below; 1 GB was seen without the checks.
MOST_MEMORY = 400 << 20


class Hang(BaseException):
    """Nothing that catches errors of a library may swallow this."""


@pytest.fixture
def no_hang():
    """End a test whose reader does not come back."""

    def ring(*_):
        raise Hang(f"no answer after {LONGEST_S} s")

    before = signal.signal(signal.SIGALRM, ring)
    yield lambda: signal.alarm(LONGEST_S)
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


FILES = ["log.csv", "log.csv.gz", "log.parquet", "log.h5", "log.tdms", "log.mat"]


@pytest.fixture(scope="module", params=[*FILES, "plain.mat", "ascii.uff", "binary.uff"])
def valid(request, tmp_path_factory):
    """Write a small valid log."""
    path = tmp_path_factory.mktemp("fuzz") / request.param
    signals = writers.signals(64)
    if path.suffix == ".uff":
        records = {"feed": signals["acc_feed_m_s2"], "pitch": signals["delta_e_um"]}
        writers.write_uff(path, records, binary=int(path.stem == "binary"))
    elif path.stem == "plain":
        nested = {"log": {"again": signals, "list": np.array([1.0, "text"], dtype=object)}}
        scipy.io.savemat(path, {**signals, **writers.META, **nested})
    else:
        writers.write(path, signals, writers.META)
    # Beside it, not in the fixture: an error of the test prints its arguments.
    (path.parent / "intact").write_bytes(path.read_bytes())
    assert read_log(path).channels
    return path


@pytest.mark.slow
@settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(mutations=st.lists(MUTATION, min_size=1, max_size=4))
def test_damaged_files(valid, no_hang, mutations):
    """A damaged file gives a log or an error of lmshealth, soon and in little memory."""
    intact = (valid.parent / "intact").read_bytes()
    valid.write_bytes(mutate(intact, mutations))
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    no_hang()
    try:
        log = read_log(valid)
    except LmshealthError:
        log = None
    signal.alarm(0)
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - used) << 10 < MOST_MEMORY
    if log is None:
        return
    assert log.channels and log.pieces and log.sample_rate > 0
    for start, stop in log.pieces:
        for channel in log.channels:
            assert np.isfinite(channel.values[start:stop]).all()
