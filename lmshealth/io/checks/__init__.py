"""Checks of the samples and statements of a log, and repairs of what can be repaired exactly."""
