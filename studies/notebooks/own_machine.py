# %% [markdown]
# # A machine of your own: describe it, plan, follow it
#
# **Question.** The shipped descriptions are of one type of stage. What does another machine need,
# from its first recording to its remaining life?
#
# The machine is a real motor bench: a motor turns a load through a flexible coupling, excited by a
# multisine for 20 s ([FdiTools](https://github.com/WataruOhnishi/FdiTools), W. Ohnishi, MIT
# licence). The parameter of health is the stiffness of the coupling. The recording (2.5 MB) is
# downloaded once and compared with its SHA-256. Run time: a minute on one processor.
# [new_machine](new_machine/README.md) does the same at the command line, with more
# explanations.

# %%
import os
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pooch

import lmshealth as lh
from lmshealth.io.column_map import load_columns
from lmshealth.io.manifest import read_manifest
from studies.notebooks.new_machine import cut, map

COMMIT = "760b945947491d93917557a145e8637fa209c7d8"
SHA256 = "a15dadc2e756ceddd927935f9c4c547cdcaef95c8611fc39087c848b3a8acb26"
RAW = f"https://raw.githubusercontent.com/WataruOhnishi/FdiTools/{COMMIT}"
PRIVATE = "Examples/private/MultisineTypeA.mat"

kept = Path(os.environ.get("LMSHEALTH_DATA", "")) / cut.RECORDING
recording = kept if kept.is_file() else Path(pooch.retrieve(f"{RAW}/{PRIVATE}", SHA256))
assert pooch.file_hash(recording) == SHA256
here = Path(lh.__file__).parents[1] / "studies" / "notebooks" / "new_machine"
folder = Path(tempfile.mkdtemp())

# %% [markdown]
# ## 1. One recording: which modes are there?
#
# A column map names the signals of the export. The excitation is recorded (the motor current), so
# the frequency response is used; `lh.identify` is for machines whose excitation is unknown.

# %%
columns = load_columns(here / "bench.columns.toml")
log = lh.read_log(recording, columns=columns)
log

# %%
whole = lh.read_frf(log, "current", "delta_e_load", band=(60, 95))
whole.modes

# %%
frf, fit = whole.frf, whole.fit
figure, axes = plt.subplots(figsize=(6, 3.2), layout="constrained")
axes.semilogy(frf.frequency, abs(frf.response), "o", ms=4, label="measured")
axes.semilogy(fit.ordinates.frequency, abs(fit.response), label="fit")
axes.set(xlabel="frequency in Hz", ylabel="angle of the load per current")
_ = axes.legend()

# %% [markdown]
# One resonance: the load turns against the motor. The points scatter around the fit by more than
# the noise of the periods, because the bench is not quite linear. The standard deviation of the
# frequency includes that.
#
# ## 2. The map: what does a change of stiffness do to the frequency?
#
# For two inertias on a spring a formula is enough: the frequency is proportional to the square root
# of the stiffness. The description names mode, parameter, prior, limit and laws.

# %%
map.write_map(folder / "bench.map.csv", float(whole.modes.frequency[0]))
(folder / "bench.toml").write_text((here / "bench.toml").read_text(encoding="utf-8"))
stage = lh.load_stage(str(folder / "bench.toml"))
stage

# %% [markdown]
# ## 3. Plan: how long must a log be?

# %%
for effort in lh.plan(stage, "coupling_stiffness", 0.05, durations=(2, 10, 60)).efforts:
    print(f"{effort.duration:3.0f} s: one log shows a loss of {effort.smallest_loss:.1%}")

# %% [markdown]
# Logs of two seconds are enough for a loss of some percent. That is a bound: no method does better.
#
# ## 4. Logs over ten weeks
#
# The recording has no ageing. It is cut into ten logs for two machines. `bench-A` is as measured.
# The logs of `bench-B` are given a sample rate that falls by 0.4 % a log, and with it all
# frequencies: as if the coupling lost 0.8 % of its stiffness a week. The dates are invented; the
# odometer counts hours.

# %%
cut.write_logs(recording, folder / "logs")
manifest = read_manifest(folder / "logs")
machines: dict[str | None, list[lh.LogEstimates]] = {"bench-A": [], "bench-B": []}
for path in sorted((folder / "logs").glob("[AB]*.csv")):
    one = lh.read_log(path, columns=columns, overrides=manifest.overrides(path))
    found = lh.read_frf(one, "current", "delta_e_load", band=(60, 95)).modes
    named = replace(found, names=("torsion",))  # the only mode in this band
    estimates = lh.LogEstimates(one.name, one.digest, one.metadata, named)
    machines[one.metadata.stage].append(estimates)

results = {name: lh.assess(own, stage, epochs=5) for name, own in machines.items()}
results["bench-B"]

# %%
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), sharey=True, layout="constrained")
for ax, (name, own) in zip(axes, results.items(), strict=True):
    own.health.plot("coupling_stiffness", ax=ax)
    ax.set_xlabel(f"{name}: running time in hours")
axes[1].plot(168 * np.arange(10), 100 * (1 - 0.004 * np.arange(10)) ** 2, "k--", label="truth")
_ = axes[1].legend()

# %% [markdown]
# `bench-A` keeps its stiffness. `bench-B` falls as it must; the dashed line is the truth. If the
# fall goes on, the limit of 80 % is reached 2,922 hours after the last log.

# %%
stiffness = results["bench-B"].health.to_frame().iloc[-1]
print(f"bench-B: {stiffness.q05:.3f} to {stiffness.q95:.3f}, truth {(1 - 0.004 * 9) ** 2:.3f}")
assert stiffness.q05 < (1 - 0.004 * 9) ** 2 < stiffness.q95
results["bench-B"].prognosis

# %% [markdown]
# **What this does not show.** That real couplings loosen in this way: the fall is made, the chain
# from samples to stiffness is real. Nor the effect of temperature or load, which weeks of logs of
# your machine must show; nor that the formula of the map holds for your machine.
