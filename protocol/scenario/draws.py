"""Random numbers drawn from counters (Philox), so that a draw does not depend on what was drawn before it."""

import hashlib

import numpy as np
import numpy.typing as npt
from numpy.random import Generator, Philox

Key = npt.NDArray[np.uint64]


def draw_key(*purpose: object) -> Key:
    """Return the key of an independent stream of random numbers for the seed of a run and a purpose, (2,) uint64."""
    digest = hashlib.sha256("/".join(map(str, purpose)).encode()).digest()
    return np.frombuffer(digest[:16], dtype="<u8")


def generator(key: Key, tick: int, stream: int = 0) -> Generator:
    """Return the generator that belongs to a key, a tick and one of the streams of that tick."""
    return Generator(Philox(key=key, counter=np.array([0, 0, stream, tick], dtype=np.uint64)))
