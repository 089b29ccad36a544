"""The commands `transport deploy`: keys and folders for a run on several hosts."""
