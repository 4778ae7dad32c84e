"""Limits that decide which logs, channels and samples are refused.

They are read as ``constants.NAME``. Lengths of text and counts that only bound what damaged or
hostile files may claim were chosen far above every plausible export.
"""

from datetime import UTC, datetime, timedelta

MAX_MEMORY = 2e9
"""Most memory in bytes that decoding one variable (MAT), data set (UFF58) or segment (TDMS) may
take: ten minutes of 20 kHz take 0.1 GB per channel. The option ``--max-memory``."""

READING_SECONDS = 30.0
"""Most seconds (s) that reading a file may take in a process of its own, beyond one for each
`SLOWEST_READING` bytes: it is a library that loops. The variable ``LMSHEALTH_MAX_SECONDS``."""
SLOWEST_READING = 5e6
"""Bytes per second of the slowest disk and library that are waited for."""

LARGEST_RATIO = 200
"""Most bytes of decoded samples per byte of the file. Noise compresses by single digits; constant
channels are refused anyway."""
SMALL_ENOUGH = 256 << 20
"""Decoded bytes that are accepted whatever the ratio; also the largest table next to logs."""

# Channels

LARGEST_MISSING = 0.10
"""Largest share of missing samples of a channel: the others would be cut at each of its gaps."""
LARGEST_MAGNITUDE = 1e12
"""Magnitude in SI units from which a sample counts as missing: no acceleration, position or current
reaches it, and its square is still finite."""
SMALLEST_RANGE = 1e-30
"""Range in SI units below which a channel is constant: powers of its spectrum would be no normal
floating-point numbers."""
DEPENDENT, COMPARED = 1e-9, 4096
"""Share of its variance that a channel must have beyond the others, else it is one of them again
(rounding of float32 leaves 1e-14); samples of each block of 2¹⁸ that are compared."""
CLIPPED_SHARE = 1e-3
"""Share of samples at both ends of the range from which a channel is clipped."""
CLIPPING_RATIO = 2.0
"""Clipping needs this ratio of samples at an end to those in the `LEVELS_BELOW` levels next to it.
A sine in steps of an encoder reaches 1 / 1.24."""
LEVELS_BELOW = 4
"""Levels of quantisation that `CLIPPING_RATIO` compares with."""
FEWEST_LEVELS = 16
"""Range in levels below which a signal is too coarse to judge clipping."""
FEWEST_STUCK = 5
"""Fewest samples at an end that may be clipping."""
ADJACENT_SHARE = 0.1
"""Least share of samples at an end whose successor is there too."""

# Faults that samples show

