"""Logs: writing and reading run.mcap, also cut or live, tables, gaps."""
