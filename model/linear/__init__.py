"""Linearisation, its discretisation by zero-order hold, and the lag of motors in both."""
