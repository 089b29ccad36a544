"""Checks of this machine for `transport doctor`."""
