"""The radio of the team in a run: parameters, and the arrivals of a tick."""