WRAP_BITS = (8, 10, 12, 14, 16, 18, 20, 24, 32)
"""Bits of counters and converters."""
WRAP_SIGMAS, WRAPS_SPREAD = 5.0, 4.0
"""Standard deviations of linear prediction that half the range of a counter exceeds, so that at
most one normal sample of 10⁶ may be off by a turn; and the largest root mean square of what remains
after turns: samples that overflow are those of the largest errors."""
WRAP_BEND = 0.3
"""Robust standard deviations by which an overflow exceeds the largest second difference that is
expected of so much normal noise, (2 ln n)^½: a twentieth of such channels is examined."""
FEWEST_WRAPS, WRAPS_UNDONE = 2, 0.95
"""Fewest jumps that refuse a channel as a counter of unknown step, and share of them that must be
of one size."""
WRAP_ENDS = 1e-3
"""Least share of the samples in each outermost hundredth of the range of a counter that overflows
all the time: of normal noise there are 10⁻⁵."""
PREDICTION_ORDER, PREDICTION_SAMPLES = 32, 1000
"""Order of the linear prediction, and fewest samples to estimate it from. Of a sum of resonances
and noise it leaves within a few per cent the least error of any order; its 32 coefficients are
known to 18 % of the error of prediction together from 1000 samples."""
LONGEST_FILLED = 16
"""Most missing samples in a row that are replaced by their expectation: half of the order, so that
each is nearer to known samples than the model reaches."""
FILLED_ERROR = 0.3
"""Largest share of the power spectral density that errors of filled samples may have, at any
frequency. It is reached at the lowest level between resonances, where least of a mode is seen: with
8 % of the samples missing in gaps of 12 (share 0.25) damping ratios are 1 to 2 % low, half of their
standard deviation over 40 s (`studies/inputs/outside_faults`)."""
ORDINARY = 8.0
"""Standard deviations of the prediction error up to which samples beside a filled one are ordinary.
10⁹ samples of normal noise stay below 6.2; a blow or a step exceeds it, and is not filled in."""
SUSPECT = 6.5
"""Robust standard deviations of a second difference beyond which it is examined. Of 10⁹ samples of
normal noise one exceeds 6.2; most channels are not examined."""
SPIKE = 8.0
"""Standard deviations of its expectation by which a bad sample differs at least from it."""
SPIKE_ALONE = 12.0
"""The same where a blow would leave nothing after it: in white noise."""
CLEARLY = 0.25
"""A sample is bad, not a blow, where what it leaves of the prediction errors is below this share of
what a blow there leaves."""
SPIKE_LEVELS = 4.0
"""Smallest differences of two levels that a bad sample exceeds: single samples of a quantised
signal may be a level off."""
SPIKE_ENERGY = 0.01
"""Energy of all bad samples of a channel, as a share of that of its noise, below which they change
nothing: a mode's noise floor rises by less than 1 %."""
MOST_SPIKES = 0.01
"""Largest share of bad samples: more are part of the signal, or cut it to pieces."""
SHAPE_SAMPLES, LEVEL_SAMPLES, FEWEST_FOR_SHAPE = 1 << 16, 1 << 13, 2000
"""Samples from which the distribution of a channel is judged, those from which its levels are, and
fewest."""
EDGE_REACH = 3.0
"""Standard deviations from the median to the end of the range above which there is no edge: that of
|x| is 1.1 away, that of a vector's magnitude at most 2.3; the ends of normal noise are 4."""
EDGE, AT_EDGE = 6.0, 0.13
"""Ratio of the distances of the 1 % and 0.1 % quantiles from the least sample beyond which the
distribution has a sharp edge: 10 at an edge, below 3 in tails of normal or exponential noise. Most
samples are there if the 5 % quantile is nearer than this share of the median: 0.093 for |x| of
normal x, 0.1 where the density is constant."""
LOPSIDED = 1.25
"""Least ratio, or inverse, of the distances of the 95 % and 5 % quantiles from the median where the
edge is not at zero: 2.1 for |x| - c of normal x, 0.5 for that of a sine, 1 for signed ones."""
NEAR_ZERO, MAGNITUDE_SKEW = 0.05, 0.3
"""Least sample of a magnitude over its median, and its skewness: that of a vector has 0.49 in three
and 0.63 in two dimensions, that of |x| 0.995; normal noise has none."""
LEAST_STEPS = 0.5
"""Standard deviation in steps below which quantisation is no white noise: at 0.5 the variance is
off by 1 % (2 exp(-2π² 0.5²)), at 0.3 by a third."""
MAGNITUDE = 1e-3
"""Share of the variance of its square that a magnitude of other channels has beyond theirs:
rounding to a thirtieth of its standard deviation leaves 10⁻⁴. Also below a tenth of what a linear
combination leaves of it."""
WIDE_GAP, STUCK_BAND = 0.5, 0.3
"""Gaps between levels in standard deviations from which levels are missing (an error of g²/12, 2 %
of the variance), and the largest relative difference of the bands between them from a gap: those
of a stuck bit are equal; clusters of a tone and parts of a drift are not."""
MOST_TURNS = 16
"""Turns of a counter from one sample to the next that are undone; more are no counter's, but those
of a prediction that follows its own corrections."""

# Time

AGREEMENT = 1e-4
"""Largest relative difference between sample rates of one log (time stamps, metadata, channels)."""
START_TOLERANCE = 0.1
"""Largest part of a sample by which the starts of channels may differ from whole samples: a phase
of 3.6° at a tenth of the sample rate, and the rounding of time stamps (1 µs) at 100 kHz."""
LEAST_COMMON = 0.5
"""Least share of a late channel that the others must have in common with it. The variance of an
estimate grows as the record shortens: below it the channel costs more than it adds."""
GAP = 1.5
"""Interval, in median intervals, from which samples are missing."""
JITTER = 0.25
"""Largest relative deviation of an interval. Time stamps are rounded (to 1e-6 s in many exports, to
2e-6 s by float32 after 20 s); no sampling clock deviates so far."""
PERIODIC = 0.02
"""Largest amplitude of periodic jitter, in intervals: sidebands of a mode at a tenth of the sample
rate are (π 0.1 0.02)² = 4e-5 of its power, below the floor of all but the clearest modes."""
LARGEST_SPREAD = 2.0
"""Largest ratio of the sample rates in one record, within `AGREEMENT` of each: it is resampled to
the lowest."""
INTERRUPTED_SHARE = 0.01
"""Interruptions per sample above which a record is refused instead of cut, beyond
`ALWAYS_ALLOWED`."""
ALWAYS_ALLOWED = 10
"""Interruptions that are accepted in a record of any length."""
SHORTEST_PIECE = 2
"""Fewest consecutive samples that are kept, and fewest samples of a log."""
STEP_SHARE = 2e-4
"""A set velocity is differentiated over so many samples that one step of the position (1 um in
print, 30 nm of a float32 at 300 mm) is worth this share of the largest velocity."""
LONGEST_REACH = 0.02
"""Longest distance in s to either side of that difference: the set point of a stroke changes in
it."""

