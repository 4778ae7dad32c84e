"""Limits that decide which logs, channels and samples are refused."""

from __future__ import annotations

MAX_MEMORY = 2e9
"""Most memory in bytes that decoding one variable (MAT), data set (UFF58) or segment (TDMS) may
take: ten minutes of 20 kHz take 0.1 GB per channel. The option ``--max-memory``."""
