"""Admission of incoming messages: order, plausibility, membership, rate limit."""
