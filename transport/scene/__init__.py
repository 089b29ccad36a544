"""Scenes of a run: positions, links and predictions at one tick, and their shapes in 3D."""
