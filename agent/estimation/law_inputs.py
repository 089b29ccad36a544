"""Inputs of the team by the shared control law at recent ticks, each computed once."""

from typing import NamedTuple

from transport.agent.estimation.repeated_ticks import WINDOW
from transport.model.arrays import Array
from transport.mpc.law.present_law import Regulation

# Ticks kept: those that an estimator repeats, and as many before, at which plans began.
_KEPT = 2 * WINDOW


class _Saved(NamedTuple):
    x: Array  # the estimate
    forces: Array | None
    gain_source: object  # of the control law
    inputs: Array | None


class LawInputs:
    """Inputs by a control law along a reference, (K, n), saved by tick while they follow from the same arrays.

    They are needed once for each of the other agents, and those of past ticks again at later ones. Estimates
    and forces are arrays that are replaced, not changed: the same object has the same numbers.
    """

    def __init__(self, regulation: Regulation, X_ref: Array) -> None:
        self._regulation = regulation
        self.follow(X_ref)

    def follow(self, X_ref: Array) -> None:
        """Follow another reference."""
        self._X_ref = X_ref
        self._saved: dict[int, _Saved] = {}

    def inputs(self, tick: int, x: Array, forces: Array | None) -> Array | None:
        """Return the inputs without corrections, (m,); None with open-loop prediction.

        Args:
            tick: Instant of the reference.
            x: Estimate, (n,) or (n + m,).
            forces: Estimated external forces.
        """
        gain_source = self._regulation.current.gain_source
        saved = self._saved.get(tick)
        if (
            saved is not None
            and saved.x is x
            and saved.forces is forces
            and saved.gain_source is gain_source
        ):
            return saved.inputs

        inputs = self._regulation.inputs(x, self._X_ref[tick], forces, tick)
        self._saved[tick] = _Saved(x, forces, gain_source, inputs)
        if len(self._saved) > _KEPT:
            del self._saved[min(self._saved)]
        return inputs
