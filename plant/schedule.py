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
    """Inputs of all actuators, tick by tick: hover, (4 N,), before any plan, a fail-safe after the end of one."""

    def __init__(self, u_hover: Array, fail_safe: FailSafe, settings: ControllerSettings) -> None:
        self._u_hover = u_hover
        self.fail_safe = fail_safe
        self._lower, self._upper, self._step = settings.lower(1), settings.upper(1), settings.step(1)
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

        Returns: Inputs, (4 N,), and for each UAV the tick at which its plan was made, or another source.
        """
        u, sources = self._u_hover.copy(), [BEFORE_ANY_PLAN] * len(self._plans)
        for i, plans in enumerate(self._plans):
            started = [plan for plan in plans if plan.start_tick <= tick]
            if not started:
                continue
            newest, own = started[-1], state.input_slice(i)
            self._plans[i] = [newest, *(plan for plan in plans if plan.start_tick > tick)]
            step = tick - newest.start_tick
            if step < len(newest.inputs):
                u[own], sources[i] = newest.inputs[step, state.input_slice(newest.uavs.index(i + 1))], newest.tick
            else:
                before, safe = u_before[own], self.fail_safe.inputs(i, x, tick)
                safe = np.clip(safe, before - self._step, before + self._step)
                u[own], sources[i] = np.clip(safe, self._lower, self._upper), FAIL_SAFE
        return u, tuple(sources)
