"""Checks of received messages, from bytes to messages that a node may use."""
