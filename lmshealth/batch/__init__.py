"""Batch analysis of archives of logs: ingest, assessment, store of results, worker processes."""
