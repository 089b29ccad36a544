"""Checks of a whole scenario: relations between fields, limits, obstacles and feasibility along the reference."""
