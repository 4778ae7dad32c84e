"""Constants that decide what a track publishes.

Frequencies enter as ln f and damping ratios as ln ζ. Rates and random walks are per "life":
`LOGS_PER_LIFE` mean distances between the logs so far, by odometer or time.
"""

import numpy as np

# --- Alarms and change detection ----------------------------------------------------------------
# Probability that a machine without damage ever raises an alarm, however many logs are judged. A
# log Bayes factor of ln(routes / probability) is required (Ville's inequality [Ville1939]). It is
# no setting: the rates of alarms and detections in studies/robustness hold for this value only.
FALSE_ALARM_PROBABILITY = 0.01
# An alarm has three routes: drift since the baseline, drift that begins later, and a step.
ALARM_ROUTES = 3
# Mean standardised innovation over a window, times the root of its length, that opens the weighing
# of change hypotheses. Lower costs time only: what is published depends on the Bayes factor.
SUSPICION_GATE = 4.0
# The same from which the published filter allows for a rate that is new since the window began.
BEGUN_GATE = 3.0
# Standardised innovations count at most so much there: a single one opens no weighing for long.
MOST_INNOVATION = 6.0
# The kind of a change is settled at these odds over all other kinds, or after so many logs.
KIND_LOG_ODDS = float(np.log(10.0))
KIND_PATIENCE = 8
# RMS of the following error below 40 Hz. Probability that a retuning of the servo changes it, and
# that any other event does: a new loop gain nearly always shows, wear hardly ever.
LOOP_CHANGE_PROBABILITY = {"servo": 0.99, "other": 0.02}
# Prior variance of such a change, in variances between logs [Gonen2005].
LOOP_CHANGE_VARIANCE = 100.0
# Logs before and after that are compared, the fewest before, and the p-value of two following
# errors in a row that mark a possible retuning.
LOOP_LOGS, LOOP_FEWEST, LOOP_P_VALUE = 12, 3, 0.01

# Most steps since the baseline: with more, every piece of a life is too short for a law.
MAX_STEPS = 3

# --- Outliers and consistency -------------------------------------------------------------------
# Prior probability that the estimates of a mode, or of a whole log, are outliers. They scatter by
# this factor more than stated, or as widely as the priors below. Modes whose standardised
# innovations are inside the gate are no candidates: their odds would be below 1:10.
OUTLIER_PROBABILITY, OUTLIER_SCALE, OUTLIER_GATE = 0.02, 6.0, 2.5
# Published standard deviations are widened once the innovations are less probable than this.
WIDENING_P_VALUE = 5e-4
# Below these p-values a filter is not consistent: overconfident, or too cautious. The second is
# lower, because averaging over process noise is somewhat cautious for quiet machines.
OVERCONFIDENT_P_VALUE, CAUTIOUS_P_VALUE = 1e-3, 1e-6
# Of thousands of logs any deviation is significant: one between these ratios of squared innovations
# to their expectation, or an autocorrelation up to this, hardly changes an interval.
NEGLIGIBLE_NIS, NEGLIGIBLE_CORRELATION = (0.8, 1.1), 0.1
# Two-sided p-value outside of which NIS counts as "above" or "below" its 95 % band.
NIS_P_VALUE = 0.05

# --- Sample rates -------------------------------------------------------------------------------
# Most and fewest logs of the usual rate, the nearest, that a log of another rate is compared with.
# Its frequencies follow the ratio of the rates where that is so many standard deviations of their
# prediction; these are at least that of a frequency in a minute (io/README.md, "Time").
RATE_LOGS, FEWEST_RATE_LOGS, RATE_GATE, RATE_SPREAD = 6, 3, 4.0, 5e-4
# Where they cannot decide, a rate is noted that differs by less than this (a slip, not another
# setting) from that of the share of logs below.
RATE_NEAR, RATE_SHARE = 0.1, 0.75

# --- Priors of the state ------------------------------------------------------------------------
# Standard deviations of ln f and ln ζ about a mode's first estimate.
LN_F_STD = 0.1
LN_ZETA_STD = 1.0
# Rate of ln f of the published filter per life: 0.7 % a log, far beyond any wear.
PUBLISHED_RATE_STD = 1.0
# Random walk of ln ζ per life.
DAMPING_WALK = 0.5
# Bias of ln f and ln ζ between two sources of one mode.
BIAS_STD = (0.005, 0.2)
# d ln f per unit of a covariate that no stage description describes.
COVARIATE_STD = 0.001
# Possible effect on ln f of a covariate beyond its values so far from which that is noticed: 30 K.
EXTRAPOLATED = 0.03
# Amplitude of the daily cycle by which a structure may lag behind its temperature sensor (K), and
# the least that the times of the logs must resolve.
LAGGED_CYCLE, LEAST_CYCLE = 2.0, 0.5
# Jumps of ln f and ln ζ: a loosened bolt or a crash; grease; the loop's poles after a retuning; a
# sensor that was moved or recalibrated; an overhaul.
JUMP_STD: dict[str, tuple[float, float]] = {
    "step": (0.03, 0.3),
    "regreasing": (0.0, 0.3),
    "servo": (0.01, 0.2),
    "sensor": (0.005, 0.2),
    "reset": (0.05, 0.5),
}

