"""Python interface: runs, their figures and viewer, sweeps, and scenarios (docs/python.md)."""
