"""What agents tell each other: announced inputs, clocks, the radio, targets, plans that need no sending."""
