"""Communication of the processes.

Messages, codec, key expressions, the scenario, and the bus that carries them.
"""
