"""Classes of the user that a scenario names: their import, and their errors."""
