"""Smallest tension of the rods of the owned UAVs, softened: docs/equations.md (30b)."""

from collections.abc import Collection
from typing import ClassVar

import casadi as ca
import numpy as np

from transport.model.physics.dynamics import motion
from transport.model.physics.parameters import System
from transport.model.physics.symbols import Symbols
from transport.mpc.program.constraints.block import Block
from transport.mpc.program.decision import Decision
from transport.mpc.program.trajectory import Trajectory
from transport.mpc.program.user_expressions import Expressions, Formulas
from transport.mpc.settings_period_horizon_weights import TensionSection as Settings


class Tension:
    """Limit on the tension of each rod of an owned UAV, without external forces.

    UAVs off have none: they load the payload, on their rods or as bobs.
    """

    in_kernel: ClassVar = False

    def __init__(self, decision: Decision, settings: Settings) -> None:
        system = decision.system
        symbols = Symbols.of(*system.kind)
        no_forces = ca.SX.zeros(symbols.F.numel())
        tensions = ca.substitute(motion(symbols).tensions, symbols.F, no_forces)

        self._uavs = decision.uavs
        self._has_limit = np.ones(len(decision.uavs), dtype=bool)

        # minimum - tension, N: positive where a tension is too small.
        lacking = [settings.minimum_N - tensions[uav] for uav in decision.uavs]
        variable = ca.vertcat(symbols.x, symbols.u)
        self._lacking = Expressions(Formulas.of(lacking, variable, symbols.p), system.vector())
        self.penalties = np.array([settings.penalty])
        self.slack = np.full((decision.shape[0] * len(decision.uavs), 1), -1.0)

    def fail(self, system: System, off: Collection[int]) -> None:
        """Take the team with bobs in place of released UAVs; UAVs, 0-based, are off."""
        self._lacking.use(system.vector())
        self._has_limit = np.array([uav not in off for uav in self._uavs])

    def block(self, trajectory: Trajectory) -> Block:
        """Return the rows minimum - tension - slack <= 0 at steps 0..N_p - 1."""
        lacking = trajectory.of_states_and_inputs(self._lacking.at)
        upper = np.where(self._has_limit, -lacking.values, np.inf).reshape(-1)
        return Block(
            effect=lambda: lacking.effect,
            lower=np.full(len(upper), -np.inf),
            upper=upper,
            slack=self.slack,
        )
