"""Targets given during a run: their messages, and the timing of the way to them."""
