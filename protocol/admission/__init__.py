"""From received bytes to messages that a node may use: the gate, the roster, and the links' arrivals."""
