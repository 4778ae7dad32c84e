"""Seeds: random streams that depend on the input and the step, not on the order of work."""

import hashlib
from collections.abc import Sequence

import numpy as np


def stream(seed: int | Sequence[int], *steps: int) -> np.random.SeedSequence:
    """Return the random stream of a step of the computation."""
    return np.random.SeedSequence([*np.atleast_1d(seed).tolist(), *steps])


def seed_of(seed: int, *inputs: str) -> tuple[int, int]:
    """Derive the seed of a computation from the user's seed and a hash of its inputs."""
    digest = hashlib.sha256("\n".join(inputs).encode()).hexdigest()
    return seed, int(digest[:12], 16)
