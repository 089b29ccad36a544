"""Scripted faults of processes and UAVs, and the relations between them."""
