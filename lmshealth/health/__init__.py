"""Posterior of the health parameters at single epochs, and the verdict."""
