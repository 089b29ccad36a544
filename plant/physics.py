"""The interface between the plant and an engine: what integrates the ground truth between two sampling instants.

An engine is a class that is called with the actual `System` of the plant and its section of the scenario. Wind, drag,
measurement noise, mass errors and failures of UAVs are the plant's; they work with every engine. docs/bring-your-own.md
has an engine of ten lines.
"""

from collections.abc import Callable
from typing import Protocol

from model.arrays import Array
from model.parameters import System
from protocol.scenario.plant_sections import PlantSection


class Physics(Protocol):
    """Integration of the ground truth: N UAVs, one payload, in the layout and the signs of `model.state`.

    An engine with cables may have an attribute `tensions`, the least tension of each in the last interval, (N,), N.
    Errors may be raised as any exception: the run then ends with its text.
    """

    def reset(self, x: Array) -> None:
        """Continue from a state, (12 + 12 N,), SI; called before the first interval and after the failure of a UAV."""

    def advance(self, u: Array, forces: Array | None, duration_s: float) -> float | None:
        """Integrate an interval, a sampling period or a part of one.

        Args:
            u: Thrust and moments of each UAV, held, (4 N,), N and N m, in its body frame; thrust >= 0 acts along -b3.
            forces: External forces on the centres of mass of payload and UAVs, held, (3 + 3 N,), inertial frame, N;
                None without any.
            duration_s: > 0, s.
        Returns: The largest local error of any component of the state, SI, if the engine can tell it.
        """

    def state(self) -> Array:
        """Return the present state, (12 + 12 N,), SI, with |e_i| = 1 and e_i . Omega_i = 0."""


# What makes an engine: its class, or any function with the same arguments. Its attribute `version`, if there is
# one, is recorded, else a hash of its file.
EngineClass = Callable[[System, PlantSection], Physics]
