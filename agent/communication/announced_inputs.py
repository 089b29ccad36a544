"""Inputs announced by all agents: received plans, shifted to any tick and held at their end."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from transport.agent.communication.unannounced_inputs import (
    Assumed,
    FirstStep,
    PeriodBegin,
    SharedLaw,
    Silent,
    Unannounced,
)
from transport.agent.silence.heard_others import HeardOthers, alone_by
from transport.agent.silence.silence_thresholds import SHARED
from transport.model.arrays import Array, Rows
from transport.model.state import input_places
from transport.mpc.alone.fail_safe import FailSafe
from transport.mpc.settings_period_horizon_weights import ControllerSettings
from transport.protocol.wire.messages import Plan

# Alignment of a plan with the horizon: shifted by its true age; by one tick whatever its age, as in
# the paper; or its input for the present tick, held.
Alignment = Literal["by_age", "by_one", "held"]


class AnnouncedInputs:
    """Inputs of all agents as one agent knows them, by their plans.

    Where a method takes a tick `before`, only plans made before it count, even if later ones have
    been received.

    Args:
        owned: 0-based UAVs of agent 1, agent 2, ...
        u_hover: Inputs assumed before an agent's first plan arrives, (4 N,).
        alignment: Alignment of the others' plans with the horizon.
        own: The agent itself, 1-based, whose plans are always aligned by age; 0 for none.
        law: Shared control law, followed after the first step of a plan; without inputs for none.
        settings: Bounds of the actuators, applied to inputs in force, and the sampling period, by which
            actuators play a last plan.

    The attributes describe the team; who owns this object changes them with the team, at the tick
    of the change and before `heard.observe`.

    Attributes:
        plans: Newest plans received of all agents.
        heard: Plans of all agents, who is off the roster, and how old information is. From
            `heard.failed_since` on, every agent follows the control law of the remaining UAVs; plans made
            before that tick hold only for periods before it.
        fail_safe: Control law after the last plan of an agent off the roster.
        law_since: Tick from which on the shared control law is that of the present team, (46).
    """

    def __init__(
        self,
        owned: Sequence[Sequence[int]],
        u_hover: Array,
        alignment: Alignment = "by_age",
        own: int = 0,
        law: SharedLaw | None = None,
        settings: ControllerSettings | None = None,
    ) -> None:
        self._owned = owned
        self._u_hover = u_hover
        self._alignment = alignment
        self._own = own
        self._law = SharedLaw() if law is None else law

        # Columns of u by agent.
        self._columns = {agent: input_places(uavs) for agent, uavs in enumerate(owned, start=1)}
        self.heard = HeardOthers(
            self._columns, own, self._law.silence, self._law.silence_after_failures
        )
        self.plans = self.heard.plans
        self.fail_safe: FailSafe | None = None
        self.law_since = 0
        # Where the last plan of a departed agent has not been received: inputs in its place.
        self._assumed: dict[int, Assumed] = {}
        # Of the plan of each agent that was last asked for.
        self._first_steps: dict[int, FirstStep] = {}

        self._bounds: tuple[Array, Array] | None = None
        self._period_s: float | None = None
        if settings is not None:
            count = sum(map(len, owned))
            self._period_s = settings.sampling_period_s
            self._bounds = settings.lower(count), settings.upper(count)

    def add(self, plan: Plan) -> None:
        """Keep a plan, in any order of arrival; a second plan of the same tick is ignored."""
        self.plans.add(plan)

    def begin_anew(self, agent: int, tick: int) -> None:
        """Discard the plans of an agent that starts anew at a tick, and how old they were.

        Until then it was off the roster, and its UAVs on their fail-safe.
        """
        self.heard.begin_anew(agent, tick)
        self._assumed.pop(agent, None)

    def assume(self, agent: int, start: int, inputs: Array) -> None:
        """Assume inputs of all UAVs, (N_p, 4 N), from a tick on for a departed agent.

        Source: docs/equations.md (32b).
        """
        columns = self._columns[agent]
        self._assumed[agent] = Assumed(start_tick=start, inputs=inputs[:, columns])

    # Over the horizon, (32).

    def sequence(self, start: int, steps: int, before: int, *, of_all: bool = True) -> Array:
        """Return the announced inputs over the horizon: the newest plans, held at their ends.

        Of an agent off the roster: its last plan as far as the actuators play it, or what is assumed in
        its place, then hover. Of one whose plans are stale and over: hover. Without `of_all` only
        the own ones are looked up, and those of all others are hover.

        Returns: Inputs over N_p steps from tick `start` on, (N_p, 4 N).
        Source: docs/equations.md (32); paper, section IV-A.
        """
        U = np.empty((steps, len(self._u_hover)))
        agents = self._columns if of_all else (self._own,)
        if not of_all:
            U[:] = self._u_hover
        for agent in agents:
            columns = self._columns[agent]
            plan = self.plans.newest(agent, before)
            assumed = self._assumed.get(agent)

            #   u_a(s + j) = U_a(min(s + j - s_a, N_p - 1))    (32)
            end = self._hover(columns)
            if assumed is not None:
                played = assumed.inputs[: self._steps_played(len(assumed.inputs))]
                entries = played[max(start - assumed.start_tick, 0) :][:steps]
            elif plan is not None and agent in self.heard.off_roster:
                played = plan.inputs[: self._steps_played(len(plan.inputs))]
                entries = self._aligned(played, plan, start, steps)
            elif plan is not None and not self._is_silent(plan, start):
                entries = self._aligned(plan.inputs, plan, start, steps)
                end = plan.inputs[-1]
            else:
                entries = U[:0, columns]
            U[: len(entries), columns] = entries
            U[len(entries) :, columns] = end
        return U

    def corrections(self, start: int, steps: int, before: int) -> Array:
        """Return the announced corrections to the shared law, (N_p, 4 N), zero after their end.

        Those of plans made under the law of another team are to the present law as well; after a
        failure of UAVs there are none. Source: docs/equations.md (32), (46).
        """
        c = np.zeros((steps, len(self._u_hover)))
        for agent, columns in self._columns.items():
            plan = self.plans.newest(agent, before)
            if plan is None or agent in self.heard.off_roster:
                continue
            if plan.tick < self.heard.failed_since or self._is_silent(plan, start):
                continue
            entries = self._aligned(plan.corrections, plan, start, steps)
            c[: len(entries), columns] = entries
        return c

    def _hover(self, columns: Rows) -> Array:
        """Return the hover inputs of an agent's UAVs, (4 owned,)."""
        hover: Array = self._u_hover[columns]
        return hover

    def _aligned(self, sequence: Array, plan: Plan, start: int, steps: int) -> Array:
        """Return a plan's inputs or corrections aligned with the horizon, as far as they reach."""
        passed = max(start - plan.start_tick, 0)  # steps of the plan before the horizon
        if self._alignment == "by_age":
            return sequence[passed : passed + steps]
        if plan.agent == self._own or plan.agent in self.heard.off_roster:  # its age is known
            return sequence[passed : passed + steps]
        if self._alignment == "held":
            present = sequence[passed:][:1]
            return np.repeat(present, steps, axis=0)
        return sequence[min(passed, 1) :][:steps]  # "by_one"

    # Over a past or present period, (32a).

    def in_force(self, tick: int, before: int, x: Array | None = None) -> Array:
        """Return the inputs assumed over [t_k, t_{k+1}), from each agent's newest started plan.

        - The first input of a plan, and all of an own plan: as announced.
        - Later ones have been replaced by plans that were not received: the shared control law, where
          there is one, and in part the law of a UAV alone, by the age of the plan.
        - An agent off the roster: its last plan as far as the actuators play it, then its fail-safe.
        - An agent whose plans are stale: its fail-safe once they are over.
        - An agent without any plan: hover; once its first plan is overdue, as after a plan.

        The state x at t_k, (n,), serves to evaluate control laws and fail-safe; None leaves them
        out.

        Returns: (4 N,).
        Source: docs/equations.md (32), (32a).
        """
        u = np.empty(len(self._u_hover))
        at = PeriodBegin(tick, x, self._law)
        for agent, columns in self._columns.items():
            plan = self.plans.newest(agent, before, started=tick)
            if plan is None:
                u[columns] = self._without_plan(agent, at)
            else:
                u[columns] = self._applied(plan, at)

        if self._bounds is None:
            return u
        lower, upper = self._bounds
        return np.minimum(np.maximum(u, lower), upper)

    def unannounced(self, tick: int, before: int) -> Unannounced:
        """Return which of the inputs of `in_force` no plan has told.

        - An agent off the roster: by the fail-safe once its last plan has been played; without a plan
          its UAVs have hover inputs, as the plant knows.
        - One whose plans are stale and over: by the fail-safe.
        - Before its return: by the fail-safe.
        - Another agent: by the law after the first step of its plan, or without a plan, also where
          `in_force` has hover inputs or announced ones.
        """
        m = len(self._u_hover)
        unannounced = Unannounced(
            by_law=np.zeros(m, dtype=bool), by_fail_safe=np.zeros(m, dtype=bool)
        )
        for agent, columns in self._columns.items():
            plan = self.plans.newest(agent, before, started=tick)
            is_over = plan is not None and self._is_on_fail_safe(plan, tick)
            if agent in self.heard.off_roster:
                unannounced.by_fail_safe[columns] = is_over
            elif is_over or (plan is None and self.heard.is_before_return(agent, tick)):
                unannounced.by_fail_safe[columns] = True
            elif agent != self._own:
                unannounced.by_law[columns] = plan is None or plan.start_tick < tick
        return unannounced

    def silent(self, tick: int, before: int) -> Silent | None:
        """Return what is assumed of the others' inputs; None where all information is as usual."""
        silence = self.heard.silence
        if silence is None:
            return None
        share = np.zeros(len(self._u_hover))
        correlation = np.full(len(self._u_hover), SHARED)
        for agent, columns in self._columns.items():
            if agent != self._own:
                plan = self.plans.newest(agent, before, started=tick)
                age = self.heard.age(agent, plan, tick)
                share[columns] = alone_by(silence, plan, age)
                correlation[columns] = silence.correlation(age)
        # The correlation falls from the age on from which an agent acts alone.
        if not share.any():
            return None
        return Silent(alone=share, correlation=correlation)

    def _applied(self, plan: Plan, at: PeriodBegin) -> Array:
        """Return the inputs that an agent applied after its newest started plan, (4 owned,)."""
        if self._is_on_fail_safe(plan, at.tick):
            return self._by_fail_safe(plan.agent, at)

        #   u_a(k) = U_a(min(k - s_a, N_p - 1))    (32)
        played = self._played(plan, at.tick)
        step = at.tick - played.start_tick
        announced: Array = played.inputs[min(step, len(played.inputs) - 1)]

        # Off the roster the last plan is played; own inputs and first ones are known.
        is_off = plan.agent in self.heard.off_roster
        is_known = is_off or plan.agent == self._own or step <= 0
        if is_known or at.x is None:
            return announced

        # The agent has replaced later inputs by those of plans that were not received: here by the
        # shared law, (32a). Before the present law that was another, which is not known any more: then
        # the inputs count as announced.
        is_under_law = at.tick >= max(self.law_since, self.heard.failed_since)
        by_law = self._by_law(plan, at) if is_under_law else announced
        if by_law is None:
            return announced
        return self._mixed(by_law, plan.agent, plan, at)

    def _without_plan(self, agent: int, at: PeriodBegin) -> Array:
        """Return the inputs of an agent without any plan, (4 owned,).

        Hover; once its first plan is overdue, by the shared law, and alone. An agent that has
        returned was on its fail-safe before, and follows the law from then on. Source: (32c).
        """
        columns = self._columns[agent]
        hover = self._hover(columns)
        if self.heard.has_returned(agent):
            if self.heard.is_before_return(agent, at.tick):
                return self._by_fail_safe(agent, at)
        elif not self.heard.acts_without_plan(agent, at.tick):
            return hover
        by_law = hover if at.by_law is None else at.by_law[columns]
        return self._mixed(by_law, agent, None, at)

    def _mixed(self, by_law: Array, agent: int, plan: Plan | None, at: PeriodBegin) -> Array:
        """Return inputs between those by the law and those alone, as the agent is assumed to act."""
        share = self.heard.share_alone(agent, plan, at.tick)
        if share == 0.0 or self._law.inputs_alone is None or at.x is None:
            return by_law
        alone = [self._law.inputs_alone(uav, at.tick, at.x) for uav in self._owned[agent - 1]]
        return (1.0 - share) * by_law + share * np.concatenate(alone)

    def _played(self, plan: Plan, tick: int) -> Plan | Assumed:
        """Return the plan that the actuators play, or the inputs assumed in its place, (32b)."""
        assumed = self._assumed.get(plan.agent)
        if assumed is not None and tick >= assumed.start_tick:
            return assumed
        return plan

    def _is_silent(self, plan: Plan, tick: int) -> bool:
        """Return whether another agent goes on sending inputs that are not played any more."""
        return plan.agent != self._own and self._is_on_fail_safe(plan, tick)

    def _is_on_fail_safe(self, plan: Plan, tick: int) -> bool:
        """Return whether the actuators have played an agent's last fresh inputs, and none are expected.

        It is off the roster, or has not solved a step since.
        """
        is_last = plan.stale > 0 or plan.agent in self.heard.off_roster
        return is_last and self._is_over(plan, tick)

    def _is_over(self, plan: Plan, tick: int) -> bool:
        """Return whether the actuators have played all of a plan, or of what stands for it."""
        played = self._played(plan, tick)
        return played.played(tick) >= self._steps_played(len(played.inputs))

    def _steps_played(self, steps: int) -> int:
        """Return how many steps of a last plan the actuators play."""
        if self.fail_safe is None or self._period_s is None:
            return steps
        return self.fail_safe.played(steps, self._period_s)

    def _by_law(self, plan: Plan, at: PeriodBegin) -> Array | None:
        """Return an agent's inputs by the shared law after its plan's first step, (4 owned,).

        None where there is no such law. Source: docs/equations.md (32a).
        """
        u = at.by_law
        if u is None:
            return None
        by_law: Array = u[self._columns[plan.agent]]
        if plan.tick < self.heard.failed_since or not len(plan.corrections):
            return by_law

        #   lambda_a(k) = K_a (x(k) - x_ref(k)) + c_ff(k) + C_a(k - s_a),    C_a zero after its end
        step = at.tick - plan.start_tick
        if step < len(plan.corrections):
            by_law = by_law + plan.corrections[step]
        if plan.tick < self.law_since:
            return by_law  # the sender's law was another: its first step tells nothing, (46)

        # Differences in the sender's knowledge, such as external forces, show at the first step.
        #   u_a(k) = U_a(0) + lambda_a(k) - lambda_a(s_a)
        # Not exact: U_a(0) of an agent that returns already contains its part alone, and `_mixed` adds
        # that part once more. In flights the payload's error is the same without it.
        first_step = self._beyond_law(plan)
        return by_law if first_step is None else by_law + first_step

    def _beyond_law(self, plan: Plan) -> Array | None:
        """Return by how much a plan's first step differs from the law, U_a(0) - lambda_a(s_a), (4 owned,).

        None where the state or the law at its start is not known. The same for all later ticks, as long
        as the estimate at its start is.
        """
        start_state = self._law.start_state(plan.start_tick)
        u_start = None if start_state is None else self._law.inputs(plan.start_tick, start_state)
        if u_start is None:
            return None
        newest = self._first_steps.get(plan.agent)
        if newest is None or newest.plan is not plan or newest.u_start is not u_start:
            beyond = plan.inputs[0] - u_start[self._columns[plan.agent]] - plan.corrections[0]
            newest = FirstStep(plan, u_start, beyond)
            self._first_steps[plan.agent] = newest
        return newest.beyond_law

    def _by_fail_safe(self, agent: int, at: PeriodBegin) -> Array:
        """Return an agent's inputs by the fail-safe, (4 owned,); hover without a state."""
        if at.x is None or self.fail_safe is None:
            return self._hover(self._columns[agent])
        # No sensor can tell the force of its integral from what pushes it: neither is assumed.
        inputs = [self.fail_safe.inputs(uav, at.x, at.tick) for uav in self._owned[agent - 1]]
        return np.concatenate(inputs)
