"""The law of a UAV alone: its sensors, the motion it follows, its attitude loop, and the fail-safe."""
