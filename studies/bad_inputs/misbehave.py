"""Readers that do what the libraries of formats may do on damaged files: controls of `mutants`."""

from __future__ import annotations

import os
from pathlib import Path

from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import Content


def crash(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    """End the process as a violated memory access does."""
    os.abort()


def loop(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    """Never return."""
    while True:
        pass


def swell(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    """Take memory without end."""
    taken = bytearray(1 << 20)
    while True:
        taken += bytes(len(taken))
