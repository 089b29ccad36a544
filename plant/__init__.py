"""The plant: the truth, integrated between sampling instants, and the actuators that play the plans."""
