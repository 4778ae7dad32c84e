"""The simulated machines of a seed: their identity, and their streams of random numbers."""

from __future__ import annotations

import zlib
from datetime import UTC, datetime

import numpy as np

from models.dynamics.stages import Stage

# When every simulated machine is commissioned.
COMMISSIONED = datetime(2026, 3, 2, 8, 0, tzinfo=UTC)


def machine_identity(stage: Stage, seed: int | str) -> str:
    """Return the identity of the machine that a seed, or a drawn plant, makes of a stage."""
    return f"LMS-{seed}-{stage.identity_suffix}"


def stream(stage: str, seed: int, step: str, *numbers: int) -> np.random.Generator:
    """Return the generator of one step of a stage's machine: independent of all others.

    Parameters
    ----------
    numbers
        Distinguish repetitions of the step.
    """
    entropy = [seed, zlib.crc32(f"{stage}/{step}".encode()), *numbers]
    return np.random.default_rng(np.random.SeedSequence(entropy))
