"""Compiled code: the loops in C, the functions of the model by CasADi, and Python that calls them."""
