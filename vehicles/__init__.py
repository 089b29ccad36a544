"""Ready vehicles, installed with the package.

`transport scenario new --vehicle NAME` finds them by file name.
"""
