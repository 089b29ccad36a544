"""Monitoring of a run in progress: live table of the agents, Prometheus metrics."""
