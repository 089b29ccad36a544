"""Schedule of the actuators: the plan that each UAV follows, and its fail-safe, tick by tick.

Each UAV follows the newest plan that has started, and a fail-safe once its inputs, counted from the last
solved step, have been played.
"""

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.mpc.alone.fail_safe import FailSafe
from transport.mpc.settings_period_horizon_weights import ControllerSettings
from transport.protocol.wire.messages import Plan

# Sources of an input that is not from a plan (`PlantState.plan_ticks`).
BEFORE_ANY_PLAN = -1
FAIL_SAFE = -2
MOTOR_OFF = -3


class ActuatorSchedule:
    """Inputs of all actuators, tick by tick.

    Hover, (4 N,), before any plan, a fail-safe once the newest one has been played.
    """

    def __init__(self, u_hover: Array, fail_safe: FailSafe, settings: ControllerSettings) -> None:
        self._u_hover = u_hover
        self.fail_safe = fail_safe
        self._lower = settings.lower(1)  # limits of the inputs of a UAV, (4,)
        self._upper = settings.upper(1)
        self._step = settings.largest_step(1)  # largest change in a sampling period, (4,)
        uavs = len(u_hover) // state.INPUTS
        self._plans: list[list[Plan]] = [[] for _ in range(uavs)]
        self._period_s = settings.sampling_period_s
        # Force of the integral of each UAV on a fail-safe that follows, N.
        self._integral_I: dict[int, Array] = {}

    def add(self, plan: Plan) -> None:
        """Add a plan to the schedule of its UAVs, in any order of arrival."""
        for uav in plan.uavs:
            plans = self._plans[uav - 1]
            plans.append(plan)
            plans.sort(key=lambda each: (each.start_tick, each.tick))

    def inputs(self, tick: int, x: Array, u_before: Array) -> tuple[Array, tuple[int, ...]]:
        """Return the inputs over [t_k, t_{k+1}) and their sources.

        Ticks are asked for in their order: of the plans that have started, only the newest of each
        UAV is kept.

        Args:
            tick: Tick k.
            x: State at t_k, (n,), for the fail-safe.
            u_before: Inputs in force until t_k, (4 N,): the fail-safe's differ from them by what the
                actuators can change in a period.

        Returns: Inputs, (4 N,), and for each UAV the tick at which its plan was made, or another
            source.
        """
        u = self._u_hover.copy()
        sources = [BEFORE_ANY_PLAN] * len(self._plans)
        for uav in range(len(self._plans)):
            plan = self._newest_started(uav, tick)
            if plan is None:
                continue
            own = state.input_slice(uav)
            # A plan that repeats older inputs does not renew the time for which these are played.
            if plan.played(tick) < self.fail_safe.played(len(plan.inputs), self._period_s):
                planned = state.input_slice(plan.uavs.index(uav + 1))
                u[own] = plan.inputs[tick - plan.start_tick, planned]
                sources[uav] = plan.tick
                self._integral_I.pop(uav, None)
            else:
                u[own] = self._safe_inputs(uav, tick, x, u_before[own])
                sources[uav] = FAIL_SAFE
        return u, tuple(sources)

    def _newest_started(self, uav: int, tick: int) -> Plan | None:
        """Return the newest plan of a UAV, 0-based, that has started; forget those before it."""
        plans = self._plans[uav]
        started = [plan for plan in plans if plan.start_tick <= tick]
        if not started:
            return None
        ahead = [plan for plan in plans if plan.start_tick > tick]
        self._plans[uav] = [started[-1], *ahead]
        return started[-1]

    def _safe_inputs(self, uav: int, tick: int, x: Array, before: Array) -> Array:
        """Return the fail-safe's inputs of a UAV, (4,), within rates and limits."""
        integral_I = self._integral_I.get(uav, np.zeros(3))
        safe = self.fail_safe.inputs(uav, x, tick, integral_I)
        self._integral_I[uav] = self.fail_safe.integral_after(
            uav, x, tick, integral_I, self._period_s
        )
        safe = np.clip(safe, before - self._step, before + self._step)
        return np.clip(safe, self._lower, self._upper)
