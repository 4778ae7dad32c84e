"""Helpers of all folders: arrays, results, files, serialisation, TOML."""
