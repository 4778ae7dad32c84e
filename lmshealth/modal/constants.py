"""Constants that decide which modes are published, flagged or refused.

Probabilities of false alarms, margins of evidence, limits of uncertainty and bounds of searches.
Numerical tolerances, step sizes and iteration counts are next to the code that uses them.
"""

# Every method

# Usable share of the sample rate: anti-alias filters reach below the Nyquist frequency.
USABLE = 0.45
# Standard deviations of ln f and ln ζ beyond which an estimate is refused, before an average over
# coloured forces widens it: a frequency known to 3 % cannot show the drifts that are tracked, a
# damping known to a factor of two cannot be used.
WORST_STD_LN_F, WORST_STD_LN_ZETA = 0.03, 0.7
# Most channels of free decays that are fitted together, those that add most to each other: the time
# of a fit grows with the cube of their number, and 10 hold all but 2 % of the information of 16.
MOST_CHANNELS = 10
# Most modes of free decays that are fitted together.
MOST_TOGETHER = 4

# Naming

# Probability of an assignment from which on a resonance gets the name; pairings below the second
# are not quoted in a refusal.
CLEAR_NAME, UNLIKELY_NAME = 0.8, 0.01
# Probability below which a name beside resonances that no description has is flagged as doubtful:
# of those without the flag one in twenty is wrong at most.
SURE_NAME = 0.95
# Then, of a machine that stands at its description, standard deviation of the common shift as a
# share of the search; and scales of ln ζ and of 1 - MAC about the described values.
NO_SHIFT, DAMPING_PRIOR, SHAPE_PRIOR = 1 / 10, 0.5, 0.1
# Differences from the description that search and map do not explain: of frequency, factor of
# damping (beyond two standard deviations), and modal assurance criterion.
OFF_FREQUENCY, OFF_DAMPING, OFF_SHAPE = 0.03, 2.5, 0.8
# Log likelihood that a named mode gains over a missed mode and an unknown resonance, where it has
# moved as much as all have in common.
NAME_GAIN = 4.6
# Largest factor between the damping ratio found and the one described.
DAMPING_SPAN = 10.0
# Standard deviations of the prior of shifts of ln f, as shares of the search: common to all modes
# (wear of a guide moves them together), and of each mode alone.
COMMON_SHIFT, OWN_SHIFT = 1 / 2, 1 / 6
# States of wear on the modal map, which moves modes apart by more: half of the prior of wear.
WEAR_STATES = 512

# Ambient identification

