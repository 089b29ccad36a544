"""Tests of keys, inventories, folders for hosts, and of what gets past them."""
