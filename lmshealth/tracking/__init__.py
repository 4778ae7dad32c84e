"""Kalman filtering of modal estimates over the life of a machine."""
