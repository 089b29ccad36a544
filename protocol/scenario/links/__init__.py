"""Links: delay, jitter, loss and other impairments of each, and their changes during a run."""