# --- Process noise, averaged over its evidence (maximum likelihood collapses to none) -------------
# A life of the tracker is the clock of so many logs at their mean distance so far.
LOGS_PER_LIFE = 150
# Logs from which on a rate keeps its value when their mean distance, and with it the unit of rates,
# changes. Before, it is known little better than by its prior, which is per life of now: of a few
# logs of the first day, followed by one a month, the prior would be thirty times too wide.
KNOWN_RATE_LOGS = 10
# Random walk of ln f of a healthy machine, which has no rate, with probabilities.
HEALTHY_WALKS = ((1e-5, 0.3), (3e-4, 0.25), (1e-3, 0.25))
# A new or repaired machine may run in: its rate decays within so many logs, with probabilities,
# and ln f moves by so much altogether (standard deviation). Decays farther apart leave a remainder
# that raises alarms: with three, in 29 % of such lives.
RUNNING_IN_LOGS = tuple((logs, 0.2 / 6) for logs in (0.5, 0.75, 1.1, 1.7, 2.6, 4.0))
RUNNING_IN_STD = 0.03
# Random walk of ln f of a changing machine; its initial rates, the random walks of the rate, and
# probabilities.
CHANGING_WALKS = (1e-5, 1e-3)
# The last are of a machine that changes from log to log, by up to LN_F_STD or a few times that.
CHANGING_RATES = (
    (0.03, 0.01, 0.2), (0.03, 0.1, 0.2), (0.3, 0.1, 0.2), (0.3, 1.0, 0.2), (1.0, 3.0, 0.1),
    (30.0, 300.0, 0.1),
)  # fmt: skip
# A machine that changes slowly (initial rates up to this) may have run in as well: random walk of
# ln f that ends within so many logs, altogether of this standard deviation, with probabilities.
SETTLING, SETTLING_LOGS, SLOW_RATE = ((0.0, 0.65), (0.004, 0.35)), 1.0, 0.03
# Share of the variance of rates that all modes have in common: damage lowers most modes.
RATE_COMMON = 0.9
# Prior probability of the healthy group. It cancels in the Bayes factor of an alarm.
HEALTHY_PROBABILITY = 0.2
# Factors on the reported standard deviations of one source, with prior probabilities. Sources past
# the third share the factor of the third, to bound the size of the grid.
SOURCE_NOISE_SCALES = (
    (0.05, 0.005), (0.15, 0.01), (0.4, 0.02), (0.7, 0.06), (1.0, 0.75), (1.5, 0.10), (2.25, 0.03),
    (4.0, 0.02), (8.0, 0.004), (20.0, 0.001),
)  # fmt: skip
# Combinations of scales of several sources that are less probable are left out.
LEAST_SCALES_PROBABILITY = 1e-3
# Wander of ln f from log to log that is no wear: size in errors of the estimates, correlation
# length in logs, probability; and the share of its variance that all modes have in common.
WANDERS = (
    (0.0, 0.0, 0.7),
    *((size, logs, 0.3 / 9) for size in (0.7, 2.0, 5.0) for logs in (2.0, 6.0, 20.0)),
)
WANDER_COMMON = 0.3
MOST_SCALED_SOURCES = 3

# --- Association: gates --------------------------------------------------------------------------
# Posterior probability from which an estimate is assigned to a mode.
LABEL_PROBABILITY = 0.95
# An assignment is unique if every estimate is within the inner gate of its mode and outside the
# outer gate of all others (standard deviations), with at least this MAC.
INNER_GATE, OUTER_GATE = 4.0, 12.0
LEAST_MAC = 0.8
# A crash moves all modes: two named modes or more that are all outside this gate about every mode
# seen before, while their names agree, open the log for steps.
JUMP_LN_F, JUMP_GATE, JUMP_COVARIATE_GATE = 0.003, 6.0, 2.0

