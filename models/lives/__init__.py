"""Lives of simulated machines: degradation, schedules of logs, faults of recordings."""
