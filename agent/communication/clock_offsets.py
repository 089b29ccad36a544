"""Clocks of agents that differ: what the plan of another agent says by the own clock.

All agents measure and act at the same instants, but each has its own clock, by which it stamps what it
measures and plans (`clock.offsets_s`). Its own error turns up in the reference, which it follows at the
time that it believes (`Setup.by_clock_of`). A plan of an agent whose clock is further ahead by d seems to
be of an instant d later. The receiver takes its states back by d, and its inputs, each held for a sampling
period, as their means over the own periods.
"""

import math
from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from transport.model import state
from transport.model.arrays import Array, frozen
from transport.model.physics.rotations import cross, euler_rates, rotation
from transport.protocol.wire.messages import Plan

_DOWN_I = np.array([0.0, 0.0, 1.0])


class Clocks:
    """Plans of the others by the clock of one agent, 1-based.

    Args:
        offsets_s: By how much the clock of each agent is ahead, s; none for clocks that agree. They
            differ by less than a period.
        agent: The receiver.
        period_s: Sampling period.
        gravity: m/s^2.
    """

    def __init__(
        self, offsets_s: Sequence[float], agent: int, period_s: float, gravity: float
    ) -> None:
        own_s = offsets_s[agent - 1] if offsets_s else 0.0
        self._ahead_s = [offset_s - own_s for offset_s in offsets_s]
        self._period_s = period_s
        self._gravity_I = gravity * _DOWN_I

    def seen(self, plan: Plan) -> Plan:
        """Return the plan of another agent as it is by the own clock."""
        ahead_s = self._ahead_s[plan.agent - 1] if self._ahead_s else 0.0
        if ahead_s == 0.0:
            return plan
        is_sensed = plan.uav_states.shape[1] != state.PER_UAV
        moved = self._sensed if is_sensed else self._states
        uav_states = moved(plan.uav_states, ahead_s)
        share = ahead_s / self._period_s
        inputs = _mixed(plan.inputs, plan.inputs[-1:], share)
        corrections = _mixed(plan.corrections, np.zeros_like(plan.corrections[:1]), share)
        frozen(uav_states, inputs, corrections)
        return replace(plan, uav_states=uav_states, inputs=inputs, corrections=corrections)

    def _states(self, uav_states: Array, back_s: float) -> Array:
        """Return states, (owned, 12), some time before, by their rates."""
        moved = uav_states.copy()
        for row in moved:
            # The payload, in whose frame rods are given, turns little within a part of a period.
            turning = cross(row[state.ROD_RATE], row[state.E])
            row[state.E] -= back_s * turning
            row[state.E] /= math.hypot(*row[state.E])
            row[state.THETA] -= back_s * (euler_rates(row[state.THETA]) @ row[state.OMEGA])
        return moved

    def _sensed(self, reports: Array, back_s: float) -> Array:
        """Return measurements of the vehicles' sensors, (owned, 80), some time before, by their rates."""
        moved = reports.copy()
        for row in moved.reshape(-1, state.REPORTED):
            if not row[state.IS_KNOWN]:
                continue
            values = row[state.SENSED_VALUES]
            Theta = values[state.THETA].copy()
            force = rotation(Theta) @ values[state.SPECIFIC_FORCE]
            values[state.POSITION] -= back_s * values[state.VELOCITY]
            values[state.VELOCITY] -= back_s * (force + self._gravity_I)
            values[state.THETA] -= back_s * (euler_rates(Theta) @ values[state.OMEGA])
        return moved


def _mixed(rows: Array, after: Array, share: float) -> Array:
    """Return the means of rows, each held for a period, over periods that begin earlier by a share of one.

    A negative share: later. Before the first row it holds, and after the last one `after`, (1, columns).
    """
    if not len(rows):
        return rows
    before = np.concatenate([rows[:1], rows[:-1]])
    later = np.concatenate([rows[1:], after])
    neighbours = before if share > 0.0 else later
    return (1.0 - abs(share)) * rows + abs(share) * neighbours
