"""Runs: starting the processes, recording them, injecting faults, acting on a run in progress."""
