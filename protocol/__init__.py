"""What processes say to each other: messages, codec, key expressions, the scenario, and the bus that carries them."""
