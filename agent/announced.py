"""Inputs announced by all agents: received plans, shifted to any tick and held at their end."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from transport.agent.handover import NO_WAIT, SHARED, News, NewsAge, Silence
from transport.agent.plans import ReceivedPlans
from transport.model.arrays import Array, Rows
from transport.model.state import input_places, input_slice
from transport.mpc.fail_safe import FailSafe
from transport.mpc.settings import ControllerSettings
from transport.protocol.wire.messages import Plan

# Alignment of a plan with the horizon: shifted by its true age; by one tick whatever its age, as in
# the paper; or its input for the present tick, held.
Alignment = Literal["by_age", "by_one", "held"]
# Tick of an event that has not occurred: before the first.
NEVER = -1


def _none(*_: object) -> None:
    """Return None: no law, no state."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedLaw:
    """Control law that all agents share, as one agent evaluates it for the others."""

    # Inputs of all UAVs without corrections, (m,), from tick and state, (n,); None without a law.
    inputs: Callable[[int, Array], Array | None] = _none
    # Estimate at the tick at which a plan starts, (n,): the difference of the plan's first step
    # from the law holds for later ones. None where the state is not known, or where that difference
    # is mostly the error of the sender's estimate, which changes from tick to tick.
    start_state: Callable[[int], Array | None] = _none
    # Rules by which the others act alone as their news are overdue or late, and that after failures of
    # UAVs; and the inputs of a UAV alone, (4,), from UAV, tick and state. None: they never do.
    silence: Silence | None = None
    silence_after_failures: Silence | None = None
    inputs_alone: Callable[[int, int, Array], Array] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Silent:
    """How much other agents are assumed to act alone, by input, (m,) each."""

    alone: Array  # share of the law alone, 0 to 1
    correlation: Array  # of the errors of their estimates with the own ones


@dataclass(frozen=True, slots=True, kw_only=True)
class Untold:
    """Inputs of a tick that no plan has told, as masks, (m,), which `tell` changes."""

    by_law: npt.NDArray[np.bool_]  # of agents that follow the shared control law
    by_fail_safe: npt.NDArray[np.bool_]  # of UAVs on their fail-safe

    def tell(self, uav: int) -> None:
        """Declare the inputs of a UAV, 0-based, told."""
        self.by_law[input_slice(uav)] = False
        self.by_fail_safe[input_slice(uav)] = False

    def any(self) -> bool:
        """Return whether an input is untold."""
        return bool(self.by_fail_safe.any() or self.by_law.any())


@dataclass(frozen=True, slots=True, kw_only=True)
class Assumed:
    """Inputs assumed in place of the last plan of an agent that left."""

    start_tick: int  # first tick that they are for
    inputs: Array  # (steps, 4 owned), none for an agent that acted alone


@dataclass(frozen=True, kw_only=True)
class StateAt:
    """State at a tick, and what the shared control law says there: the same for all agents."""

    tick: int
    x: Array  # (n,)
    law: SharedLaw

    @cached_property
    def by_law(self) -> Array | None:
        """Inputs of all UAVs without corrections, (m,); None without a law."""
        return self.law.inputs(self.tick, self.x)


