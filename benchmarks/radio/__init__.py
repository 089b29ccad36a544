"""Comparison of protocol/radio with ns-3: the same cases in both."""
