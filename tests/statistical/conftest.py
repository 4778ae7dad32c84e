"""One reseedable generator for all statistical tests."""

from __future__ import annotations

import os

import numpy as np
import pytest


@pytest.fixture
def rng() -> np.random.Generator:
    """Give a generator of a fixed seed; LMSHEALTH_TEST_SEED sets another."""
    return np.random.default_rng(int(os.environ.get("LMSHEALTH_TEST_SEED", "20260301")))
