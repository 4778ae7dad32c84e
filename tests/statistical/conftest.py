"""The marker, the generator and the claims of all statistical tests."""

from __future__ import annotations

import os

import numpy as np
import pytest

from tests.claims import KEY, Claims, generator
from tests.statistical.sizes import LEVEL, SEED, TESTS


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark all tests of this folder."""
    item.add_marker(pytest.mark.statistical)


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Give each test a generator of its own; LMSHEALTH_SEED sets others."""
    return generator(int(os.environ.get("LMSHEALTH_SEED", SEED)), request.node.nodeid)


@pytest.fixture
def claims(request: pytest.FixtureRequest) -> Claims:
    """Take the claims of a test; `sizes` says which, and how many data sets it draws."""
    link = request.path.stem.removeprefix("test_").removesuffix("_calibration")
    part = TESTS[request.node.name]
    of = sum(len(one.claims) for one in TESTS.values())
    own = request.node.stash[KEY] = Claims(link, part, LEVEL, of)
    return own
