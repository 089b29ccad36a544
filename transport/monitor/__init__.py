"""Monitoring of an active run."""
