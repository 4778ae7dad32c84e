"""Simulated ground truth of two linear-motor stages, LMS-X and LMS-Y.

A stage is three rigid bodies (granite on isolators, housing on its mount, platform with load on
four recirculating-ball blocks) inside the position loop of the paper.  The package computes its
closed-loop modes for any guide preload and mount stiffness, and whole lives of simulated logs with
tables of the truth.  It shares no code with ``lmshealth``: the two exchange files only.

Units are SI throughout (m, kg, s, N, rad, A); only file columns and command-line options carry
other units, named in the column or option.  Axes: x feed, y lateral, z vertical (up); roll, pitch
and yaw are the rotations about x, y and z.  The origin is the centre of the four guide blocks.
"""
