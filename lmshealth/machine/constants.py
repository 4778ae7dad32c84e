"""Constants that decide what is published of a machine."""

LEVELS = (0.05, 0.5, 0.95)
"""Levels of a published interval: 90 % credible interval and median."""

RUL_LEVELS = (0.05, 0.10, 0.25, 0.50, 0.75, 0.90, 0.95)
"""Levels of the remaining useful life; columns of prognosis.csv (public contract)."""

COURSE_POINTS = 24
"""Epochs, at most, of the course of a parameter in a summary."""

INSPECTION_RISK = 0.2
"""Share of the accepted risk that may come from ends between two logs that no log announced: small,
as the service date uses the risk that is accepted."""

MIN_SAVING = 0.01
"""A service that saves a smaller share of the long-run costs gets no date: draws do not resolve
it."""

FAILURE_PROBABILITY = 0.5
"""Probability that a limit is reached now, from which a machine has the state ``FAILURE``: it is
more probable than not that the machine is outside what its description allows."""

SERVICE_LEAD_DAYS = 30
"""Days before the service date from which a machine has the state ``MAINTENANCE_REQUIRED``: time to
plan a service."""

SILENT_INTERVALS = 5
"""A machine is silent when its last log is older than the time in which its last so many intervals
between days with a log passed: five intervals of logs on working days contain a weekend, so that a
long weekend is no silence. ``--silent-days`` replaces it."""

DRIFT_SIGMA = 6.0
"""Drift in standard deviations that is reported where no verdict is possible yet: three times what
is expected where the reported errors are too small by a factor of two, as of a first log that
shares a cause with no other."""
POSTPONED_WEEKS, POSTPONED_SHOWN = (0, 1, 2, 4, 8, 13, 26, 52, 104), 5
"""Weeks by which a service may be late, of which a page has the risk, and how many of those that
are not past yet it shows."""

JSON_SCHEMA = 2
"""Version of the JSON documents that state one: status files, answers of `run`, `watch`, `stage`,
and what alerts get. It changes when a key or a value changes its meaning or is removed."""

YOUNG_LOGS = 10
"""Up to so many logs a service date rests on the prior of the laws rather than on observed wear:
the next step of a healthy machine is then further logs, not an order."""
