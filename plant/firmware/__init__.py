"""Flight firmware as inner loop.

Betaflight's simulator target, one process for each UAV, in virtual time.
"""
