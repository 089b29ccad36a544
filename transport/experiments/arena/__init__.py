"""The arena: tasks, networks, entries, and the tables of their runs."""
