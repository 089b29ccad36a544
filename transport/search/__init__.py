"""Search for the network, the deaths and the weather that bring a team down, and the proof."""
