"""The commands `transport log`: describe and export the log of a run."""
