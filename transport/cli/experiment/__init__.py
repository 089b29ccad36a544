"""The commands `transport experiment`: one module for each family of sweeps."""
