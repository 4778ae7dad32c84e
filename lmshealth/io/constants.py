"""Limits that decide which logs, channels and samples are refused, each below its justification.

They are read as ``constants.NAME``. Lengths of text and counts that only bound what damaged or
hostile files may claim were chosen far above every plausible export.
"""

from datetime import UTC, datetime, timedelta

# Most memory in bytes that decoding one variable (MAT), data set (UFF58) or segment (TDMS) may
# take: ten minutes of 20 kHz take 0.1 GB per channel. The option ``--max-memory``.
MAX_MEMORY = 2e9
# Most seconds that reading a file may take in a process of its own (beyond that a library loops):
# these (the variable ``LMSHEALTH_MAX_SECONDS``), and one for each so many bytes of a slow disk.
READING_SECONDS, SLOWEST_READING = 30.0, 5e6
# Most bytes of decoded samples per byte of the file: noise compresses by single digits. So many
# bytes are accepted whatever the ratio.
LARGEST_RATIO, SMALL_ENOUGH = 200, 256 << 20

# Channels

# Largest share of missing samples of a channel: the others would be cut at each of its gaps.
LARGEST_MISSING = 0.10
# SI value from which a sample counts as missing: nothing measured reaches it, its square is finite.
LARGEST_MAGNITUDE = 1e12
# Range in SI units below which a channel is constant: powers of its spectrum would be subnormal.
SMALLEST_RANGE = 1e-30
# Share of its variance that a channel must have beyond the others, else it is one of them again
# (rounding of float32 leaves 1e-14); samples of each block of 2¹⁸ that are compared.
DEPENDENT, COMPARED = 1e-9, 4096
# A channel is clipped from this share of its samples at both ends of the range, if they are so many
# times as frequent as those in so many levels next to them (a sine in steps of an encoder reaches
# 1 / 1.24), at least so many, and this share of their successors is there, too.
CLIPPED_SHARE, CLIPPING_RATIO, LEVELS_BELOW, FEWEST_STUCK, ADJACENT_SHARE = 1e-3, 2.0, 4, 5, 0.1
# Range in levels below which a signal is too coarse to judge clipping.
FEWEST_LEVELS = 16

# Faults that samples show

