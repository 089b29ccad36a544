"""Figures of one run, and their style."""
