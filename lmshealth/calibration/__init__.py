"""Calibration of a stage description: coverage, detection and dates on lives drawn from it."""
