"""The commands `transport experiment`: one module for each experiment."""
