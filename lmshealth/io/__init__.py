"""Logs: from files of any format to `Log` in SI units, or a refusal with its reason.

The libraries that read the formats are imported when the first file needs them.
"""
