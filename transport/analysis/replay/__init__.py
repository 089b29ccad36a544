"""Replay of one agent from a log, and how its plans differ from the recorded ones."""
