# %% [markdown]
# # Frequency response: what a sweep adds to logs
#
# **Question.** The drive can add a sine sweep to its motor current. What does its frequency
# response give beside the vibration that is there anyway?
#
# The sweep is made by the simulated Y stage, once new and once with a tenth of its preload lost.
# Run time: half a minute on one processor.

# %%
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import lmshealth as lh

folder = Path(tempfile.mkdtemp())
models = [sys.executable, "-m", "models"]
BAND = (100, 200)


def sweep(preload):
    """Return the log of a stage that moves while a sweep excites it."""
    path = folder / f"sweep-{preload:g}.h5"
    options = f"lms-y --seconds 20 --period 5 --preload {preload}".split()
    subprocess.run([*models, "sweep", *options, "--out", path], check=True)
    return lh.read_log(path)


new, worn = sweep(1.0), sweep(0.9)
new

# %% [markdown]
# ## The response
#
# The input is the sine that the drive adds (`current_excitation`), the output an accelerometer.

# %%
readings = {
    name: lh.read_frf(log, "current_excitation", "acc_feed", band=BAND, period=5.0)
    for name, log in {"new": new, "worn": worn}.items()
}
figure, axes = plt.subplots(
    2, 1, figsize=(6, 4.6), sharex=True, height_ratios=[2, 1], layout="constrained"
)
for name, reading in readings.items():
    frf, fit = reading.frf, reading.fit
    (points,) = axes[0].semilogy(frf.frequency, abs(frf.response), ".", ms=3, alpha=0.5)
    x, y = fit.ordinates.frequency, abs(fit.response)
    axes[0].semilogy(x, y, color=points.get_color(), label=name)
    axes[1].plot(frf.frequency, frf.coherence, color=points.get_color())
axes[0].set_ylabel("gain in (m/s²)/A")
axes[1].set(xlabel="frequency in Hz", ylabel="coherence", ylim=(0, 1.05))
_ = axes[0].legend()
# %% [markdown]
# Points are measured, lines are fitted. The peak is pitch, the mode that the motor excites: with a
# tenth of the preload it loses 2 Hz. The deep notch below it is an antiresonance, no mode. Single
# points at 100 and 150 Hz are the mains, which the fit leaves out. The coherence is near one where
# the sweep is far above the noise of the machine.
#
# ## The frequencies, and the truth

# %%
rows = []
for name, preload in {"new": 1.0, "worn": 0.9}.items():
    answer = subprocess.run(
        [*models, "modes", "lms-y", "--preload", str(preload), "--format", "json"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    true = np.array([mode["frequency_hz"] for mode in json.loads(answer.stdout)["modes"]])
    modes = readings[name].modes
    for f, std in zip(modes.frequency, modes.frequency_std, strict=True):
        rows.append((name, f, std, true[np.abs(true - f).argmin()]))
table = pd.DataFrame(rows, columns=["stage", "frequency_hz", "frequency_std_hz", "truth_hz"])
table["off_in_stds"] = (table["frequency_hz"] - table["truth_hz"]) / table["frequency_std_hz"]
assert (table["off_in_stds"].abs() < 4).all() and set(table["stage"]) == {"new", "worn"}
table.round(4)

# %% [markdown]
# Compare the standard deviations with those of a log of the same length without excitation:

# %%
subprocess.run(
    [*models, *"simulate lms-y --life healthy --logs 1 --seconds 20".split(),
     "--out", folder / "logs"], check=True, capture_output=True,
)  # fmt: skip
ambient = lh.identify(lh.read_log(folder / "logs" / "log-0001.h5"), lh.load_stage("lms-y"))
ambient

# %% [markdown]
# For pitch the sweep is more than ten times as precise. Roll and yaw are missing in it: the motor
# pushes along the feed, and they hardly answer. The ambient log has all three, and needs no access
# to the drive.
#
# **What this does not show.** A real drive is not linear: friction and limits add errors that do
# not average out, which `read_frf` reports and adds to the standard deviations, see
# [own_machine](own_machine.py). In a closed loop the response to the whole current has the modes of
# the machine without its servo; the response to the excitation, as here, those with it.
