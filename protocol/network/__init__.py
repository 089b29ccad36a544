"""Processes on the network: sessions, keys and certificates, joining, signals, health."""
