"""Kalman filters of a track, and the changes that they detect."""
