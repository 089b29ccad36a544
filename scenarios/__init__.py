"""Ready scenarios, installed with the package; `transport run NAME` finds them by file name."""