# Bits of counters and converters.
WRAP_BITS = (8, 10, 12, 14, 16, 18, 20, 24, 32)
# Standard deviations of linear prediction that half the range of a counter exceeds, so that at most
# one normal sample of 10⁶ may be off by a turn; and the largest root mean square of what remains
# after turns: samples that overflow are those of the largest errors.
WRAP_SIGMAS, WRAPS_SPREAD = 5.0, 4.0
# Robust standard deviations by which an overflow exceeds the largest second difference expected of
# so much normal noise, (2 ln n)^½: a twentieth of such channels is examined.
WRAP_BEND = 0.3
# Fewest jumps that refuse a channel as a counter of unknown step, and share of one size.
FEWEST_WRAPS, WRAPS_UNDONE = 2, 0.95
# Least share of the samples in each outermost hundredth of the range of a counter that overflows
# all the time: of normal noise there are 10⁻⁵.
WRAP_ENDS = 1e-3
# Turns of a counter between two samples that are undone; more are those of a prediction that
# follows its own corrections.
MOST_TURNS = 16
# Order of the linear prediction, and fewest samples to estimate it from. Of a sum of resonances and
# noise it leaves within a few per cent the least error of any order; its coefficients are known to
# 18 % of the error of prediction together from 1000 samples.
PREDICTION_ORDER, PREDICTION_SAMPLES = 32, 1000
# Most missing samples in a row that are filled: half of the order, so that each is nearer to known
# samples than the model reaches.
LONGEST_FILLED = 16
# Largest share of the power spectral density that errors of filled samples may have, at any
# frequency: damping ratios of logs that are just filled are low by 1 %, less than their standard
# deviation.
FILLED_ERROR = 0.3
# Standard deviations of the prediction error up to which samples beside a filled one are ordinary:
# 10⁹ samples of normal noise stay below 6.2; a blow or a step exceeds it, and is not filled in.
ORDINARY = 8.0
# Robust standard deviations of a second difference beyond which it is examined (of 10⁹ samples of
# normal noise one exceeds 6.2), and standard deviations of its expectation by which a bad sample
# differs; the latter where a blow would leave nothing after it: in white noise.
SUSPECT, SPIKE, SPIKE_ALONE = 6.5, 8.0, 12.0
# A sample is bad, not a blow, where what it leaves of the prediction errors is below this share of
# what a blow there leaves, and it exceeds so many levels: a quantised signal may be one off.
CLEARLY, SPIKE_LEVELS = 0.25, 4.0
# Energy of all bad samples as a share of that of the noise below which they change nothing, and
# largest share of bad samples: more are part of the signal, or cut it to pieces.
SPIKE_ENERGY, MOST_SPIKES = 0.01, 0.01
# Samples from which the distribution of a channel is judged, and its levels are; fewest.
SHAPE_SAMPLES, LEVEL_SAMPLES, FEWEST_FOR_SHAPE = 1 << 16, 1 << 13, 2000
# Standard deviations from the median to the end of the range above which there is no edge: that of
# |x| is 1.1 away, that of a vector's magnitude at most 2.3; the ends of normal noise are 4.
EDGE_REACH = 3.0
# Ratio of the distances of the 1 % and 0.1 % quantiles from the least sample beyond which the
# distribution has a sharp edge: 10 at an edge, below 3 in tails. Most samples are there if the 5 %
# quantile is nearer than this share of the median: 0.093 for |x| of normal x, 0.1 if uniform.
EDGE, AT_EDGE = 6.0, 0.13
# Least ratio, or inverse, of the distances of the 95 % and 5 % quantiles from the median where the
# edge is not at zero: 2.1 for |x| - c of normal x, 0.5 for that of a sine, 1 for signed ones.
LOPSIDED = 1.25
# Least sample of a magnitude over its median, and its skewness: that of a vector has 0.49 in three
# and 0.63 in two dimensions, that of |x| 0.995; normal noise has none.
NEAR_ZERO, MAGNITUDE_SKEW = 0.05, 0.3
# Share of the variance of its square that a magnitude of other channels has beyond theirs: rounding
# to a thirtieth of its standard deviation leaves 10⁻⁴.
MAGNITUDE = 1e-3
# Standard deviation in steps below which quantisation is no white noise: at 0.5 the variance is off
# by 1 % (2 exp(-2π² 0.5²)), at 0.3 by a third.
LEAST_STEPS = 0.5
# Gaps between levels in standard deviations from which levels are missing (an error of g²/12, 2 %
# of the variance), and the largest relative difference of the bands between them from a gap: those
# of a stuck bit are equal; clusters of a tone and parts of a drift are not.
WIDE_GAP, STUCK_BAND = 0.5, 0.3

# Time

# Largest relative difference between sample rates of one log (time stamps, metadata, channels).
AGREEMENT = 1e-4
# Largest part of a sample by which the starts of channels may differ from whole samples: a phase of
# 3.6° at a tenth of the sample rate, and the rounding of time stamps (1 µs) at 100 kHz.
START_TOLERANCE = 0.1
# Least share of a late channel that the others must have in common with it: below it the channel
# costs more variance, as the record shortens, than it adds.
LEAST_COMMON = 0.5
# Interval, in median intervals, from which samples are missing.
GAP = 1.5
# Largest relative deviation of an interval. Time stamps are rounded (to 1e-6 s in many exports, to
# 2e-6 s by float32 after 20 s); no sampling clock deviates so far.
JITTER = 0.25
# Largest amplitude of periodic jitter, in intervals: sidebands of a mode at a tenth of the sample
# rate are (π 0.1 0.02)² = 4e-5 of its power, below the floor of all but the clearest modes.
PERIODIC = 0.02
# Largest ratio of the sample rates in one record, which is resampled to the lowest.
LARGEST_SPREAD = 2.0
# Interruptions per sample above which a record is refused instead of cut, and so many in any.
INTERRUPTED_SHARE, ALWAYS_ALLOWED = 0.01, 10
# Fewest consecutive samples that are kept, and fewest samples of a log.
SHORTEST_PIECE = 2
# A set velocity is differentiated over so many samples that one step of the position (1 um in
# print, 30 nm of a float32 at 300 mm) is worth this share of the largest velocity, and over so many
# seconds to either side at most: the set point of a stroke changes in it.
STEP_SHARE, LONGEST_REACH = 2e-4, 0.02

# Files of folders

