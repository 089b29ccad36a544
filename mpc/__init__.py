"""The controller: prediction, cost, constraints, the quadratic program and its solvers.

Pure functions of arrays.
"""
