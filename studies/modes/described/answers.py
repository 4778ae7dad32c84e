"""Identify records from a description or without; a program of the published functions alone.

It answers requests from stdin, one JSON object a line, with the code that ``PYTHONPATH`` names: an
earlier revision as well as this one. It therefore imports nothing of the studies.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import numpy as np

import lmshealth
from lmshealth.io.log import Channel, Log, Metadata
from lmshealth.stage.description import Description, ModeSpec, Stage


def answer(samples: str, rate: float, modes: dict[str, float]) -> dict[str, Any]:
    """Return names, ln f with its standard deviation, and the processor time in s."""
    values = np.load(samples)
    channels = tuple(
        Channel(f"acc_{c}", "acceleration", row.copy()) for c, row in enumerate(values.T)
    )
    log = Log("record", "0" * 64, Metadata(), rate, channels, None, ((0, len(values)),), ())
    specs = tuple(ModeSpec(name, f, 0.012) for name, f in modes.items())
    stage = Stage(Description(name="machine", mode=specs), None, "0" * 64)
    start = time.process_time()
    found = lmshealth.identify(log, stage)
    cpu = time.process_time() - start
    n = len(found.names)
    return {
        "names": list(found.names),
        "flags": list(found.flags),
        "ln_f": found.ln_frequency.tolist(),
        "std": np.sqrt(np.diag(found.cov))[:n].tolist(),
        "cpu_s": cpu,
    }


def main() -> None:
    """Answer requests until the end of stdin."""
    for line in sys.stdin:
        print(json.dumps(answer(**json.loads(line))), flush=True)


if __name__ == "__main__":
    main()
