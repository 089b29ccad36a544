"""Probability that a payload is decoded, from its signal over noise and interference."""

import math

# The curves of success over signal to noise have one shape at all rates, within 0.2 dB: the exponent of the losses
# falls by a factor of ten within this many dB (benchmarks/radio, "decoding").
_DECADE_DB = 0.85
_STEEPNESS = 10.0 / _DECADE_DB
_REFERENCE_BYTES = 1536  # of the standards' `required_sinr_db`
_CERTAIN = 1e-6  # a smaller probability of loss counts as none
CERTAIN_MARGIN = _CERTAIN ** (-1.0 / _STEEPNESS)  # ratio to the required one from which frames up to 1536 bytes arrive


def success(frame_bytes: int, margin: float) -> float:
    """Return the probability that a frame is decoded: exp(-(bytes / 1536) margin^-s).

    Args:
        frame_bytes: Length with all headers.
        margin: Signal over noise and interference, over the required one of the rate.
    """
    return math.exp(-frame_bytes / _REFERENCE_BYTES * margin**-_STEEPNESS)
