"""Constants that decide which health, verdict, remaining life and service date are published.

A parameter is informed above `lmshealth.stage.constants.INFORMED`, which planning shares.
"""

import numpy as np

from lmshealth.stage.priors import Lognormal, Normal

# What a life needs.
MIN_LOGS = 3
"""Logs with an informative mode: with fewer, a slope is not separated from the intercept."""
MAX_LOGS = 200
"""Longer histories are condensed: the cost of Σ grows with the third power of the logs. Medians and
widths of health change by less than a quarter of a 90 % interval when 240 logs become 40 (test)."""

# Priors of nuisance parameters; studies/life/calibration has the ranks of the truth under them.
INTERCEPT_STD = 0.1
"""Standard deviation of ln f of a mode at the baseline: so wide that only the data decide."""
STEP_PRIOR = Normal(0.0, 0.3)
"""Ln factor on a health parameter at a step: one standard deviation is a loss of a quarter."""
WALK_STDS = (1e-5, 5e-4, 1.5e-3, 5e-3, 1.5e-2)
"""Standard deviations over the history of the random walk of ln f: from none to several times the
0.4 % that frequencies of a real building move by (studies/modes/real)."""
WALK_PRIOR = (0.3, 0.3, 0.25, 0.12, 0.03)
"""Their probabilities: a random walk over a life as large as wear is rare."""
NOISE_SCALES = (1.0, 1.5, 2.25)
"""Factors on the reported standard deviations of ln f; 1 is probable, as 95 % intervals of the
identification cover 95 % (studies/modes/identification)."""
NOISE_SCALE_PRIOR = (0.9, 0.07, 0.03)
DEVIATION_STDS = (0.0, 0.0125, 0.05)
"""Standard deviations over the history of ln health about its law: exact laws, and deviations that
grow to a tenth and to a third of the loss at a limit of 0.6 over ten times the travel seen."""
DEVIATION_PRIOR = (0.6, 0.3, 0.1)

# A mode that moves alone, see posterior/README.md.
LONE_STD = 0.02
"""Standard deviation at the last log of the drift of a mode that moves by a cause of its own."""
LONE_EXPONENTS = (0.5, 1.0, 2.0)
"""Powers of the travel by which it may grow, equally probable: smooth, from early to late. Under a
Brownian path a smooth drift is improbable."""
LONE_WALKS = ((5e-4, 0.6), (1.5e-3, 0.4))
"""Random walks of all modes beside it, with probabilities."""
LONE_NAMED = 0.5
"""Probability from which such a mode is named beside another verdict."""

# A wander that all modes have in common, see posterior/README.md.
COMMON_STDS, COMMON_LOGS = (1e-3, 3e-3), (2.0, 8.0)
"""Its standard deviations of ln f, equally probable, and the numbers of logs that it lasts."""

# A first log that those after it contradict, see posterior/README.md.
FIRST_LOG_STD = 0.03
"""Standard deviation of ln f of a first log in error."""
FIRST_LOG_PRIOR = (0.5, 0.25, 0.25)
"""Probabilities that it is right, in error in each mode by itself, and in all modes alike."""

# Posterior over scenarios, see posterior/README.md.
MIN_PROBABILITY = 0.01
"""Scenarios with a lower probability are not published."""
MAX_GRID_LOSS = 3e-3
"""Share of the posterior of the grid points that are left out after rough draws of the scenario
without and of that with the freest change."""
MIN_CHAIN_PROBABILITY = 0.1
"""Scenarios with a lower probability are drawn by importance sampling only: their share of all
draws is too small for chains to change a quantile."""
MAX_LOG_ODDS = 9.0
"""Scenarios so much less probable than the best by a rough evidence are dropped (1 : 8100)."""

# Beyond the laws, see README.md.
RATE_STD, ACCELERATION_STD = 0.075, 0.7
"""Standard deviation of ln of the travel left by a law for a future as long as the travel seen;
intervals open with distance. The second is of a loss that accelerates: logs up to now determine
neither its exponent nor whether the acceleration lasts."""
UNSEEN_ONSETS = 0.5
"""Onsets of a fast end in the travel proven without one, in place of the none that happened: the
Gamma shape of the hazard by Jeffreys's prior [Jeffreys1946]."""
EARLY_LIFE = 0.05
"""Share of the machines of a description, or of a fleet, that have ended by the travel which counts
as proven without an onset, beside the machine's own."""
UNSEEN_GROWTH = Lognormal(0.2, 1.0)
"""Travel from such an onset to the end over the travel at the onset: 4 % to 100 % (90 %), sudden
breaks to wear that doubles its rate once."""

