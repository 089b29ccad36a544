"""The same team and maneuver with the frameworks of others."""
