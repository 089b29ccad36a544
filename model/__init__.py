"""The physics: parameters, rotations, equations of motion, linearisation, discretisation, maneuver. Pure functions."""
