"""Write building.map.csv: all modes go with the square root of the relative stiffness."""

from pathlib import Path

import numpy as np
import pandas as pd

# SSI values stated by the data's authors, in Hz.
PUBLISHED = {"first": 1.882, "second": 2.422, "third": 2.687}
# Estimated once by another method, the authors give none.
PUBLISHED_DAMPING = {"first": 0.0156, "second": 0.0142, "third": 0.0153}

if __name__ == "__main__":
    rows = [
        {"stiffness": k, "mode": mode, "frequency_hz": f * np.sqrt(k)}
        for k in np.geomspace(0.4, 2.5, 9).round(6)
        for mode, f in PUBLISHED.items()
    ]
    pd.DataFrame(rows).to_csv(Path(__file__).with_name("building.map.csv"), index=False)
