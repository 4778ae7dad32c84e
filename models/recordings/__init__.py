"""Simulated logs: motion, disturbances, sensors, file formats."""
