"""Files: read within bounds, written whole, and those that a scenario names."""
