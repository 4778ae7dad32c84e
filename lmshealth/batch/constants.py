"""Limits, time-outs and retries of batch analysis."""

NO_LOSS = "duplicate", "not-listed"
"""Reasons of refusals by which no log is lost: copies, and logs that a manifest omits."""

TASKS_AHEAD = 3
"""Tasks per worker that are submitted before their results are fetched. Two keep a worker busy
while its result travels; the third covers tasks of unequal length. Each is held in memory."""

ATTEMPTS_ALONE = 2
"""How often a task that was running when its process died is run alone before it is refused. One
attempt would refuse a sound log whose process is killed twice from outside."""

START_ATTEMPTS = 3
"""How often worker processes are started when one of them is killed as it starts."""

FEEDER_END_S = 5
"""Seconds (s) that the thread that feeds a pool's queue has to end with the pool: it has nothing
to send any more, but one that waits for a pipe must not hold up the end of the program."""

SCHEDULER_TIMEOUT_S = 20
"""Seconds (s) within which a Dask scheduler has to answer, and to have a first worker."""

LOGS_PER_TASK = 16
"""Most logs that one task identifies: the main process works once a task. As many are identified
again per worker after an interruption."""

FILES_PER_HASH_TASK = 16
"""Files that one task hashes: a short file is hashed faster than a task is sent."""

ROWS_PER_QUERY = 400
"""Rows fetched by one query: far below the 999 variables that old builds of SQLite accept."""

SQLITE_BUSY_TIMEOUT_S = 300
"""Seconds (s) that a writer waits while other processes write to the same SQLite file: longer than
a run that delivers its changes by two commands, each of which hangs."""

SERVER_TIMEOUT_S = 20
"""Seconds (s) that a database server has to answer, unless its URL has ``connect_timeout``."""

ANSWER_TIMEOUT_S = 60
"""Seconds (s) that a PostgreSQL server has for an answer: a frozen one would be waited for without
end. The largest answers, some 10 MB, take as long at 1.5 Mbit/s."""

SCHEMA = 10
"""Version of the table of values, part of its name: tables of other versions are not read."""

SETTLED_S = 10
"""Seconds (s) after its last change from which the digest of a file may be kept: clocks of file
systems have steps of up to 2 s, in which a file may change again unnoticed."""

OTHERS_POLL_S = 1.0
"""Seconds (s) between two looks at work that other runs on the store have begun."""

KEEPALIVE = {"idle": 30, "interval": 10, "count": 3}
"""When PostgreSQL probes the connection of a run that is silent (s), again (s), and how often in
vain: after a minute work of a computer that was cut off is left to other runs."""

RETRIED_REASONS = ("missing-file", "changed", "too-large", "too-slow", "future")
"""Reasons of refusal that depend on more than the log: on the moment, ``--max-memory``,
``--seconds-per-log``, ``--allow-future`` or the speed of the computer. They are not stored, and the
next run tries the log again. The same holds for logs that fail for lack of resources, by an error
of this program, or by a crash of their process."""

LOG_SECONDS = 600.0
"""Processor time in s after which a log is refused (``too-slow``): an hour of eight channels takes
less than a minute. The option ``--seconds-per-log``."""

ASSESSMENT_ATTEMPTS = 2
"""How often a machine is assessed in one run when its assessment is missing from the store, for
instance because a run at the same time removed it."""

SHORTEST_SECRET = 4
"""Least length of a value of a URL's options that is masked in messages. Shorter values are
numbers and switches, which occur everywhere in a message."""

ALERT_TIMEOUT_S = 60
"""Seconds (s) that an alert command may take before it is killed with its children."""

ALERT_OUTPUT_BYTES = 1000
"""End of the output of an alert command that is kept (bytes): its last line is printed."""

ALERT_OUTPUT_S = 1.0
"""Seconds (s) that the end of its output may come after its own: a child that it leaves behind may
hold its output open without end."""

NOTIFY = "LMSHEALTH_NOTIFY"
"""Variable of the environment with the addresses of messengers, separated by blanks: they hold
passwords, which all users of a computer can read on a command line."""
