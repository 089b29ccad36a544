"""The team and its motion: parameters, state, equations of motion, hover, obstacles."""
