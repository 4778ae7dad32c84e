"""Remaining useful life: degradation scenarios, life posterior, first passage."""