# Least duration of a segment in periods of the top of the band, without a description; with one,
# `stage.constants.LEAST_RESOLUTION` holds.
SEGMENT_PERIODS = 10.0
# Least number of Fourier frequencies in the band, without a description.
LEAST_FREQUENCIES = 50
# Largest factor between the bandwidths of modes that are fitted together: a narrow peak on a broad
# resonance needs a resolution of its own.
SIMILAR_BANDWIDTH = 8.0
# Probability that noise alone makes a line somewhere in the band of a cluster.
LINE_FALSE_ALARM = 1e-3
# Expected gain in log likelihood below which a channel does not show a mode, and margin by which
# the Bayesian information criterion must gain with a mode.
ABSENT, EVIDENCE_MARGIN = 3.0, 10.0
# Search without a description: share of the orders of a subspace model in which a candidate occurs;
# gain in log likelihood by which it enters the joint model, and by which the residual of that model
# shows a further mode, and where one is described (evidence decides afterwards); most modes that
# are published from one fit.
STABLE, LEAST_START, LEAST_EXCESS, LEAST_HINTED, MOST_FOUND = 0.4, 15.0, 40.0, 15.0, 5
# Dispersion (variance of the residual over that of noise): flagged as loose-fit, refused as
# poor-fit; and the ordinates needed to measure it.
LOOSE_FIT, POOR_FIT, LEAST_ORDINATES = 1.5, 3.0, 30
# Mean square of the intensity of a mode's excitation over the square of its mean, flagged as
# unsteady: intervals are wider by a tenth; standard deviations of steady noise above one; and mean
# of the exponential prior of the logarithm of an unsteady one, as probable as a steady one.
UNSTEADY, UNSTEADY_SIGMAS, MEAN_LN_UNSTEADY = 1.2, 5.0, 0.5
# Standard deviations of the heights of the log spectrum of coloured forces, each as probable as a
# white force, and probability of a coloured one from which on modes are flagged.
WIDTHS_COLOUR, COLOURED = (0.2, 0.5, 1.2), 0.99
# Fourier frequencies in the half-power bandwidth below which a mode is flagged resolution-limited.
RESOLVED = 4.0
# Share of the search, or of the span of dampings, beyond which a mode is flagged at-bound.
AT_BOUND = 0.9
# Largest Newton decrement of a fit that has converged.
WORST_DECREMENT = 0.1
# A resonance is a harmonic that wanders where the kurtosis of its envelope (2 for noise, 1 for a
# sine) is below the second value and by so many standard deviations below that of noise.
WANDERING_SIGMAS, WANDERING_KURTOSIS = 3.5, 1.7
# What Thomson's test takes for a line is a light mode where the kurtosis is above that value, and
# the sum of the squares of the envelope over that of their moduli is below this one: it is 1 for a
# sine of any amplitude modulation, and small for noise.
STEADY_PHASE = 0.5
# Damping ratio above which a resonance without a description is attributed to the noise.
MOST_DAMPING = 0.1
# Least distance of two modes in half-power bandwidths, where channels see them alike (modal
# assurance criterion above the third) and otherwise: strength and damping of closer modes cannot be
# estimated separately, and their likelihood is not normal.
SEPARATION_ALIKE, SEPARATION, ALIKE_MAC = 1.0, 0.2, 0.8
# Standard deviations within which modes that different channels show are one, and the ratio of
# dampings up to which those of different clusters are.
SAME_SIGMAS, DUPLICATE_DAMPING = 3.0, 4.0
# A mode of a damping ratio below this, a bandwidth of five times that of a line, may look like one,
# or be what is left beside a masked one: where it is described, the fit decides.
LIGHT = 0.0025
# Standard deviations of the priors. Weak ones about the start, which bound directions that data do
# not constrain: ln f, ln ζ, forces of modes, shapes, and level, slope and bend of ln noise floors;
# the level of few of many directions is known from the others: 0.03 would be too sure.
PRIOR_LN_F, PRIOR_LN_ZETA, PRIOR_FORCE, PRIOR_SHAPE = 0.2, 2.0, 30.0, 30.0
PRIOR_FLOORS = (5.0, 2.0, 1.0), (0.3, 2.0, 1.0)
# Of what is not in phase, over what is: of forces that reach modes with a delay, and of shapes. By
# how many standard deviations of chance it must gain to be included in a search, and in a fit.
PRIOR_QUADRATURE, QUADRATURE_SIGMAS = (3.0, 0.3), (4.0, 2.0)
# Standard deviations of priors that are marginalised over these widths, of which the fit uses the
# last: the share of a floor that is coherent with the modes and with other floors (in units of the
# floor), its bend, and the static response of a mode, over its receptance, less that of the band.
WIDTHS_SHARED, WIDTHS_COMMON, WIDTHS_BEND = (0.03, 0.1, 1.0), (0.03, 0.3, 3.0), (0.03, 0.1, 1.0)
WIDTHS_STATIC = (0.03, 0.2, 1.0)

# Frequency responses and free decays

# Gain in log likelihood beyond the Bayesian information criterion that a pole needs, as the best of
# many places gains by chance.
POLE_EVIDENCE_MARGIN = 5.0

# Frequency responses

