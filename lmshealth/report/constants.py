"""Constants that decide what pages, tables and terminals publish."""

# --- Quantile levels ---
# Levels of the bands in figures: 50 and 90 % around the median.
BAND_LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
# Probabilities are quoted between these; posterior draws cannot prove 0 or 1.
LEAST_PROBABILITY, LARGEST_PROBABILITY = 0.01, 0.99

# --- Wording ---
# A factor on standard deviations is reported when it differs from one by more than this.
SCALE_SHOWN = 0.05
# A law of degradation is named on a terminal from this probability on.
LAW_SHOWN = 0.01
# The page warns that the random walk explains as much as the laws when its standard deviation
# exceeds this share of the largest drift.
WALK_SHARE = 0.5
# A posterior correlation is put in words on the page when its magnitude exceeds this.
CORRELATION_SHOWN = 0.5

# --- Amount shown; the tables always hold everything ---
# Length of all bars on the fleet page, as a fraction of the baseline value.
FLEET_BAR = 1.5
# From more machines than this on, the fleet page has search, filters, sorting and a calendar.
MANY_MACHINES = 10
# Refused logs shown per reason; up to this many refusals are shown unfolded.
REFUSED_SHOWN, REFUSED_UNFOLDED = 50, 12
# Bins of the histogram of remaining travel in km, between passed and beyond the horizon.
LIFE_EDGES = (100.0, 200.0, 500.0, 1000.0, 2000.0, 5000.0, 10000.0)
# Months of the calendar of services.
CALENDAR_MONTHS = 12
# Points per figure, of logs spaced evenly up to the last: more would cover each other.
POINTS = 300
# A terminal describes so many machines one by one, and lists so many in a table.
TERMINAL_MACHINES, TERMINAL_ROWS = 3, 20
# On a terminal: lines of a frequency response; harmonics per channel where several channels are
# listed; velocities in one table.
TERMINAL_LINES, TERMINAL_HARMONICS, TERMINAL_VELOCITIES = 12, 12, 7
