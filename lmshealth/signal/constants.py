"""Constants that decide which samples, lines and levels are used and published."""

# --- Segments -----------------------------------------------------------------------------------
# Change of the set velocity over this time in s, but at least so many samples, as a share of its
# maximum, up to which it is constant.
VELOCITY_LAG, LEAST_VELOCITY_LAG, VELOCITY_TOLERANCE = 1e-3, 20, 1e-3
# A slow ramp changes by more than `SAME_VELOCITY` of the maximum from this time in s before to this
# time after: ramps from rest within ten seconds are found.
SLOW_RAMP_LAG = 0.1
# Range in m of a set position within which a stage is at rest: above the noise of a measured
# position, below every move of a stage whose strokes are millimetres and more.
LEAST_MOVE = 1e-6
# Time in s after a move in which the stage settles: some periods of its slowest modes and loop.
SETTLING_TIME = 0.5
# Relative difference up to which two set velocities are one: encoders measure them to a percent.
SAME_VELOCITY = 0.01
# Segments shorter than this share of the longest do not define the velocity of a log: the top of
# a triangular move has constant velocity for an instant.
LEAST_LENGTH = 0.05
# A segment of more than a minute is cut into parts of at least this many shortest segments.
PARTS_LENGTH = 10
# Segments of more lengths than this (a log of many gaps) are shortened to common ones, each by at
# most this share: a standard deviation grows by 5 % at most, and a log takes seconds, not minutes.
MOST_LENGTHS, SHORTENED = 24, 0.1

# --- Lines --------------------------------------------------------------------------------------
# Relative width of a line: it keeps its phase for about a thousand periods (mains wander by some
# 10 mHz).
LINE_WIDTH = 1e-3
# Probability that noise and resonances alone show a line somewhere in the band of one channel.
LINE_TEST_FALSE_ALARM = 0.01
# Damping ratio of the narrowest resonance that the multitaper test takes for noise.
LEAST_DAMPING = 0.002
# False-alarm probability of the test that noise rises towards a line, which decides whether the
# narrowest resonance or flat noise is the null hypothesis.
RISE_FALSE_ALARM = 0.02
# Mains frequencies in Hz, and the highest harmonic by which a line is named.
MAINS = (50.0, 60.0)
MOST_HARMONICS = 10
# Ratio from which two velocities separate an order from a line of fixed frequency.
OTHER_VELOCITY = 1.02

# --- Removal of strong sinusoids ----------------------------------------------------------------
# Ratio of an ordinate to the median of its surroundings from which it may be a sinusoid.
SINUSOID_CONTRAST = 60.0
# Largest ratio, after the fit of a sinusoid, of its surroundings to those further away: around a
# resonance it stays larger.
SINUSOID_RESIDUAL = 4.0
# Damping ratio of the narrowest resonance where no description states any, and the width in
# ordinates from which a resonance is distinct from a sinusoid.
LEAST_EXPECTED_DAMPING = 0.005
DISTINCT_WIDTH = 8.0

# --- Following error ----------------------------------------------------------------------------
# Harmonics that a reading keeps, and the amplitude in m up to which they are noise: six counts of
# the encoder [Piscalov2021].
N_HARMONICS = 100
ENCODER_FLOOR = 30e-9
# Band in Hz of the error left by the control loop: a servo acts below its crossover, and the modes
# of guide and mount lie above.
LOOP_BAND = (1.0, 40.0)
# Periods of its lower end that a segment must hold: detrending removes slower content.
LOOP_PERIODS = 2.0

# --- Acceleration levels ------------------------------------------------------------------------
# Spacing and range in Hz of the bands without a description: rows of Tables 6 and 7 of
# [Piscalov2021].
LEVEL_BAND_SPACING = 10.0
LEVEL_BAND_RANGE = (10.0, 400.0)
# Half-width of the band of a mode in damping ratios.
MODE_BAND_HALF_WIDTH = 2.5
# One-sided significance of growth with velocity: one in twenty bands without growth shows it.
SIGNIFICANCE = 0.05
# Least number of harmonics in a band.
LEAST_ORDINATES = 3
