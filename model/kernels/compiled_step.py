"""The compiled step of the model, called by the kernels without Python between the steps."""

import ctypes
from typing import Any

import msgspec
import numpy as np

from transport.model.arrays import Array, ShapeError
from transport.model.kernels import native
from transport.model.kernels.casadi_functions import library
from transport.model.physics.parameters import Kind

# Arguments of `advance`: x, u, p, F, h. The kernel sets the first two.
_PARAMETERS = 2
_FORCES = 3
_LENGTH = 4

_VARYING = 3  # axes of gains that vary

_SLACK = 8  # entries more than CasADi asks for in each room


class Feedback(msgspec.Struct, frozen=True, kw_only=True):
    """u = at_x + K (x(k) - x(0)) within bounds."""

    at_x: Array  # inputs of each step at the first state, (steps, m)
    K: Array  # (m, n), or of each step, (steps, m, n)
    lower: Array  # (m,)
    upper: Array  # (m,)

    def __post_init__(self) -> None:
        """Check the gain, which the kernel reads without asking. Raises: ShapeError."""
        steps, m = self.at_x.shape
        has_length = not self.varies or len(self.K) == steps
        if self.K.shape[-2] != m or not has_length:
            raise ShapeError(
                f"K: expected {m} rows, for all or each of {steps} steps, got {self.K.shape}"
            )

    @property
    def varies(self) -> bool:
        """Whether each step has a gain of its own."""
        return self.K.ndim == _VARYING


class CompiledStep:
    """The function `advance` of a library by its address, with room for its arguments and results."""

    def __init__(self, functions: ctypes.CDLL) -> None:
        # Keeps the library loaded as long as the address is used.
        self._functions = functions
        self._length_s = np.zeros(1)
        self._kept = native.Addresses()
        # Copies of arrays in which controllers with the same model differ.
        self._copies = native.Addresses()

        # CasADi's sizes of the rooms: arguments, results, integers and numbers.
        sizes = (ctypes.c_longlong * 4)()
        functions.advance_work(*(ctypes.byref(sizes, 8 * i) for i in range(4)))
        rooms = [np.zeros(size + _SLACK, dtype=np.intp) for size in sizes]
        self._arguments = rooms[0]
        self._arguments[_LENGTH] = native.address(self._length_s)
        self._rooms = rooms

        advance = ctypes.cast(functions.advance, ctypes.c_void_p).value
        self._addresses = [advance, *(native.address(room) for room in rooms)]

    @staticmethod
    def load(kind: Kind) -> "CompiledStep | None":
        """Return the step of a system of a kind; None where it is not compiled."""
        path = library(*kind) if native.AVAILABLE else None
        functions: Any = None if path is None else ctypes.CDLL(str(path))
        if functions is None or not hasattr(functions, "advance"):
            return None
        return CompiledStep(functions)

    def rollout(
        self, x: Array, feedback: Feedback, duration_s: float, acting: tuple[Array, Array]
    ) -> tuple[Array, Array]:
        """Return states, (steps + 1, n), and inputs, (steps, m), of steps under a feedback.

        acting: the parameters and the external forces. Source: docs/equations.md (13b).
        """
        p, F = acting
        self._length_s[0] = duration_s
        self._arguments[_PARAMETERS] = self._kept.of("p", p)
        self._arguments[_FORCES] = self._kept.of("F", F)

        Z = np.empty((len(feedback.at_x) + 1, len(x)))
        U = np.empty(feedback.at_x.shape)
        Z[0] = x
        native.KERNELS.rollout(
            len(U),
            len(x),
            len(feedback.lower),
            *self._addresses,
            feedback.varies,
            self._kept.of("K", feedback.K),
            native.address(feedback.at_x),
            self._copies.copied("lower", feedback.lower),
            self._copies.copied("upper", feedback.upper),
            native.address(Z),
            native.address(U),
        )
        return Z, U
