"""Probability that the payload of a frame is decoded, from signal, noise and interference."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

# One shape fits the curves of success over signal to noise of all rates within 0.2 dB: the exponent
# of the losses falls by a factor of ten within this many dB (docs/record/radio.md, "Decoding").
_DECADE_DB = 0.85
_STEEPNESS = 10.0 / _DECADE_DB
_REFERENCE_BYTES = 1536  # of `Standard.required_sinr_db`
_CERTAIN = 1e-6  # a smaller exponent counts as none
# Ratio to the required signal from which a payload is always decoded.
CERTAIN_MARGIN = _CERTAIN ** (-1.0 / _STEEPNESS)


class Interference(NamedTuple):
    """Power of another transmission at the receiver, mW, between two instants, ns."""

    start_ns: int
    end_ns: int
    power_mw: float


class Signal(NamedTuple):
    """A frame at a receiver."""

    start_ns: int
    end_ns: int
    frame_bytes: int
    power_mw: float
    required_mw: float  # noise times the required ratio
    required_ratio: float  # of signal over noise and interference, `Standard.required_sinr_db`


def success(signal: Signal, interference: Sequence[Interference]) -> float:
    """Return the probability that a payload is decoded.

    exp(-L / L_ref * sum_k f_k (q_k / q)^-s) with length L; in the part f_k of the frame the
    interference is constant, and q_k the ratio of signal over noise and interference; q is required.
    """
    edges = {signal.start_ns, signal.end_ns}
    for other in interference:
        edges.add(max(other.start_ns, signal.start_ns))
        edges.add(min(other.end_ns, signal.end_ns))
    ordered = sorted(edges)

    duration_ns = signal.end_ns - signal.start_ns
    exponent = 0.0
    for begin, end in pairwise(ordered):
        others_mw = sum(
            [
                other.power_mw
                for other in interference
                if other.start_ns <= begin and end <= other.end_ns
            ]
        )
        margin = signal.power_mw / (signal.required_mw + signal.required_ratio * others_mw)
        exponent += (end - begin) / duration_ns * _losses(margin)
    return math.exp(-signal.frame_bytes / _REFERENCE_BYTES * exponent)


def _losses(margin: float) -> float:
    """Return the exponent of the losses of a frame of the reference length."""
    if margin >= CERTAIN_MARGIN:
        return 0.0
    return float(margin**-_STEEPNESS)
