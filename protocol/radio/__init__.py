"""Event model of one shared half-duplex 802.11 channel.

Frames and positions in, arrivals and losses out. The package is pure: no clock, no input or output.
docs/record/radio.md describes the model, its assumptions and its validation.
"""
