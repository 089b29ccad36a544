"""Benchmarks of computation, codec and whole runs.

`make bench` writes the tables of docs/performance.md.
"""
