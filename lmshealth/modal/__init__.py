"""Identification of natural frequencies, damping ratios and mode shapes with covariance."""
