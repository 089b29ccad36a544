"""Experiments: many flights with one thing changed from each to the next, and what that does."""
