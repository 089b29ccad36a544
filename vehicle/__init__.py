"""The process of one UAV: between its agent and an autopilot that others have written."""
