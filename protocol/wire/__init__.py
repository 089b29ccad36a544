"""Messages on the network: their fields, their bytes, the keys they travel under."""
