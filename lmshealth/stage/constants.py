"""Constants that decide what a description, a record or a posterior is accepted for."""

from __future__ import annotations

# Share of the prior variance that data must remove before a value of a parameter is published.
INFORMED = 0.5
# Half-width of the band that a mode is fitted in, in damping ratios times its frequency. Beyond it
# a resonance adds little information, and the noise need not be as simple as the model.
BAND = 8.0
# Least duration of a segment times the half-power bandwidth of a mode identified in it.
LEAST_RESOLUTION = 2.0
