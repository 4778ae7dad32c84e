# %% [markdown]
# # First look: from a folder of logs to a service date
#
# **Question.** A linear-motor stage has run for half a year. How much of its guide preload and of
# its mount stiffness is left, and when must it be serviced?
#
# The stage is simulated, so that the true answer is known and can be compared at the end. Its logs
# are in the same form as those of a machine. Run time: a minute on one processor.

# %%
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

import lmshealth as lh

logs = Path(tempfile.mkdtemp()) / "logs"
life = "lms-y --life both --logs 12 --seconds 12 --seed 3 --workers 1".split()
subprocess.run(
    [sys.executable, "-m", "models", "simulate", *life, "--out", logs],
    check=True,
    capture_output=True,
)
sorted(path.name for path in logs.iterdir())[:3]

# %% [markdown]
# ## One log
#
# A log is a recording of some seconds of motion: the following error Δe (the encoder's position
# minus the set point) and accelerations.

# %%
log = lh.read_log(logs / "log-0001.h5")
log

# %%
axes = log.plot()
_ = axes.set_xlim(0, 400)

# %% [markdown]
# The picture shows the power spectral density of both accelerations. Narrow peaks at multiples of
# 50 Hz are the mains. The peaks between 120 and 160 Hz are three modes in which the platform turns
# on its guide: roll, pitch and yaw. Their frequencies fall when the guide or the mount becomes
# softer. The description `lms-y` states where to look for them.

# %%
stage = lh.load_stage("lms-y")
modes = lh.identify(log, stage)
modes

# %% [markdown]
# Each natural frequency and damping ratio has a standard deviation, here about 0.2 Hz: wear of some
# percent of a frequency is visible, a tenth of a percent in one log is not.
#
# ## All logs
#
# `analyse` reads and identifies all logs of the machine and does everything that follows.

# %%
found = lh.analyse(logs, stage, epochs=6)
found

# %%
axes = found.history.plot("pitch")
_ = found.track.plot("pitch", ax=axes)
found.track

# %% [markdown]
# Points are the estimates of single logs, the line and its band are those of the filter. The
# frequency of pitch falls by six percent, far more than its uncertainty. The track has an alarm: no
# known influence, such as temperature, explains the change.
#
# ## Health

# %%
axes = found.health.plot("guide_preload")
truth = pd.read_csv(logs / "truth.csv")
axes.plot(truth["travel_km"], 100 * truth["guide_preload"], "k--", label="truth")
_ = axes.legend()
# %% [markdown]
# The bands hold the preload with 50 and 90 % probability, each epoch by itself. The dashed line is
# the true preload, which the program has never read. The health of the last log as a table:

# %%
last = found.health.to_frame().groupby("parameter").last()[["median", "q05", "q95"]]
last["truth"] = truth.iloc[-1][last.index].astype(float)
last.round(3)

# %% [markdown]
# ## Remaining life and service date

# %%
_ = found.prognosis.plot()
# %%
service = found.service()
limit = truth["guide_preload_limit_km"].iloc[-1] - truth["travel_km"].iloc[-1]
left = found.prognosis.to_frame().set_index("parameter").loc["any"]
print(f"service by {service.by}, accepted risk {service.max_risk:.0%}")
print(f"remaining: {left.rul_km_q05:.0f} to {left.rul_km_q95:.0f} km (90 %), truth {limit:.0f} km")
assert np.isfinite(left.rul_km_q95)

# %% [markdown]
# The curve is the probability that no limit has been reached, over the travel from now. The service
# date is the last day on which that of a failure is at most 5 %.
#
# **What this does not show.** One simulated life is no evidence that intervals hold: the studies
# `kinds` and `drawn_machines` count that over many lives. The simulated stage follows the
# modal map by construction; a real one does so as well as its map has been made. Remaining life
# assumes that no crash is still to come.