# Least samples of a stretch, and of a period.
FRF_SAMPLES, FRF_PERIOD_SAMPLES = 256, 32
# Standard deviations by which the mean coherence must exceed that of noise.
COHERENT_SIGMAS = 5.0
# A line counts as excited from this share of the strongest amplitude of the input, and from this
# ratio of its power to its noise: noise of a weaker input biases the damping by more than half its
# standard deviation.
EXCITED, CLEARLY_EXCITED = 0.2, 30.0
# Lines needed with periods and without (the noise has to be estimated, too), and most that are
# fitted; and those of a measured response whose noise is unknown, twice the unknowns of one mode.
FRF_LINES, FRF_LINES_OF_RECORD, FRF_MOST_LINES = 16, 64, 20_000
FRF_LINES_OF_UNKNOWN_NOISE = 34
# Variance of unknown noise from which a fit starts, over the power of the answer.
UNKNOWN_NOISE = 1e-4
# Probability that the first of several equal periods is taken for a transient.
TRANSIENT = 1e-3
# Probability that noise alone makes an outlier, and the largest share of lines that may be ones.
OUTLIER_FALSE_ALARM, MOST_OUTLIERS = 1e-3, 0.1
# Most modes of one response. A background of powers and heavily damped poles needs this in -2 ln L
# per unknown (Akaike's criterion): lacking, it would bias the modes.
FRF_MOST_MODES, FRF_BACKGROUND_COST = 8, 2.0
# Damping ratio above which a pole belongs to the background.
FRF_MOST_DAMPING = 0.2
# Gain in -2 ln L from which on a distortion is included: 1 % of linear responses reach it. Each
# mode within a half-power bandwidth, and fits from other starts, must reduce the distortion to
# this share: distortion bends whole resonances and looks like further modes.
DISTORTED, LESS_DISTORTED = 6.6, 1 / 3
# A fit that misses this share of the response (amplitude, beyond noise) shows no modes, and where
# this share is noise, it may be why none is found: the real benches of studies/modes/frf, bent by
# friction, miss up to 0.12.
FRF_MISSED = 1 / 3
# Harmonics below this share of the strongest amplitude of the input have none; an output above the
# second share there shows that a response is missed because it is nonlinear.
NO_INPUT, NONLINEAR_OUTPUT = 0.01, 0.05
# Lines of a periodic excitation within this many half-power bandwidths that a mode needs: with two
# complex values the four real unknowns of a mode are solved for, with a third they are checked.
LINES_OF_MODE, BANDWIDTHS_OF_LINES = 3, 3
# Least power of a mode over that of the distortion around it.
OVER_DISTORTION = 16.0

# Impact tests

# Level at which a blow triggers, over the strongest and over the noise of the force.
TRIGGER, TRIGGER_SIGMAS = 0.02, 6.0
# A force is recognised as blows if less than this share of its samples exceeds a tenth of the peak
# (noise of that crest factor does not exist) and its pulses hold this share of its energy (a spike
# in a random force does not). So many equal intervals are a periodic excitation.
BLOW_DUTY, BLOW_ENERGY, BLOW_REPEATS = 0.05, 0.2, 3
# A hammer bounces back within 0.1 s, and nobody strikes twice on purpose in this time in s. The
# share of the main hit from which another counts: below it, it is ringing of the filter.
DOUBLE_WITHIN, SECOND_HIT = 0.25, 0.05
# Blows below this share of the strongest are touches.
WEAK_BLOW = 0.1
# Most lines of a blow: decays are cut accordingly, which does not bias their poles.
BLOW_LINES = 3000

# Free decays

# Least periods of the lowest mode in a decay, and least ordinates of a band.
DECAY_PERIODS, DECAY_ORDINATES = 4.0, 12
# Probability that noise alone makes a peak somewhere.
DECAY_FALSE_ALARM = 1e-3
# Probability of the residual's correlation below which decays are not in stationary noise.
NOT_STATIONARY = 1e-3
# Most poles of a band.
DECAY_MOST_POLES = 6
# A damping less than this many standard deviations from zero is too uncertain; where the mode
# fades by less than this share over the record it may be a line.
DECAY_DAMPING_SIGMAS, LEAST_FADING = 3.0, 0.6
# Largest damping ratio, and least mean square of a vibration after the stops over that of the
# ambient response.
DECAY_MOST_DAMPING, DECAY_EXCITATION = 0.1, 16.0

# Several set-ups

# Largest difference in ln f and least MAC over common channels of one mode in two set-ups.
SETUP_LN_F, SETUP_MAC = 0.02, 0.8
# Probability of the scatter of frequencies and dampings below which they are widened.
SETUP_P_VALUE = 0.01
# Least share of a shape, squared, in the channels that set its scale.
SETUP_EIGENVALUE = 0.01
