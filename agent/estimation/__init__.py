"""Estimation: the state of the whole team as one agent infers it from messages and measurements."""
