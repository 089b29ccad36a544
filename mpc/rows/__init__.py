"""Constraint rows of the QP, one file per constraint. A new one: a class like its neighbours, and a line in `table`."""
