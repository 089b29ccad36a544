"""Largest roll and pitch of the owned UAVs, softened: docs/equations.md (29a)."""

import math
from typing import ClassVar

import numpy as np

from transport.model import state
from transport.mpc.program.constraints.block import Block
from transport.mpc.program.decision import Decision
from transport.mpc.program.trajectory import Trajectory
from transport.mpc.settings_period_horizon_weights import TiltSection as Settings


class Tilt:
    """Limit on roll and pitch of each owned UAV, either sign; one slack loosens both sides."""

    in_kernel: ClassVar = True

    def __init__(self, decision: Decision, settings: Settings) -> None:
        self.limit_rad = math.radians(settings.limit_deg)
        # Positions in x of the roll and pitch angles.
        first = [state.uav_slice(uav).start + state.THETA.start for uav in decision.uavs]
        self.angles = np.array([roll + axis for roll in first for axis in (0, 1)], dtype=np.intp)

        rows = decision.shape[0] * len(self.angles)
        self.penalties = np.array([settings.penalty])
        self.slack = np.repeat([[-1.0], [1.0]], rows, axis=0)

    def block(self, trajectory: Trajectory) -> Block:
        """Return the rows angle - slack <= limit, then angle + slack >= -limit, at steps 1..N_p."""
        signals = trajectory.states(self.angles)
        angles = signals.values.reshape(-1)
        free = np.full(len(angles), np.inf)
        return Block(
            effect=lambda: np.vstack([signals.effect, signals.effect]),
            lower=np.concatenate([-free, -self.limit_rad - angles]),
            upper=np.concatenate([self.limit_rad - angles, free]),
            slack=self.slack,
        )
