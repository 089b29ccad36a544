"""Communication of the processes: messages, codec, key expressions, the scenario, and the bus that carries them."""