# Files of folders

SAMPLED_BYTES = 1 << 16
"""Beginning of a file that decides whether it holds samples: headers of exports are shorter."""
SAMPLED_ROWS, SAMPLED_ROWS_CUT = 100, 20
"""Rows of numbers at the end of that beginning which make a file a log: where it ends there, and
where it goes on, because rows of many channels are long. A log of 1 s has more; tables of settings,
sensors and results beside logs have fewer."""
BACKUPS = ("~", ".bak", ".old", ".orig", ".tmp", ".part", ".filepart", ".crdownload")
"""Ends of names of copies that editors and transfers make: they are no further logs."""

# Consistency

RATE_FLAGGED, RATE_REFUSED = 5e-4, 5e-3
"""Relative differences between the sample rate and that by set position and set velocity, beyond
five standard errors: a frequency has the first as its standard deviation in a record of 60 s
(README.md, "Time"); the second is the rounding of a velocity to three digits."""
UNLIKE = 0.1
"""Mean error of the displacements by the set position, as a share of them, from which they do not
follow the set velocity: that of another axis or of a path. A wrong rate has none."""
MOVING = 0.2
"""Share of the usual speed from which a block of samples is in motion."""
FINE_STEPS = 4.0
"""Steps of the stored position per sample from which an increment is compared with its neighbours:
by rounding alone it may exceed them by one step, by noise of the same size by four times that."""
JUMP = 1.55
"""Ratio of an increment to the mean of its four neighbours, beyond 0.9 steps, from which samples
were dropped: one dropped sample doubles it, counts of two and three in turn reach 1.5."""
SHORTEST_REPEAT = 16
"""Fewest samples that repeat earlier ones in all channels: of a channel with an effective range of
4 levels that happens once in 4^16 = 4e9."""
CHANCE = 40.0
"""A repeated stretch is none by chance where that has a probability below exp(-40), by the share of
its samples that equal their neighbours."""

# Metadata

LONGEST_NAME = 200
"""Most characters of a machine, servo, description or column name."""
RANGES = {
    "travel_km": (0.0, 1e10),
    "sample_rate_hz": (1e-6, 1e11),
    "velocity_mm_s": (-1e7, 1e7),
    "temperature_c": (-273.15, 1000.0),
    "payload_kg": (-1e6, 1e6),
    "position_mm": (-1e8, 1e8),
    "frequency_hz": (0.0, 1e11),
}
"""Least and largest value of metadata, also as columns of tables, by their name. No machine leaves
them: an odometer of ten strokes a second counts 10¹⁰ in 30 years, 10⁷ mm/s leaves the atmosphere,
no axis is 100 km long, an oscilloscope samples at 10¹¹ Hz. Placeholders of missing values do
(-9999 °C, 1e300)."""
SCALES = 1e-18, 1e12
"""Magnitudes of the SI value of one count: an attometre, and `LARGEST_MAGNITUDE`."""
LARGEST_NUMBER = 1e100
"""Magnitude of any other number of a table: its square and cube are finite."""

# Dates

FIRST_MOMENT = datetime(1970, 1, 1, tzinfo=UTC)
LAST_MOMENT = datetime(2100, 1, 1, tzinfo=UTC)
"""Moments from which, and before which, a log may be recorded. Clocks begin to count in 1970, and
nothing computed from a date before 2100 leaves the calendar, or a clock of 64 bits in ns."""
FUTURE = timedelta(days=1)
"""How far a moment may be in the future: clocks of controllers are set to a wrong time zone."""
MADE = datetime(2026, 11, 27, tzinfo=UTC)
"""When this limit was made: the clock of a computer is wrong if it is earlier, and must not refuse
every log."""

# What damaged or hostile files may claim

LONGEST_LINE = 1 << 20
"""Bytes of a line of text: a file without line ends is one line."""
LONGEST_BLOCK = 64 << 20
"""Bytes of text without the end of a row: an open quote makes one field of all rows after it."""
LONGEST_CELL = 50
"""Lines of a cell of a table next to logs: an open quote again."""
LONGEST_ATTRIBUTE = 1 << 16
"""Bytes of a text attribute of HDF5, which stores no larger one in an object header."""
MOST_COLUMNS = 1000
"""Columns of signals of a file, and those of a MAT matrix that are signals."""
MOST_CELLS = 200
"""Columns of a table next to logs, which has a dozen. Each row takes time for all of them."""
MOST_ROWS = 1_000_000
"""Rows of such a table: as many logs are an archive of several tables."""
MOST_ARRAYS = 20_000
"""Arrays of a MAT variable."""
MOST_SCALES = 10_000
"""Scales and coefficients of a TDMS channel: npTDMS iterates over as many as are claimed."""
