"""Measurements too long for tests; each writes tables of a page.

`make bench` measures computation, codec and whole runs (docs/record/performance.md), `estimates` the
estimate against the truth (docs/record/measured.md), `silence` teams without information, `walls` those that
meet a wall in flight and `clock_and_actuation_offsets` commands and clocks at different times
(docs/record/guarantees.md), `worst` the search for failures (docs/worst.md), `radio` the channel against ns-3
(docs/record/radio.md), and `peers` other libraries.
"""
