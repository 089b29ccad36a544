"""The optimisation of one step: decision, prediction, cost, constraints, the QP and its solvers."""
