"""Numbers of a recorded run: time series, metrics, settling, replay of the agents."""
