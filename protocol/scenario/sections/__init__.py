"""Sections and keys of a scenario: each field with type, range, unit and meaning; errors that name a field."""
