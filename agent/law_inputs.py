"""Inputs of the team by the shared control law at recent ticks, each computed once."""

from dataclasses import dataclass

from transport.agent.estimation.history import WINDOW
from transport.model.arrays import Array
from transport.mpc.regulation import Regulation

# Ticks kept: those that an estimator repeats, and as many before, at which plans began.
_KEPT = 2 * WINDOW


@dataclass(frozen=True, slots=True, kw_only=True)
class LawArguments:
    """Values that the inputs at a tick follow from, beside the control law."""

    x: Array  # estimate, (n,) or (n + m,)
    x_ref: Array  # reference, (n,)
    forces: Array | None  # estimated external forces

    def key(self) -> tuple[bytes, bytes, bytes]:
        """Return the values as bytes, to be compared."""
        forces = b"" if self.forces is None else self.forces.tobytes()
        return self.x.tobytes(), self.x_ref.tobytes(), forces


@dataclass(frozen=True, slots=True, kw_only=True)
class _Saved:
    key: tuple[bytes, bytes, bytes]
    version: object  # of the control law
    inputs: Array | None


class LawInputs:
    """Inputs by a control law, saved by tick while their arguments have the same values.

    They are needed once for each of the other agents, and those of past ticks again at later ones.
    """

    def __init__(self, regulation: Regulation) -> None:
        self._regulation = regulation
        self._saved: dict[int, _Saved] = {}

    def inputs(self, tick: int, arguments: LawArguments) -> Array | None:
        """Return the inputs without corrections, (m,); None with open-loop prediction."""
        key = arguments.key()
        version = self._regulation.version
        saved = self._saved.get(tick)
        if saved is not None and saved.version is version and saved.key == key:
            return saved.inputs

        inputs = self._regulation.inputs(arguments.x, arguments.x_ref, arguments.forces, tick)
        self._saved[tick] = _Saved(key=key, version=version, inputs=inputs)
        if len(self._saved) > _KEPT:
            del self._saved[min(self._saved)]
        return inputs
