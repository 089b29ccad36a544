"""The shared control law over a horizon: u = u_rest + K (x - x_ref) + feedforward + c.

Every agent decides its own corrections c.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np

from transport.model.arrays import Array


class FeedbackError(ValueError):
    """No stabilising feedback exists or was found; the text says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gains:
    """The regulator at an instant of a reference, and the difference equation about it."""

    K: Array  # feedback gain, (m, n)
    feedforward: Array  # answer to the difference of the reference from the model's step, (m,)
    M: Array  # weight of the corrections, (m, m)
    A_closed: Array  # state matrix with all feedback, (n, n)
    B: Array  # input matrix, (n, m)


class FeedbackLaw(msgspec.Struct, frozen=True, kw_only=True, dict=True):
    """The shared control law over one horizon; n counts the actual inputs of known motors."""

    K: Array  # feedback gain, (m, n), or along a reference of each step, (N_p, m, n)
    u_rest: Array  # input that holds the reference state under forces, (m,), or of each step
    error: Array  # x0 - x_ref, x_ref shifted by forces likewise, at steps 0..N_p-1, (N_p, n)
    feedforward: Array  # response to the reference ahead, (N_p, m)
    c: Array  # announced corrections of all UAVs, shifted, (N_p, m)
    gains: Sequence[Gains] | None = None  # of each step along a reference; None about hover

    @cached_property
    def uncorrected(self) -> Array:
        """Inputs with the state held at x0, without corrections, (N_p, m)."""
        if self.gains is None:
            return self.u_rest + self.error @ self.K.T + self.feedforward
        fed_back = np.einsum("kmn,kn->km", self.K, self.error)
        return np.asarray(self.u_rest + fed_back + self.feedforward)
