"""Modal identification from ambient or operational vibration (Bayesian FFT, Whittle likelihood)."""
