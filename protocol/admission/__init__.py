"""From received bytes to messages that a node may use.

The gate, the roster, and the links' arrivals.
"""
