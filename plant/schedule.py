"""Actuator schedule: each UAV follows the newest plan that has started, and a fail-safe after its end."""

import numpy as np

from model import state
from model.arrays import Array
from mpc.fail_safe import FailSafe
from mpc.settings import ControllerSettings
from protocol.wire.messages import Plan

# Sources of an input that is not from a plan (`PlantState.plan_ticks`).
BEFORE_ANY_PLAN, FAIL_SAFE, MOTOR_OFF = -1, -2, -3


class ActuatorSchedule:
    """Inputs of all actuators, tick by tick.

    Args:
        u_hover: Inputs before any plan, (4 N,).
        fail_safe: Control law after the end of a plan.
        settings: Bounds of the inputs, and sampling period.

    Attributes:
        fail_safe: That control law.
    """

    def __init__(self, u_hover: Array, fail_safe: FailSafe, settings: ControllerSettings) -> None:
        self._u_hover = u_hover
        self.fail_safe = fail_safe
        self._lower, self._upper = settings.lower(1), settings.upper(1)
        self._step = settings.step(1)
        self._plans: list[list[Plan]] = [[] for _ in range(len(u_hover) // state.INPUTS)]

    def add(self, plan: Plan) -> None:
        """Add a plan to the schedule of its UAVs, in any order of arrival."""
        for uav in plan.uavs:
            plans = self._plans[uav - 1]
            plans.append(plan)
            plans.sort(key=lambda p: (p.start_tick, p.tick))

    def inputs(self, tick: int, x: Array, u_before: Array) -> tuple[Array, tuple[int, ...]]:
        """Return the inputs over [t_k, t_{k+1}) and their sources; forget plans before tick k.

        The fail-safe takes the state x at t_k, (n,), and changes the inputs until t_k, (4 N,), at the actuators' rate
        at most.

        Returns: u (4 N,); the tick of the plan of each UAV, or `BEFORE_ANY_PLAN`, `FAIL_SAFE`.
        """
        u = self._u_hover.copy()
        sources = []
        for i, plans in enumerate(self._plans):
            started = [plan for plan in plans if plan.start_tick <= tick]
            if not started:
                sources.append(BEFORE_ANY_PLAN)
                continue
            newest = started[-1]
            self._plans[i] = [newest, *(plan for plan in plans if plan.start_tick > tick)]
            step = tick - newest.start_tick
            if step < len(newest.inputs):
                at = newest.uavs.index(i + 1)
                u[state.input_slice(i)] = newest.inputs[step, state.input_slice(at)]
                sources.append(newest.tick)
            else:
                u[state.input_slice(i)] = self._limited(
                    self.fail_safe.inputs(i, x, tick), u_before[state.input_slice(i)]
                )
                sources.append(FAIL_SAFE)
        return u, tuple(sources)

    def _limited(self, inputs: Array, before: Array) -> Array:
        """Return the inputs within the limits of the actuators."""
        np.clip(inputs, before - self._step, before + self._step, out=inputs)
        return np.clip(inputs, self._lower, self._upper, out=inputs)
