"""Logs: writing and reading run.mcap, salvage of cut files, tables, gaps."""
