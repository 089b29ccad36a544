"""Random numbers from a counter keyed by seed, purpose and tick: no order of arrivals matters."""

import hashlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.random import Generator, Philox

from transport.model.arrays import Array

Key = npt.NDArray[np.uint64]


def draw_key(*purpose: object) -> Key:
    """Return the key of an independent stream of random numbers, for a seed and a purpose, (2,)."""
    digest = hashlib.sha256("/".join(map(str, purpose)).encode()).digest()
    return np.frombuffer(digest[:16], dtype="<u8")


class Streams:
    """Random numbers of a key: independent streams at every tick.

    One generator is set to each stream; to make one for each takes three times as long.
    """

    def __init__(self, key: Key) -> None:
        self._bits = Philox(key=key)
        self._generator = Generator(self._bits)
        self._state = self._bits.state  # before any number is drawn
        self._counter = self._state["state"]["counter"]  # (4,), 0 there

    def at(self, tick: int, stream: int = 0) -> Generator:
        """Return the generator at the begin of a stream of a tick, valid until the next call."""
        self._counter[2:] = stream, tick
        self._bits.state = self._state
        return self._generator


@dataclass(frozen=True, slots=True)
class Draw:
    """Uniform random numbers of one message, from 0 to 1.

    The order is that in which they are drawn; a further one goes to the end.
    """

    COUNT = 8

    numbers: Array  # (COUNT,)

    @property
    def loss(self) -> float:
        """Number that decides over an independent loss."""
        return float(self.numbers[0])

    @property
    def burst(self) -> float:
        """Number that decides over a loss in a burst."""
        return float(self.numbers[1])

    @property
    def jitter(self) -> Array:
        """Numbers of the random part of the delay, (2,)."""
        return self.numbers[2:4]

    @property
    def duplicate(self) -> float:
        """Number that decides over a second arrival."""
        return float(self.numbers[4])

    @property
    def echo_jitter(self) -> Array:
        """Numbers of the delay of the second arrival, (2,)."""
        return self.numbers[5:7]

    @property
    def reorder(self) -> float:
        """Number that decides over holding the message back."""
        return float(self.numbers[7])
