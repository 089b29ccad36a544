"""Campaigns: long random attacks on the software, each with a table of what was tried."""
