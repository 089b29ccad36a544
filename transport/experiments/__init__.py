"""Experiments: sweeps over variants of a scenario, with tables, confidence intervals, figures."""