# Usage, see README.md.
USAGE_CHANGED = 0.3
"""Prior probability that the travel per day has changed in the record, as by a second shift."""
USAGE_SCATTER, USAGE_KNOWN = 0.2, 2.0
"""Relative scatter of the travel between two logs that is expected, and the number of increments
that this counts as. Rates of two phases differ by about the mean rate."""
USAGE_ENDS = 0.5
"""Ends of the present usage in the days that it has lasted, as `UNSEEN_ONSETS`."""

# Fleet prior, see README.md.
MIN_MACHINES = 3
"""Other machines that a fleet prior needs: with fewer, the variance between machines is mixed with
the variance between fleets."""
MIN_LAW_PROBABILITY = 0.05
"""A law with a lower probability does not decide the remaining life, nor whether it is informed."""
FLEET_MEAN = np.linspace(-3.0, 3.0, 41)[:, None]
"""Grid of the mean m of a fleet in standard deviations of the description's prior."""
FLEET_VARIANCE = (np.arange(12) + 0.5) / 12
"""Grid of the variance v between the machines of a fleet, uniform on (0, 1). Its lowest value is a
fifth of the prior's standard deviation: machines that are more alike change no date."""
FLEET_DIGITS = 2
"""Significant digits of a fleet prior: with more, one new log would recompute a whole fleet."""

# Calibration by ended lives, see README.md.
CALIBRATED_RISK = 0.1
"""Share of machines that may end before the calibrated travel: nine ended lives are the least that
support it; 5 % would need nineteen, more than most fleets have."""
LIFE_SHARES = (0.3, 0.6, 0.9)
"""Shares of an ended life after which its end is predicted: young, middle-aged and old."""
MIN_PAST = 0.5
"""Probability of being past a limit at its last log from which an ended life has reached it."""

# Sampling.
N_DRAWS = 4000
"""Draws of the published posterior, of all ensembles together."""
MAX_EPOCHS = 40
"""Epochs of which health is published by default: a trend shows no more detail."""
# Convergence. Four chains are the least that [Vehtari2021] recommends for R-hat, and 1.01 is its
# recommended limit; 50 autocorrelation times are what the authors of emcee require for an estimate
# of that time [ForemanMackey2013]. A fit that needs more steps ends with `NotConverged`.
N_ENSEMBLES = 4
MIN_AUTOCORRELATION_TIMES = 50
MAX_R_HAT = 1.01
MAX_CHAIN_STEPS = 20_000
MIN_ESS = 400
"""Effective draws of a posterior by importance sampling: as many as [Vehtari2021] asks of chains.
The relative standard deviation of the evidence is then at most 5 %."""

MAX_PARETO_K = 0.7
"""Largest Pareto k of importance weights [Vehtari2024]: above it their variance is not finite in
practice, and chains are run."""
EMCEE_EVERY = 16
"""Logs after which chains sample a life that importance sampling has updated since."""

# Publication and verdict.
MIN_FIT = 1e-3
"""Residuals of a life whose χ² is less probable are explained by no state of the parameters and no
mode that moves alone: then no health is published."""

RISEN = 1.05
"""Share of its baseline that no wear reaches: above it with 95 %, a parameter is not healthy."""

DEGRADED_SHARE = 0.25
"""A parameter is degraded once it has lost this share of the distance from baseline to limit. At a
limit of 0.6 this is a loss of 10 %, four half-widths of a 90 % interval of the shipped stages."""
LOSS_WITHOUT_LIMIT = 0.4
"""Share of the baseline that a parameter without limit may lose: as the preload of lms-y."""

EDGE_SHARE = 0.01
"""A posterior is at the edge if its 5 or 95 % quantile is closer to an end of the map than this
share of the map's range in ln parameter."""

STEP_PROBABILITY = 0.1
"""Prior probability that a machine has a sudden change without declared cause since its baseline.
The tracker's evidence for a step is against wander, outliers and running-in at their own priors."""
