"""Metrics, tables and replay of a recorded run."""
