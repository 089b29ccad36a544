"""The steps of an agent: by predictive control, or each UAV alone; and their reports."""
