"""Execution of a run: its processes, the recorder, scripted faults, or all nodes in memory."""
