"""Tables of single logs: the columns of the contract, units at the door."""

from __future__ import annotations

from lmshealth.report.tables import lines_rows
from lmshealth.signal.spectral_lines import Line


def test_lines_have_the_keys_of_the_contract() -> None:
    """A line is told by frequency, amplitude with unit, kind and channel."""
    (row,) = lines_rows([Line(50.0, 0.1, "m/s²", "mains", "acc_x")])
    assert row == {
        "frequency_hz": 50.0,
        "amplitude": 0.1,
        "unit": "m/s²",
        "kind": "mains",
        "channel": "acc_x",
    }
