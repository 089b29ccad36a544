"""Recording and reading the log of a run."""
