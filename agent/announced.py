"""Inputs announced by all agents: received plans, shifted to any tick and held at their end."""

from bisect import bisect_left
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Literal

import numpy as np
import numpy.typing as npt

from agent.handover import News, Silence
from model.arrays import Array
from model.state import input_indices
from mpc.fail_safe import FailSafe
from mpc.settings import ControllerSettings
from protocol.wire.messages import Plan

# Alignment of a plan with the horizon: shifted by its true age; by one tick whatever its age, as in the paper; or its
# input for the present tick, held.
Alignment = Literal["by_age", "by_one", "held"]

# Inputs of all UAVs by the shared control law, without corrections, from tick and state; None without such a law.
Law = Callable[[int, Array], Array | None]
# Present estimate of the state at a past tick, (n,); None where it is not known.
Past = Callable[[int], Array | None]

# Plans kept per agent: enough for the past inputs over any usable delay.
KEPT_PLANS = 256


class AnnouncedInputs:
    """Plans of all agents as one agent knows them.

    Where a method takes a tick `before`, only plans made before it count, even if later ones have been received.

    Args:
        owned: 0-based UAVs of agent 1, agent 2, ...
        u_hover: Inputs assumed before an agent's first plan arrives, (4 N,).
        alignment: Alignment of the others' plans with the horizon.
        own: The agent itself, 1-based, whose plans are always aligned by age; 0 for none.
        law: Shared control law, followed after the first step of a plan.
        past: State estimates: the difference of the first step of a plan from that law holds for later ones. None where
            the error of the sender's estimate, which differs from tick to tick, is most of it.
        settings: Bounds of the actuators, applied to that law.
    """

    def __init__(
        self,
        owned: Sequence[Sequence[int]],
        u_hover: Array,
        alignment: Alignment = "by_age",
        own: int = 0,
        law: Law = lambda _tick, _x: None,
        past: Past | None = None,
        settings: ControllerSettings | None = None,
    ) -> None:
        self.off_roster: set[int] = set()  # agents that make no more plans
        self.fail_safe: FailSafe | None = None  # control law after the last plan of one of them
        self.silence: Silence | None = None  # rule by which the others act alone; None: they never do
        self.news = News(())  # usual ages of the others' plans
        self.began = 0  # tick from which on the agent could have had plans of the others
        self.alone_inputs: Callable[[int, int, Array], Array] | None = None  # of a UAV alone, by UAV, tick and state
        self.law_since = 0  # tick from which on the shared control law is that of the present team
        # Tick of the newest failure of a UAV: from then on every agent follows the control law of the UAVs that are
        # left; earlier plans apply until then.
        self.failed_since = 0
        self._owned, self._u_hover, self._alignment, self._own = owned, u_hover, alignment, own
        self._law, self._past = law, past
        uavs = sum(map(len, owned))
        self._bounds = None if settings is None else (settings.lower(uavs), settings.upper(uavs))
        self._columns = {agent: input_indices(uavs) for agent, uavs in enumerate(owned, start=1)}
        # By agent, ascending in the tick they were made at.
        self._plans: dict[int, list[Plan]] = {agent: [] for agent in self._columns}
        # Start and inputs assumed for the last plan of agents that left, where that plan has not been received.
        self._assumed: dict[int, tuple[int, Array]] = {}

    def add(self, plan: Plan) -> None:
        """Keep a plan, in any order of arrival; a second plan of the same tick is ignored."""
        plans = self._plans[plan.agent]
        at = bisect_left(plans, plan.tick, key=attrgetter("tick"))
        if at == len(plans) or plans[at].tick != plan.tick:
            plans.insert(at, plan)
        if len(plans) > KEPT_PLANS:
            del plans[0]

    def forget(self, agent: int) -> None:
        """Discard the plans of an agent that starts anew."""
        self._plans[agent].clear()
        self._assumed.pop(agent, None)

    def assume(self, agent: int, start: int, inputs: Array) -> None:
        """Assume inputs, (N_p, 4 N), from a tick on for an agent that left: docs/equations.md (32b)."""
        self._assumed[agent] = start, inputs[:, self._columns[agent]]

    def newest(self, agent: int, before: int, started: int | None = None) -> Plan | None:
        """Return the newest plan that an agent made before a tick, and that has started at another."""
        for plan in reversed(self._plans[agent]):
            if plan.tick < before and (started is None or plan.start_tick <= started):
                return plan
        return None

    def sequence(self, start: int, steps: int, before: int) -> Array:
        """Return the announced inputs of all UAVs over the horizon: the newest plans, held at their ends.

        Hover follows the last plan of an agent off the roster.

        Returns: Inputs over N_p steps from tick `start` on, (N_p, 4 N).
        Source: docs/equations.md (32); paper, section IV-A.
        """
        U = np.repeat(self._u_hover[None], steps, axis=0)
        for agent, columns in self._columns.items():
            plan = self.newest(agent, before)
            if agent in self._assumed:
                begun, inputs = self._assumed[agent]
                entries = inputs[max(start - begun, 0) :][:steps]
            elif plan is not None:
                entries = self._entries(plan.inputs, plan, start, steps)
                if agent not in self.off_roster:
                    U[len(entries) :, columns] = plan.inputs[-1]
            else:
                continue
            U[: len(entries), columns] = entries
        return U

    def under_previous_law(self, before: int) -> list[int]:
        """Return the agents whose newest plan made before a tick was made under the previous control law."""
        newest = {agent: self.newest(agent, before) for agent in self._columns if agent not in self.off_roster}
        return [agent for agent, plan in newest.items() if plan and self.failed_since <= plan.tick < self.law_since]

    def corrections(self, start: int, steps: int, before: int) -> Array:
        """Return the announced corrections, (N_p, 4 N), zero after their end. Source: docs/equations.md (32)."""
        c = np.zeros((steps, len(self._u_hover)))
        for agent, columns in self._columns.items():
            plan = self.newest(agent, before)
            if plan is not None and agent not in self.off_roster and plan.tick >= self.failed_since:
                entries = self._entries(plan.corrections, plan, start, steps)
                c[: len(entries), columns] = entries
        return c

    def unannounced(self, tick: int, before: int) -> npt.NDArray[np.bool_]:
        """Return which of the inputs that `at` returns no plan says: by the law, and by the fail-safe, (2, 4 N)."""
        found = np.zeros((2, len(self._u_hover)), dtype=bool)
        by_law, by_fail_safe = found
        for agent, columns in self._columns.items():
            plan = self.newest(agent, before, tick)
            if agent in self.off_roster:
                by_fail_safe[columns] = plan is not None and tick - plan.start_tick >= len(plan.inputs)
            elif agent != self._own:
                by_law[columns] = plan is None or plan.start_tick < tick
        return found

    def overdue(self, agent: int, tick: int, before: int) -> float:
        """Return by how many ticks another agent's news are older than usual at a tick; 0 off the roster."""
        if agent == self._own or agent in self.off_roster:
            return 0.0
        plan = self.newest(agent, before, tick)
        since = self.began - 1 if plan is None else plan.tick
        return max(0.0, float(tick - since - self.news.usual(agent)))

    def alone(self, agent: int, tick: int, before: int) -> float:
        """Return how much another agent is assumed to act alone at a tick: as its plan says, and by the rule."""
        if self.silence is None:
            return 0.0
        plan = self.newest(agent, before, tick)
        said = 0.0 if plan is None else plan.alone
        return max(said, self.silence.alone(self.overdue(agent, tick, before)))

    def silent(self, tick: int, before: int) -> tuple[Array, Array] | None:
        """Return share alone and correlation of errors by input, (4 N,) each; None where all news are as usual."""
        if self.silence is None:
            return None
        share, shared = np.zeros(len(self._u_hover)), np.full(len(self._u_hover), self.silence.shared(0.0))
        for agent, columns in self._columns.items():
            share[columns] = self.alone(agent, tick, before) if agent != self._own else 0.0
            shared[columns] = self.silence.shared(self.overdue(agent, tick, before))
        is_usual = not share.any() and bool((shared == self.silence.shared(0.0)).all())
        return None if is_usual else (share, shared)

    def at(self, tick: int, before: int, x: Array | None = None) -> Array:
        """Return the inputs assumed in force over [t_k, t_{k+1}): from each agent's newest plan that had started.

        That plan's first input was applied as announced. Later ones have been replaced by plans that were not received.
        With a shared control law they are the first one plus the change of that law since then, with the state and the
        announced corrections; the sender's estimate of external forces cancels out of the difference.

        The state x at t_k, (n,), serves to evaluate control law and fail-safe; None leaves both out.

        Returns: (4 N,).
        Source: docs/equations.md (32), (32a).
        """
        u = self._u_hover.copy()
        for agent, columns in self._columns.items():
            plan, is_off = self.newest(agent, before, tick), agent in self.off_roster
            if plan is None:
                if x is not None and self._is_silent(agent, tick, before):
                    self._without_plan(u, agent, tick, before, x)
                continue
            begun, inputs = plan.start_tick, plan.inputs
            if agent in self._assumed and tick >= self._assumed[agent][0]:
                begun, inputs = self._assumed[agent]
            step = tick - begun
            if is_off and step >= len(inputs):
                if x is not None and self.fail_safe is not None:
                    owned = self._owned[agent - 1]
                    u[columns] = np.concatenate([self.fail_safe.inputs(uav, x, tick) for uav in owned])
                continue
            u[columns] = inputs[min(step, len(inputs) - 1)]
            failed = plan.tick < self.failed_since
            is_replaced = tick >= self.failed_since if failed else plan.tick >= self.law_since
            if is_replaced and x is not None and step > 0 and not is_off and agent != self._own:
                by_law = self._by_law(plan, tick, x)
                if by_law is not None:
                    u[columns] = by_law[columns]
                self._mix(u, agent, tick, before, x)
        return u if self._bounds is None else np.minimum(np.maximum(u, self._bounds[0]), self._bounds[1])

    def _is_silent(self, agent: int, tick: int, before: int) -> bool:
        """Return whether an agent on the roster, not the own one, should have been heard long ago."""
        return self.silence is not None and self.overdue(agent, tick, before) > self.silence.begins

    def _without_plan(self, u: Array, agent: int, tick: int, before: int, x: Array) -> None:
        """Set the inputs of an agent whose first plan is overdue: by the shared law, and alone. Source: (32c)."""
        by_law, columns = self._law(tick, x), self._columns[agent]
        if by_law is not None:
            u[columns] = by_law[columns]
        self._mix(u, agent, tick, before, x)

    def _mix(self, u: Array, agent: int, tick: int, before: int, x: Array) -> None:
        """Mix the inputs of an agent with those of its UAVs alone, as far as it is assumed to act so."""
        share, columns = self.alone(agent, tick, before), self._columns[agent]
        if share > 0.0 and self.alone_inputs is not None:
            inputs = self.alone_inputs
            alone = np.concatenate([inputs(uav, tick, x) for uav in self._owned[agent - 1]])
            u[columns] = (1.0 - share) * u[columns] + share * alone

    def _by_law(self, plan: Plan, tick: int, x: Array) -> Array | None:
        """Return an agent's inputs by the shared control law after the first step of its plan, at the state x, (n,).

        Returns: (4 N,), valid in the agent's columns only; None where there is no such law.
        Source: docs/equations.md (32a).
        """
        u = self._law(tick, x)
        if u is None or plan.tick < self.failed_since or not len(plan.corrections):
            return u
        u, columns, step = u.copy(), self._columns[plan.agent], tick - plan.start_tick
        if step < len(plan.corrections):
            u[columns] += plan.corrections[step]
        began = None if self._past is None else self._past(plan.start_tick)
        then = None if began is None else self._law(plan.start_tick, began)
        if then is not None:
            # Differences in the sender's knowledge, such as external forces, show at the first step.
            u[columns] += plan.inputs[0] - then[columns] - plan.corrections[0]
        return u

    def _entries(self, sequence: Array, plan: Plan, start: int, steps: int) -> Array:
        """Return a plan's inputs or corrections aligned with the horizon, as far as they reach."""
        skipped = max(start - plan.start_tick, 0)
        if self._alignment == "by_age" or plan.agent == self._own or plan.agent in self.off_roster:
            return sequence[skipped:][:steps]
        if self._alignment == "held":
            return np.repeat(sequence[skipped:][:1], steps, axis=0)
        return sequence[min(skipped, 1) :][:steps]
