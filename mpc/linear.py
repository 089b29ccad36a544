"""The model of one step: everything linearised about one (x0, u0)."""

from dataclasses import dataclass

from model.arrays import Array
from model.linearisation import Linearisation


@dataclass(frozen=True, slots=True, kw_only=True)
class Linear:
    """Linearisation of one step and its steady-state input.

    Attributes:
        x0: State of the linearisation, (n,).
        u0: Input of the linearisation, (m,).
        model: f, A_c, B_c, y, C.
        u_target: Input without cost, (m,).
    """

    x0: Array
    u0: Array
    model: Linearisation
    u_target: Array
