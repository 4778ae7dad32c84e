"""Posterior of the life of a machine: scenarios, data, likelihood, sampling, and their mixture."""
