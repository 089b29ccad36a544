"""Python interface: simulate, load, plot, view and save runs, sweep over settings, edit scenarios (docs/python.md)."""
