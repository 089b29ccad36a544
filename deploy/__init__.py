"""Deployment to several hosts: inventory, keys, and a folder with services for each host."""
