"""Loops about hover with the actual plant, their margins, and the gains that are designed by them."""
