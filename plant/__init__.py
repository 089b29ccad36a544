"""Plant: integrates the ground truth between sampling instants; its actuators follow the plans."""
