"""Scenarios: the schema of the file, reading and checking it, the links and faults it describes."""
