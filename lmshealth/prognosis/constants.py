"""Constants that decide which remaining life and which service date are published."""

import numpy as np

from lmshealth.stage.priors import Lognormal, Normal

# What a life needs.
MIN_LOGS = 3
"""Logs with an informative mode: with fewer, a slope is not separated from the intercept."""
MAX_STEPS = 3
"""Steps since the baseline; with more, every piece of the life is too short for a law."""
MAX_LOGS = 200
"""Longer histories are condensed: the cost of Σ grows with the third power of the logs. Medians and
widths of health change by less than a quarter of a 90 % interval when 240 logs become 40 (test)."""

# Priors of nuisance parameters; studies/life/calibration has the ranks of the truth under them.
INTERCEPT_STD = 0.1
"""Standard deviation of ln f of a mode at the baseline: so wide that only the data decide."""
STEP_PRIOR = Normal(0.0, 0.3)
"""Ln factor on a health parameter at a step: one standard deviation is a loss of a quarter."""
WALK_STDS = (1e-5, 5e-4, 1.5e-3, 5e-3, 1.5e-2)
"""Standard deviations over the history of the random walk of ln f, equally probable: from none to
several times the 0.4 % that frequencies of a real building move by (studies/modes/real)."""
NOISE_SCALES = (1.0, 1.5, 2.25)
"""Factors on the reported standard deviations of ln f; 1 is probable, as 95 % intervals of the
identification cover 95 % (studies/modes/identification)."""
NOISE_SCALE_PRIOR = (0.9, 0.07, 0.03)
DEVIATION_STDS = (0.0, 0.0125, 0.05)
"""Standard deviations over the history of ln health about its law: exact laws, and deviations that
grow to a tenth and to a third of the loss at a limit of 0.6 over ten times the travel seen."""
DEVIATION_PRIOR = (0.6, 0.3, 0.1)

# Modes that disagree with the map, see README.md.
MAP_DOUBT = 0.95
"""Probability that the map is worse than declared at which modes are named: an error of a single
drift by 3.4 of its declared standard deviations, which chance makes in one life of 1500."""
MODE_ERROR_STD = 0.5
"""Relative error of a mode that disagrees: from none to a drift twice that of the map, or none."""

# Posterior over scenarios, see README.md.
MIN_PROBABILITY = 0.01
"""Scenarios with a lower probability are not published."""
MIN_CHAIN_PROBABILITY = 0.1
"""Scenarios with a lower probability are drawn by importance sampling only: their share of all
draws is too small for chains to change a quantile."""
MAX_LOG_ODDS = 9.0
"""Scenarios so much less probable than the best by a rough evidence are dropped (1 : 8100)."""

# Beyond the laws, see README.md.
RATE_STD, ACCELERATION_STD = 0.075, 1.0
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
SURPRISE = 0.01
"""Probability of as many early ends, were the predictions right, below which they are noticed."""

INSPECTION_RISK = 0.2
"""Share of the accepted risk that may come from ends between two logs that no log announced: small,
as the service date uses the risk that is accepted."""

MIN_SAVING = 0.01
"""A service that saves a smaller share of the long-run costs gets no date: 10,000 draws do not
resolve it."""
