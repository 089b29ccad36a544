"""The path of the payload: phases, curves, targets and stops; references that a team can follow along it."""