class AnnouncedInputs:
    """Plans of all agents as one agent knows them.

    Where a method takes a tick `before`, only plans made before it count, even if later ones have
    been received.

    Args:
        owned: 0-based UAVs of agent 1, agent 2, ...
        u_hover: Inputs assumed before an agent's first plan arrives, (4 N,).
        alignment: Alignment of the others' plans with the horizon.
        own: The agent itself, 1-based, whose plans are always aligned by age; 0 for none.
        law: Shared control law, followed after the first step of a plan; without inputs for none.
        settings: Bounds of the actuators, applied to inputs in force.

    The first four attributes describe the team; who owns this object changes them with the team, at
    the tick of the change and before `observe_news`.

    Attributes:
        off_roster: Agents that make no more plans.
        fail_safe: Control law after the last plan of one of them.
        law_since: Tick from which on the shared control law is that of the present team, (46).
        failed_since: Tick of the newest failure of a UAV, or `NEVER`. From then on every agent
            follows the control law of the UAVs that are left; earlier plans apply until then.
        news: How old the newest plans of the others usually are.
        oldest_news: Largest mean and largest overdue age at the tick last observed, not necessarily
            of one agent.
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
        self.off_roster: set[int] = set()
        self.fail_safe: FailSafe | None = None
        self.law_since = 0
        self.failed_since = NEVER
        self._owned = owned
        self._u_hover = u_hover
        self._alignment = alignment
        self._own = own
        self._law = SharedLaw() if law is None else law
        peers = [agent for agent in range(1, len(owned) + 1) if agent != own]
        self.news = News(peers, self._law.silence)
        self.oldest_news = NO_WAIT

        uavs = sum(map(len, owned))
        self._bounds: tuple[Array, Array] | None = None
        self._period_s: float | None = None
        if settings is not None:
            self._period_s = settings.sampling_period_s
            self._bounds = settings.lower(uavs), settings.upper(uavs)

        # By agent: its columns of u; its plans; and where the last plan of an agent that left has not
        # been received, the inputs assumed for it.
        self._columns = {agent: input_places(uavs) for agent, uavs in enumerate(owned, start=1)}
        self._plans = ReceivedPlans(self._columns)
        self._assumed: dict[int, Assumed] = {}

        # The first tick at which news were observed, and that at which an agent returned: from these
        # on its plans are expected.
        self._began: int | None = None
        self._returned: dict[int, int] = {}

    def add(self, plan: Plan) -> None:
        """Keep a plan, in any order of arrival; a second plan of the same tick is ignored."""
        self._plans.add(plan)

    def begin_anew(self, agent: int, tick: int) -> None:
        """Discard the plans of an agent that starts anew at a tick, and how old they were.

        Until then it was off the roster, and its UAVs on their fail-safe.
        """
        self._plans.forget(agent)
        self._assumed.pop(agent, None)
        self._returned[agent] = tick
        if agent != self._own:
            self.news.forget(agent)

    def assume(self, agent: int, start: int, inputs: Array) -> None:
        """Assume inputs of all UAVs, (N_p, 4 N), from a tick on for an agent that left.

        Source: docs/equations.md (32b).
        """
        columns = self._columns[agent]
        self._assumed[agent] = Assumed(start_tick=start, inputs=inputs[:, columns])

    def newest(self, agent: int, before: int, started: int | None = None) -> Plan | None:
        """Return an agent's newest plan made before a tick and, if given, started by `started`."""
        return self._plans.newest(agent, before, started)

    # As news of the others are overdue, (32c).

    @property
    def silence(self) -> Silence | None:
        """Rule by which agents act alone; None: they never do."""
        has_failures = self.failed_since != NEVER
        return self._law.silence_after_failures if has_failures else self._law.silence

    def observe_news(self, k: int) -> None:
        """Take in how old the newest plans of the others are: `news` and `oldest_news`.

        To be called once a tick, after its plans are added. Without a rule by which agents act alone
        nothing depends on ages, and none are taken.
        """
        if self.silence is None:
            return
        if self._began is None:
            self._began = k
        mean = 0.0
        overdue = 0.0
        for agent in self._columns:
            plan = self._plans.newest(agent, before=k)
            if plan is not None and agent != self._own:
                self.news.observe(agent, k - plan.tick)
            age = self._age(agent, plan, k)
            mean = max(mean, age.mean)
            overdue = max(overdue, age.overdue)
        self.oldest_news = NewsAge(mean=mean, overdue=overdue)

    def age(self, agent: int, tick: int, before: int) -> NewsAge:
        """Return how old another agent's news are at a tick, also for past ticks by those of now."""
        return self._age(agent, self._plans.newest(agent, before, started=tick), tick)

    def _age(self, agent: int, plan: Plan | None, tick: int) -> NewsAge:
        """Return how old an agent's news are at a tick, of which a plan, if any, is the newest."""
        if agent == self._own or agent in self.off_roster:
            return NO_WAIT
        # Without any plan, as if one had been made just before the first that can be expected.
        newest = self._expected_since(agent) - 1 if plan is None else plan.tick
        overdue = max(0.0, float(tick - newest - self.news.usual(agent)))
        return NewsAge(mean=self.news.mean(agent), overdue=overdue)

    def _expected_since(self, agent: int) -> int:
        """Return the tick from which on plans of an agent are expected."""
        return self._returned.get(agent, self._began or 0)

    def is_informed(self, tick: int, before: int) -> bool:
        """Return whether the inputs of all others at a tick are as well known as usual: (41)."""
        silence = self.silence
        if silence is None:
            return True
        ages = (self.age(agent, tick, before) for agent in self._columns)
        return max(age.overdue for age in ages) <= silence.uninformed

    def share_alone(self, agent: int, tick: int, before: int) -> float:
        """Return how much another agent is assumed to act alone: as its plan says, by the rule."""
        return self._share_alone(agent, self._plans.newest(agent, before, started=tick), tick)

    def _share_alone(self, agent: int, plan: Plan | None, tick: int) -> float:
        """Return how much an agent is assumed to act alone at a tick after a plan, if there is one."""
        silence = self.silence
        if silence is None:
            return 0.0
        said = 0.0 if plan is None else plan.alone
        return max(said, silence.alone(self._age(agent, plan, tick)))

    def lacks_first_news(self, before: int) -> bool:
        """Return whether the agent began in mid-run, and has not heard one of the others since.

        Of those that have returned later it has to hear nothing: they hear the team first.
        """
        if not self._began:
            return False
        present = self._columns.keys() - self.off_roster - self._returned.keys() - {self._own}
        return any(self._plans.newest(agent, before) is None for agent in present)

    def most_said(self, agents: Iterable[int], before: int) -> float:
        """Return the largest share of acting alone that the newest plans of some agents announce.

        0 without plans of agents on the roster. An agent that has just returned was alone as the team
        flew on without it, and is on its way back: it does not count.
        """
        most = 0.0
        for agent in agents:
            plan = self._plans.newest(agent, before)
            if plan is None or agent in self.off_roster or self._is_returning(agent, plan):
                continue
            most = max(most, plan.alone)
        return most

    def _is_returning(self, agent: int, plan: Plan) -> bool:
        """Return whether a plan is from the time in which a returned agent hands over to the team."""
        silence = self.silence
        returned = self._returned.get(agent)
        if silence is None or returned is None:
            return False
        return plan.tick < returned + silence.hand_over

    def silent(self, tick: int, before: int) -> Silent | None:
        """Return what is assumed of the others' inputs; None where all news are as usual."""
        if self.silence is None:
            return None
        share = np.zeros(len(self._u_hover))
        correlation = np.full(len(self._u_hover), SHARED)
        for agent, columns in self._columns.items():
            if agent != self._own:
                plan = self._plans.newest(agent, before, started=tick)
                share[columns] = self._share_alone(agent, plan, tick)
                correlation[columns] = self.silence.correlation(self._age(agent, plan, tick))
        if not share.any() and (correlation == SHARED).all():
            return None
        return Silent(alone=share, correlation=correlation)

    def _without_plan(self, agent: int, instant: StateAt | None) -> Array:
        """Return the inputs of an agent without any plan, (4 owned,).

        Hover; once its first plan is overdue, by the shared law, and alone. An agent that has
        returned was on its fail-safe before, and follows the law from then on. Source: (32c).
        """
        columns = self._columns[agent]
        hover = self._hover(columns)
        if instant is None:
            return hover
        if agent in self._returned:
            if self._is_before_return(agent, instant.tick):
                return self._by_fail_safe(agent, instant)
        elif not self._acts_without_plan(agent, instant.tick):
            return hover
        by_law = hover if instant.by_law is None else instant.by_law[columns]
        return self._mixed(by_law, agent, None, instant)

    def _acts_without_plan(self, agent: int, tick: int) -> bool:
        """Return whether an agent is assumed to act at a tick although it has sent no plan yet."""
        silence = self.silence
        if silence is None:
            return False
        return self._age(agent, None, tick).overdue > silence.overdue.begins

    def _is_before_return(self, agent: int, tick: int) -> bool:
        """Return whether an agent was off the roster at a tick, and has returned since."""
        return tick < self._returned.get(agent, 0)

    def _mixed(self, by_law: Array, agent: int, plan: Plan | None, instant: StateAt) -> Array:
        """Return inputs between those by the law and those alone, as the agent is assumed to act."""
        share = self._share_alone(agent, plan, instant.tick)
        if share == 0.0 or self._law.inputs_alone is None:
            return by_law
        alone = [
            self._law.inputs_alone(uav, instant.tick, instant.x) for uav in self._owned[agent - 1]
        ]
        return (1.0 - share) * by_law + share * np.concatenate(alone)

    # Over the horizon, (32).

    def sequence(self, start: int, steps: int, before: int) -> Array:
        """Return the announced inputs over the horizon: the newest plans, held at their ends.

        Of an agent off the roster: its last plan as far as the actuators play it, or what is assumed in
        its place, then hover.

        Returns: Inputs over N_p steps from tick `start` on, (N_p, 4 N).
        Source: docs/equations.md (32); paper, section IV-A.
        """
        U = np.empty((steps, len(self._u_hover)))
        for agent, columns in self._columns.items():
            plan = self._plans.newest(agent, before)
            assumed = self._assumed.get(agent)

            #   u_a(s + j) = U_a(min(s + j - s_a, N_p - 1))    (32)
            end = self._hover(columns)
            if assumed is not None:
                played = assumed.inputs[: self._steps_played(len(assumed.inputs))]
                entries = played[max(start - assumed.start_tick, 0) :][:steps]
            elif plan is not None and agent in self.off_roster:
                played = plan.inputs[: self._steps_played(len(plan.inputs))]
                entries = self._aligned(played, plan, start, steps)
            elif plan is not None:
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
            plan = self._plans.newest(agent, before)
            if plan is None or agent in self.off_roster or plan.tick < self.failed_since:
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
        skipped = max(start - plan.start_tick, 0)
        is_by_age = self._alignment == "by_age" or plan.agent == self._own
        if is_by_age or plan.agent in self.off_roster:
            return sequence[skipped:][:steps]
        if self._alignment == "held":
            return np.repeat(sequence[skipped:][:1], steps, axis=0)
        return sequence[min(skipped, 1) :][:steps]

    # Over a past or present period, (32a).

    def in_force(self, tick: int, before: int, x: Array | None = None) -> Array:
        """Return the inputs assumed over [t_k, t_{k+1}), from each agent's newest started plan.

        That plan's first input was applied as announced. Later ones have been replaced by plans
        that were not received: with a shared control law the agent followed that.

        The state x at t_k, (n,), serves to evaluate control law and fail-safe; None leaves both
        out.

        Returns: (4 N,).
        Source: docs/equations.md (32), (32a).
        """
        u = np.empty_like(self._u_hover)
        instant = None if x is None else StateAt(tick=tick, x=x, law=self._law)
        for agent, columns in self._columns.items():
            plan = self._plans.newest(agent, before, started=tick)
            if plan is None:
                u[columns] = self._without_plan(agent, instant)
            else:
                u[columns] = self._applied(plan, tick, instant)

        if self._bounds is None:
            return u
        lower, upper = self._bounds
        return np.minimum(np.maximum(u, lower), upper)

    def untold(self, tick: int, before: int) -> Untold:
        """Return which of the inputs of `in_force` no plan has told.

        Without a plan, and before the law became the present one, `in_force` has hover inputs or the
        announced ones: the agent followed the law of then, and counts as untold too. Off the roster
        without a plan its UAVs have hover inputs, as the plant knows.
        """
        m = len(self._u_hover)
        untold = Untold(by_law=np.zeros(m, dtype=bool), by_fail_safe=np.zeros(m, dtype=bool))
        for agent, columns in self._columns.items():
            plan = self._plans.newest(agent, before, started=tick)
            if agent in self.off_roster:
                untold.by_fail_safe[columns] = plan is not None and self._is_over(plan, tick)
            elif plan is None and self._is_before_return(agent, tick):
                untold.by_fail_safe[columns] = True
            elif agent != self._own:
                untold.by_law[columns] = plan is None or plan.start_tick < tick
        return untold

    def _applied(self, plan: Plan, tick: int, instant: StateAt | None) -> Array:
        """Return the inputs that an agent applied after its newest started plan, (4 owned,)."""
        played = self._played(plan, tick)
        step = tick - played.start_tick
        is_off = plan.agent in self.off_roster
        if is_off and self._is_over(plan, tick):
            return self._by_fail_safe(plan.agent, instant)

        #   u_a(k) = U_a(min(k - s_a, N_p - 1))    (32)
        announced: Array = played.inputs[min(step, len(played.inputs) - 1)]

        # Off the roster the last plan is played; own inputs and first ones are known.
        is_known = is_off or plan.agent == self._own or step <= 0
        if is_known or instant is None:
            return announced

        # The agent has replaced the later ones by plans not received: by the shared law, (32a). Which
        # law that was before the present one is not known any more: they count as announced.
        is_under_law = tick >= max(self.law_since, self.failed_since)
        by_law = self._by_law(plan, instant) if is_under_law else announced
        if by_law is None:
            return announced
        return self._mixed(by_law, plan.agent, plan, instant)

    def _played(self, plan: Plan, tick: int) -> Plan | Assumed:
        """Return the plan that the actuators play, or the inputs assumed in its place, (32b)."""
        assumed = self._assumed.get(plan.agent)
        if assumed is not None and tick >= assumed.start_tick:
            return assumed
        return plan

    def _is_over(self, plan: Plan, tick: int) -> bool:
        """Return whether the actuators have played all of a plan, or of what stands for it."""
        played = self._played(plan, tick)
        return tick - played.start_tick >= self._steps_played(len(played.inputs))

    def _steps_played(self, steps: int) -> int:
        """Return how many steps of the last plan of an agent that left its actuators play."""
        if self.fail_safe is None or self._period_s is None:
            return steps
        return self.fail_safe.played(steps, self._period_s)

    def _by_law(self, plan: Plan, instant: StateAt) -> Array | None:
        """Return an agent's inputs by the shared law after its plan's first step, (4 owned,).

        None where there is no such law. Source: docs/equations.md (32a).
        """
        columns = self._columns[plan.agent]
        u = instant.by_law
        if u is None:
            return None
        if plan.tick < self.failed_since or not len(plan.corrections):
            return np.asarray(u[columns])

        #   lambda_a(k) = K_a (x(k) - x_ref(k)) + c_ff(k) + C_a(k - s_a),    C_a zero after its end
        step = instant.tick - plan.start_tick
        by_law: Array = u[columns]
        if step < len(plan.corrections):
            by_law = by_law + plan.corrections[step]
        if plan.tick < self.law_since:
            return by_law  # (46)

        # Differences in the sender's knowledge, such as external forces, show at the first step.
        #   u_a(k) = U_a(0) + lambda_a(k) - lambda_a(s_a)
        # Known: while an agent returns from acting alone, U_a(0) contains its share alone, which
        # `_mixed` adds again. Left so, as the payload's error in such flights does not change.
        start_state = self._law.start_state(plan.start_tick)
        if start_state is None:
            return by_law
        u_start = self._law.inputs(plan.start_tick, start_state)
        if u_start is None:
            return by_law
        first_step = plan.inputs[0] - u_start[columns] - plan.corrections[0]
        return np.asarray(by_law + first_step)

    def _by_fail_safe(self, agent: int, instant: StateAt | None) -> Array:
        """Return an agent's inputs by the fail-safe, (4 owned,); hover without a state."""
        if instant is None or self.fail_safe is None:
            return self._hover(self._columns[agent])
        # What its integral holds and what pushes it are one to every sensor: neither is assumed.
        inputs = [
            self.fail_safe.inputs(uav, instant.x, instant.tick) for uav in self._owned[agent - 1]
        ]
        return np.concatenate(inputs)
