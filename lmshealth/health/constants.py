"""Constants that decide which health and which verdict are published.

A parameter is informed above `lmshealth.stage.constants.INFORMED`, which planning shares.
"""

MAX_EPOCHS = 40
"""Epochs that `infer` takes by default: a trend shows no more detail."""

# Convergence. Four chains are the least that [Vehtari2021] recommends for R-hat, and 1.01 is its
# recommended limit; 50 autocorrelation times are what the authors of emcee require for an estimate
# of that time [ForemanMackey2013]. An epoch that needs more steps is marked as not converged.
N_ENSEMBLES = 4
MIN_AUTOCORRELATION_TIMES = 50
MAX_R_HAT = 1.01
MAX_STEPS = 20_000
MIN_ESS = 400
"""Effective draws of a posterior by importance sampling: as many as [Vehtari2021] asks of chains.
The relative standard deviation of the evidence is then at most 5 %."""

MAX_PARETO_K = 0.7
"""Largest Pareto k of importance weights [Vehtari2024]: above it their variance is not finite in
practice, and chains are run."""
JUDGED_EVERY = 16
"""Of so many epochs one, and the last, is sampled by chains too; the difference is published."""
JUDGE_ENSEMBLES = 2
"""Ensembles of such chains: as many as R-hat needs, since their draws are not published."""

MIN_FIT = 1e-4
"""Drifts whose probability under the best state of the parameters is lower are unexplained.
At most one machine in 10,000 is refused by chance."""

DEGRADED_SHARE = 0.25
"""A parameter is degraded once it has lost this share of the distance from baseline to limit. At a
limit of 0.6 this is a loss of 10 %, four half-widths of a 90 % interval of the shipped stages."""
LOSS_WITHOUT_LIMIT = 0.4
"""Share of the baseline that a parameter without limit may lose: as the preload of lms-y."""

PRIOR_FACTOR = 2.0
"""Factor on the width of the priors by which the sensitivity of a posterior is checked."""
MIN_WIDENING = 1.2
"""Priors that the map cuts to less than this factor on their 90 % interval are not checked."""
EDGE_SHARE = 0.01
"""A posterior is at the edge if its 5 or 95 % quantile is closer to an end of the map than this
share of the map's range in ln parameter."""

STEP_PROBABILITY = 0.1
"""Prior probability that a machine has a sudden change without declared cause since its baseline.
The tracker's evidence for a step is against wander, outliers and running-in at their own priors."""