# --- Association: hypotheses ---------------------------------------------------------------------
# Probability that a source shows a mode in a log.
DETECTION_PROBABILITY = 0.8
# Clutter: false estimates per log and unit of ln f, and their density in ln ζ (any value within an
# order of magnitude).
CLUTTER_DENSITY, CLUTTER_LN_ZETA_DENSITY = 0.1, 0.3
# Probability that a name is right, given the rule by which names are assigned.
NAME_PROBABILITY = 0.98
# Concentration of a Watson distribution of shapes: a direction known to 0.13 rad.
SHAPE_CONCENTRATION = 30.0
# Explanations and hypotheses with less than this share of the best are pruned; so many assignments
# per hypothesis, and so many hypotheses, are kept.
PRUNING_LOG_ODDS = float(np.log(1e-7))
MOST_ASSIGNMENTS, MOST_HYPOTHESES = 12, 24
# Hypotheses nearer than this (squared standard deviations) are merged.
MERGING_DISTANCE = 1.0
# Probability that a declared intervention changes the order of frequencies: modes step together.
REORDERING_PROBABILITY = 0.05
# Probability that a mode which strays takes the place of another one. Two modes that are apart do
# not exchange places from one log to the next: they cross, and are near each other for some logs.
TAKING_PROBABILITY = 0.01
# Modes nearer than this in ln f may veer, with this probability per log.
VEERING_LN_F, VEERING_PROBABILITY = 0.03, 0.02

# --- Association: filters of single modes (those of a stage that wears quickly: labels must not
# depend on a precise prediction) -----------------------------------------------------------------
RATE_STD, LEVEL_WALK, RATE_WALK, LN_ZETA_WALK = 0.3, 3e-3, 0.1, 0.3
DECLARED_STEP_STD = 0.05
# Probability of a stray innovation, and its standard deviations.
STRAY_PROBABILITY, STRAY_LN_F_STD, STRAY_LN_ZETA_STD = 0.05, 0.01, 0.7
# No life is assumed shorter than so many logs: early logs do not show its length. Nor is it shorter
# than so many of the gap before a log: many logs in a short time do not show it either, and a mode
# that may move by a life's drift in one gap may take the place of any other.
LEAST_LIFE_LOGS, LEAST_LIFE_GAPS = 50, 10
# A mode's shape is the mean of its first ones. Later shapes do not move it, so that a mode that
# takes another's shape is detected.
N_MEAN_SHAPES = 10

# Errors of a source are scaled anew, and all its logs associated again, once the scatter shows a
# scale that differs by more than this factor: gates and odds hardly depend on less.
LEAST_RESCALING = 1.4

# --- Association: track initiation ---------------------------------------------------------------
# Prior odds that an unassigned estimate is a mode's first, the probability that confirms it, and
# the odds at which it is deleted.
INITIATION_ODDS, CONFIRMATION_PROBABILITY, DELETION_ODDS = 1e-3, 0.95, 1e-5
# Logs that confirm a new mode, and a new level of a mode that is named.
LEAST_LOGS_NEW, LEAST_LOGS_NAMED = 3, 2

# --- Notes and tables ----------------------------------------------------------------------------
# Dates of few logs at one end are wrong, as of a clock without a battery: beyond a gap of a year
# (one log), or of ten years (a tenth of the logs), in which the odometer gains less than this share
# of what the other logs gain in that time. With a wrong date it gains the distance of two logs; a
# machine in use, a third or more. One that was idle so long loses one log, until a second one
# confirms its date. Rates need so many logs.
IDLE_S, LONGEST_IDLE_S, IDLE_SHARE, DATED_LOGS = 365.25 * 86400, 10 * 365.25 * 86400, 0.02, 5
# Of more logs in a row than these that contradict the others, or more than these and this share of
# all, it is not known which are right: a clock or an odometer was reset. Slips are single logs.
FEW_CONTRADICTIONS, CONTRADICTING_SHARE = 2, 0.15
# So many logs in a row without an assigned estimate of a mode are reported.
MISSING_LOGS = 3
# Smallest relative standard deviation of a frequency in a foreign table, and smallest and largest
# standard deviation of a drift: smaller ones are lost in rounding, a factor of 20 is no drift.
LEAST_RELATIVE_STD, LEAST_DRIFT_STD, MOST_DRIFT = 1e-7, 1e-9, 3.0
# Range of damping ratios, and relative standard deviation beyond which one has no information:
# their squares must be finite and positive.
DAMPING, MOST_RELATIVE_STD = (1e-9, 10.0), 1e3

# Logs of a history that is smoothed for its covariates: in a longer one few logs are so early that
# the filter knows its level less well.
MOST_SMOOTHED = 300
