"""Silence: the age of information about the others, and what an agent does as it grows."""
