"""Modal identification from free decays after stops."""