# Beginning of a file that decides whether it holds samples (headers are shorter), and rows of
# numbers at its end which make the file a log: where it ends there, and where it goes on, because
# rows of many channels are long. Tables of settings, sensors and results beside logs have fewer.
SAMPLED_BYTES, SAMPLED_ROWS, SAMPLED_ROWS_CUT = 1 << 16, 100, 20
# Ends of names of copies that editors and transfers make: they are no further logs.
BACKUPS = ("~", ".bak", ".old", ".orig", ".tmp", ".part", ".filepart", ".crdownload")

# Consistency

# Relative differences between the sample rate and that by set position and set velocity, beyond
# five standard errors: a frequency has the first as its standard deviation in a record of 60 s
# (README.md, "Time"); the second is the rounding of a velocity to three digits.
RATE_FLAGGED, RATE_REFUSED = 5e-4, 5e-3
# Mean error of the displacements by the set position, as a share of them, from which they do not
# follow the set velocity: that of another axis or of a path. A wrong rate has none.
UNLIKE = 0.1
# Share of the usual speed from which a block of samples is in motion.
MOVING = 0.2
# Steps of the stored position per sample from which an increment is compared with its neighbours:
# by rounding alone it may exceed them by one step, by noise of the same size by four times that.
FINE_STEPS = 4.0
# Ratio of an increment to the mean of its four neighbours, beyond 0.9 steps, from which samples
# were dropped: one dropped sample doubles it, counts of two and three in turn reach 1.5.
JUMP = 1.55
# Fewest samples that repeat earlier ones in all channels: with an effective range of 4 levels that
# happens once in 4^16 = 4e9. It is by chance where that has a probability above exp(-40), by the
# share of its samples that equal their neighbours.
SHORTEST_REPEAT, CHANCE = 16, 40.0
# Of samples that all channels hold: longest stretch of a slower clock, and jump at their ends in
# standard deviations of the channel from which they are no standstill.
SLOW_CLOCK, HELD_JUMP = 100, 0.5

# Metadata

# Most characters of a machine, servo, description or column name.
LONGEST_NAME = 200
# Least and largest value of metadata, also as columns of tables. No machine leaves them: an
# odometer of ten strokes a second counts 10¹⁰ in 30 years, 10⁷ mm/s leaves the atmosphere, no axis
# is 100 km long, an oscilloscope samples at 10¹¹ Hz. Placeholders (-9999 °C, 1e300) do.
RANGES = {
    "travel_km": (0.0, 1e10),
    "sample_rate_hz": (1e-6, 1e11),
    "velocity_mm_s": (-1e7, 1e7),
    "temperature_c": (-273.15, 1000.0),
    "payload_kg": (-1e6, 1e6),
    "position_mm": (-1e8, 1e8),
    "frequency_hz": (0.0, 1e11),
}
# Magnitudes of the SI value of one count: an attometre, and `LARGEST_MAGNITUDE`.
SCALES = 1e-18, 1e12
# Magnitude of any other number of a table: its square and cube are finite.
LARGEST_NUMBER = 1e100

# Dates

# Moments from which, and before which, a log may be recorded. Clocks begin to count in 1970, and
# nothing computed from a date before 2100 leaves the calendar, or a clock of 64 bits in ns.
FIRST_MOMENT = datetime(1970, 1, 1, tzinfo=UTC)
LAST_MOMENT = datetime(2100, 1, 1, tzinfo=UTC)
# How far a moment may be in the future (controllers have wrong time zones) of the clock, or of the
# day when this limit was made: an earlier clock is wrong, and must not refuse every log.
FUTURE, MADE = timedelta(days=1), datetime(2026, 11, 27, tzinfo=UTC)

# What damaged or hostile files may claim

# Bytes of a line of text: a file without line ends is one line.
LONGEST_LINE = 1 << 20
# Bytes of text without the end of a row, and lines of a cell of a table next to logs: an open quote
# makes one field of all rows after it.
LONGEST_BLOCK, LONGEST_CELL = 64 << 20, 50
# Bytes of a text attribute of HDF5, which stores no larger one in an object header.
LONGEST_ATTRIBUTE = 1 << 16
# Columns of signals of a file, and those of a MAT matrix that are signals.
MOST_COLUMNS = 1000
# Columns of a table next to logs, which has a dozen, and rows: an archive of several tables.
MOST_CELLS, MOST_ROWS = 200, 1_000_000
# Arrays of a MAT variable; scales and coefficients of a TDMS channel, over which npTDMS iterates.
MOST_ARRAYS, MOST_SCALES = 20_000, 10_000
