"""What everybody has announced to do: received plans, shifted to any instant and held at their end."""

from collections.abc import Sequence

import numpy as np

from model.arrays import Array
from model.state import input_indices
from protocol.messages import Plan

# Plans kept per agent: enough to know the inputs of the past over any delay worth flying with.
KEPT_PLANS = 256


class AnnouncedInputs:
    """The plans of all agents as one agent knows them.

    Args:
        owned: 0-based UAVs of agent 1, agent 2, ...
        u_hover: What a UAV is taken to do before its first plan arrives, (4 N,).
    """

    def __init__(self, owned: Sequence[Sequence[int]], u_hover: Array) -> None:
        self._u_hover = u_hover
        self._columns = {agent: input_indices(uavs) for agent, uavs in enumerate(owned, start=1)}
        self._plans: dict[int, dict[int, Plan]] = {agent: {} for agent in self._columns}

    def add(self, plan: Plan) -> None:
        """Keep a plan, whatever order it arrives in."""
        plans = self._plans[plan.agent]
        plans[plan.tick] = plan
        if len(plans) > KEPT_PLANS:
            del plans[min(plans)]

    def has(self, agent: int, tick: int) -> bool:
        """Whether the plan an agent made at a tick is here."""
        return tick in self._plans[agent]

    def newest(self, agent: int, before: int) -> Plan | None:
        """The newest plan of an agent made before a tick."""
        ticks = [tick for tick in self._plans[agent] if tick < before]
        return self._plans[agent][max(ticks)] if ticks else None

    def sequence(self, start: int, steps: int, before: int) -> Array:
        """Announced inputs of all UAVs from a tick on, each agent's newest plan shifted and held at its end.

        Args:
            start: First instant.
            steps: N_p.
            before: Only plans made before this tick count: what arrived early must not be used early.
        Returns: (N_p, 4 N).
        Source: docs/equations.md (32); paper, section IV-A.
        """
        U = np.tile(self._u_hover, (steps, 1))
        for agent, columns in self._columns.items():
            plan = self.newest(agent, before)
            if plan is not None:
                at = np.clip(np.arange(start, start + steps) - plan.start_tick, 0, len(plan.inputs) - 1)
                U[:, columns] = plan.inputs[at]
        return U

    def at(self, tick: int, before: int) -> Array:
        """Inputs taken to be in force over [t_k, t_{k+1}): of each agent's plans that had started, the newest.

        Args:
            tick: k.
            before: Only plans made before this tick count.
        Returns: (4 N,).
        """
        u = self._u_hover.copy()
        for agent, columns in self._columns.items():
            started = [p for t, p in self._plans[agent].items() if t < before and p.start_tick <= tick]
            if started:
                plan = max(started, key=lambda p: (p.start_tick, p.tick))
                u[columns] = plan.inputs[min(tick - plan.start_tick, len(plan.inputs) - 1)]
        return u
