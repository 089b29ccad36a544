"""The scene of a run at any tick, independent of the library that draws it."""
