"""Checks of the machine for `transport doctor`."""
