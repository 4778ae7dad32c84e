"""Constants of the lives that a calibration draws, and of what it reports."""

# Schedule and usage.
LEAST_LOGS = 12
"""Logs of a life: a step that the tracker reports has five before and after it."""
LIFE_SEEN = 0.4
"""Share of the median life by the laws that has passed at the last log, where no usage is stated:
so late that parts are lost, and so early that most machines are still in service."""
LEAST_PACE = 0.05
"""Least travel between two logs as a share of its mean, about which it scatters."""
ODOMETER = 1e5
"""Odometer at the baseline in m."""
N_LIVES = 2000
"""Draws of the life by a law."""
STEPS_AHEAD = 4000
"""Steps to the horizon in which health that deviates from its law is followed."""

# What disturbs the estimates.
INTERCEPT_STD = 0.01
"""Standard deviation of ln f of a machine about its description. The prior of the estimator is so
wide that the posterior of health does not depend on it."""
COVARIATE_EFFECT = 0.003
"""Standard deviation of ln f by each covariate, such as 3 K of temperature with 0.001 per K: values
are drawn so that their prior effect has this size."""
MISSING = 0.05
"""Share of the estimates, and of the values of covariates, that is missing."""
RETUNED = 0.25
"""Share of machines whose servo is retuned once, which is declared."""
LOG_SCATTER = 0.3
"""Standard deviation of ln of the standard deviations of estimates, from log to log."""
CORRELATIONS = 0.9, 0.2
"""Correlation of the errors of one mode by two sources, and of two modes."""
MOST_TRIES = 1000
"""Lives that are drawn before a description whose laws leave its map is refused."""

# Report.
FALSE_VERDICT = 0.01
"""Probability, at most, that a right program is called wrong: the family-wise level of all checks
of the verdict together, whatever their number and dependence (Holm's rule)."""
LEAST_OF_KIND = 0.25
"""Lives of each kind, at least, as a share of those drawn from the description."""
LOSSES = (0.0, 0.02, 0.05, 0.1, 0.2, 1.0)
"""Edges of the groups of true losses whose detection is reported, as shares of the baseline."""
WRONG_WIDTHS = {0.5: "too narrow", 2.0: "too wide"}
"""Factors on the widths of intervals of the controls, which the check must find wrong, and how."""
