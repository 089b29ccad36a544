"""The physics as pure functions: equations of motion, linearisation, discretisation, maneuver."""
