"""Data association of modal estimates (multiple hypotheses)."""
