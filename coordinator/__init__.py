"""The coordinator: sampling clock, barrier, membership."""
