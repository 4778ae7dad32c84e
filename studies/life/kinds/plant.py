"""A plant of the study's own: a rigid body on rolling contacts in series with a joint.

Each of three modes moves a contact spring, whose stiffness grows with the cube root of the preload
(Hertz), in series with the spring of the mount:

    f² ~ 1 / (c p^(-1/3) + (1 - c) / m)

with preload p and mount stiffness m as shares of those when new, and c the share of the contacts in
the compliance of the mode when new. Neither `models` nor the shipped maps are in it.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MODES = ("roll", "pitch", "yaw")
PARAMETERS = ("guide_preload", "mount_stiffness")
FREQUENCY_HZ = np.array([126.4, 136.6, 155.0])
LN_ZETA = np.log([0.0147, 0.0153, 0.0175])
CONTACT_SHARE = np.array([0.45, 0.65, 0.88])
# Limits of the description, as shares of the parameters when new.
LIMITS = {"guide_preload": 0.6, "mount_stiffness": 0.7}
_AXES = np.geomspace(0.2, 1.5, 17), np.geomspace(0.25, 1.6, 17)


def drift(ln_health: Array) -> Array:
    """Return the change of ln f ``(..., n_modes)`` at ln preload and ln mount ``(..., 2)``."""
    ln_p, ln_m = ln_health[..., :1], ln_health[..., 1:]
    compliance = CONTACT_SHARE * np.exp(-ln_p / 3) + (1 - CONTACT_SHARE) * np.exp(-ln_m)
    return np.asarray(-0.5 * np.log(compliance))


def drifts_alone(ln_health: Array) -> Array:
    """Return the drift that each parameter makes by itself, ``(..., 2, n_modes)``."""
    alone = [drift(ln_health * own) for own in np.eye(2)]
    return np.stack(alone, axis=-2)


def map_table() -> str:
    """Tabulate the modal map of the plant, as `lmshealth` reads it."""
    rows = [",".join([*PARAMETERS, "mode", "frequency_hz"])]
    for values in product(*_AXES):
        found = FREQUENCY_HZ * np.exp(drift(np.log(values)))
        state = ",".join(f"{value:.12g}" for value in values)
        rows += [f"{state},{mode},{f:.12g}" for mode, f in zip(MODES, found, strict=True)]
    return "\n".join(rows) + "\n"
