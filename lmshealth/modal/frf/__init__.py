"""Modal identification from frequency response functions."""
