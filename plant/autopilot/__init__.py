"""Autopilots in simulation: the plant plays physics and sensors to them, one process for each UAV."""
