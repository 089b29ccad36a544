"""Random numbers from counters: number n of a stream is the same whatever else was drawn."""

import hashlib
import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.random import Generator, Philox

_BLOCK = 64  # numbers made at once: one generator costs as much as some hundred numbers
_BLOCKS_KEPT = 4096  # saves only time

Draw = Callable[[int], float]


@lru_cache(maxsize=_BLOCKS_KEPT)
def _block(seed: int, station: int, purpose: str, block: int) -> tuple[float, ...]:
    """Return one block of a stream of uniform numbers in [0, 1)."""
    digest = hashlib.sha256(f"radio/{seed}/{station}/{purpose}".encode()).digest()
    key = np.frombuffer(digest[:16], dtype="<u8")
    counter = np.array([0, 0, 0, block], dtype=np.uint64)
    return tuple(Generator(Philox(key=key, counter=counter)).random(_BLOCK).tolist())


def uniform(seed: int, station: int, purpose: str, number: int) -> float:
    """Return a number of a station's stream for a purpose, uniform in [0, 1)."""
    block, place = divmod(number, _BLOCK)
    return _block(seed, station, purpose, block)[place]


@lru_cache(maxsize=_BLOCKS_KEPT)
def _normal_block(seed: int, station: int, purpose: str, block: int) -> tuple[float, ...]:
    """Return standard normal numbers from a block of uniform ones, two for each (Box-Muller)."""
    drawn = _block(seed, station, purpose, block)
    return tuple(
        [
            math.sqrt(-2.0 * math.log(1.0 - first)) * math.cos(2.0 * math.pi * second)
            for first, second in zip(drawn[::2], drawn[1::2], strict=True)
        ]
    )


def normal(seed: int, station: int, purpose: str, number: int) -> float:
    """Return a standard normal number of a station's stream for a purpose."""
    block, place = divmod(number, _BLOCK // 2)
    return _normal_block(seed, station, purpose, block)[place]


def exponential(seed: int, station: int, purpose: str, number: int) -> float:
    """Return an exponential number of mean 1 of a station's stream for a purpose."""
    return -math.log(1.0 - uniform(seed, station, purpose, number))
