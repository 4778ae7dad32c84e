"""Equations of motion of the simulated stages and of their position loop."""
