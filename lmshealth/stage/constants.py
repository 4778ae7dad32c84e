"""Constants that decide what is accepted and published of a stage description."""

# --- Ranges of the numbers of a description -------------------------------------------------------
# Wider than any machine: buildings vibrate at 0.1 Hz, ultrasonic drives at 10⁵ Hz; quartz has a
# damping ratio of 10⁻⁷. Within them nothing that is computed overflows or is lost in rounding.
FREQUENCY_HZ, DAMPING_RATIO, SNR = (1e-3, 1e7), (1e-7, 0.99), (1e-6, 1e12)
# Part of the frequency that a mode is searched in: healthy machines drift by more than the least.
SEARCH = 1e-4, 0.9
# Health parameters in their units, with their priors and limits; travel and its rates; sigma of a
# logarithm; exponents of wear.
VALUE, LIFE_KM, SIGMA, EXPONENT = (1e-12, 1e12), (1e-6, 1e12), (1e-4, 10.0), (0.01, 20.0)
# Least relative width of a distribution, and least standard deviation of a ln parameter: rounding.
LEAST_WIDTH, LEAST_PRIOR_STD = 1e-9, 1e-5
# Coefficients of covariates per unit and their references; places of sensors in m; components of
# shapes and directions in any unit, of which the largest is not rounded to 0.
EFFECT, REFERENCE, PLACE_M, COMPONENT, LEAST_COMPONENT = (1e-12, 1e3), 1e9, 1e6, 1e9, 1e-9
WAVELENGTH_MM, KM_PER_DAY, HORIZON_KM = (1e-6, 1e9), (1e-9, 1e6), (1e-3, 1e10)
WEIGHT, RISK, MOST_COST_RATIO = (1e-6, 1e6), (1e-9, 1 - 1e-9), 1e9
# Least ratio of neighbouring values of a parameter on the grid of a map.
LEAST_STEP = 1 + 1e-6

# --- Health parameters -------------------------------------------------------------------------
# Least share of the prior variance of a ln parameter that the data must remove before its value is
# published: from a half on the data contribute more than the prior.
INFORMED = 0.5
# Numbers and durations (s) of logs beyond which a plan is impractical. What such logs leave
# uncertain at both the baseline and now is the error of the map.
MOST_LOGS, LONGEST_LOG = 10_000, 3600
# Least prior probability inside the modal map; below it, map and prior describe two machines.
LEAST_PRIOR_MASS = 1e-6
# Least prior probability of a law's parameter in its admissible range.
LEAST_LAW_MASS = 0.01
# Accepted risk of reaching a limit before the service, where [decision] states nothing.
MAX_RISK = 0.05
# Words of verdict.csv for the parameters of lms-x and lms-y (every other parameter has its own
# name), and those that name no parameter.
VERDICT_WORDS = {"guide_preload": "preload", "mount_stiffness": "mount"}
RESERVED_WORDS = ("healthy", "both", "step", "alarm", "no-alarm", "not-enough-data", "outside-map")

# --- Error of the modal map ---------------------------------------------------------------------
# Factors on the declared errors of a map, with prior probabilities: machines may differ from that
# which it was made from by more than its maker knows. The modes of each machine weigh them.
MAP_ERRORS = ((1.0, 0.75), (2.0, 0.25))

# --- Identification, as the Cramér-Rao bound assumes it -----------------------------------------
# Half-width of the band that a mode is fitted in, in damping ratios times its frequency. Beyond it
# a resonance adds little information, and the noise need not be as simple as the model.
BAND_HALF_WIDTH = 8.0
# Least duration of a segment times the half-power bandwidth of a mode identified in it.
LEAST_RESOLUTION = 2.0
# Fourier frequencies that are summed; from there on a bound is inverse to the duration.
MOST_ORDINATES = 400_000

# --- Check of a description ---------------------------------------------------------------------
# Duration in s of the typical logs of the check; there are as many now as in the baseline.
TYPICAL_DURATION = 60.0
# Largest error of ln f of a good surrogate: below the standard deviation of any measurement.
SURROGATE_TARGET = 1e-5
# Share of the uncertainty of typical logs below which an error of the surrogate is no fault, and
# exponent times relative prior width below which a combination omits a parameter.
NEGLIGIBLE_SHARE = 0.05
# Prior probability outside the map from which the check recommends a wider map.
PRIOR_OUTSIDE = 0.01
# Correlation from which the check explains its sign.
NOTABLE_CORRELATION = 0.5

# --- Planning -----------------------------------------------------------------------------------
# Durations in s that a plan compares by default.
DURATIONS = (10.0, 20.0, 60.0, 120.0, 300.0, 600.0)
