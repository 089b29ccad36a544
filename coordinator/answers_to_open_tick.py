"""The open tick: what has been answered to it, by the agents and by the plant."""

from collections.abc import Collection
from collections.abc import Set as AbstractSet

from transport.coordinator.radio import TeamAir
from transport.coordinator.when_ticks_open_and_close import Clock
from transport.protocol.admission.plausibility import check_tick
from transport.protocol.scenario.setup.run_rules import RunRules
from transport.protocol.wire.messages import Plan, PlantState


class OpenTick:
    """The open tick, and the answers to it.

    Plans are answers to the open tick. The plant's state of tick k closes the interval from k on, so
    that it is of the open tick or of an earlier one. Agents that have clocks of their own (vehicles)
    may answer a tick before it is opened here: such plans are kept until then.

    Attributes:
        number: The open tick, -1 before the first.
        plant: Newest tick of which the plant's state is here, -1 before the first.
        answered: Agents that have answered, and whether with a plan that the others received.
    """

    def __init__(self, rules: RunRules, clock: Clock, air: TeamAir | None) -> None:
        self._rules = rules
        self._ticks = rules.ticks
        self._clock = clock
        self._air = air

        self.number = -1
        self.plant = -1
        self.answered: dict[int, bool] = {}
        self._early: dict[int, Plan] = {}  # plans of ticks to come, by agent
        self._negotiating: dict[int, int] = {}  # iterations remaining, by agent

    @property
    def is_last(self) -> bool:
        """Whether no tick follows."""
        return self.number + 1 == self._ticks

    @property
    def lacks_state(self) -> bool:
        """Whether the plant's state is missing without which the tick cannot be closed.

        The last one completes the record; on a radio, positions one tick old say who hears whom.
        """
        if self.number + 1 == self._ticks:
            return self._rules.has_plant and self.plant < self.number
        return self._air is not None and not self._air.may_open(self.number + 1)

    def missing(self, members: AbstractSet[int]) -> AbstractSet[int]:
        """Return the agents on the roster that have not answered."""
        return members - self.answered.keys()

    def may_close(self, members: AbstractSet[int], now_ns: int) -> bool:
        """Return whether all is here that the tick waits for, and the next one is due."""
        missing = self.missing(members)
        is_last = self.number + 1 == self._ticks
        is_due = self._clock.is_time_to_close(self.number, missing, now_ns, last=is_last)
        return is_due and not self.lacks_state

    def wake_ns(self, members: AbstractSet[int]) -> int:
        """Return when a timeout ends, or the next tick may open."""
        if self.lacks_state or self._clock.waits_for(self.missing(members)):
            return self._clock.expires_ns
        return self._clock.due_ns(self.number + 1)

    def open(self, number: int, now_ns: int) -> list[Plan]:
        """Open a tick that has no answer yet; return the plans that were kept for it."""
        self.number = number
        self.answered = {}
        self._negotiating = {}
        if self.plant + 1 == number:
            self._clock.note_plant(now_ns)  # it owes no earlier interval
        due = [plan for plan in self._early.values() if plan.tick <= number]
        for plan in due:
            del self._early[plan.agent]
        return due

    def resume(self, newest: int, now_ns: int) -> None:
        """Go on from the newest tick that is due, in a run of an earlier coordinator."""
        self.number = min(newest, self._ticks - 1) - 1
        self.plant = max(self.plant, self.number - 1)
        self._clock.note_plant(now_ns)

    def check(self, message: Plan | PlantState) -> None:
        """Raise MessageError for an answer to a tick that it cannot be of."""
        # Agents of vehicles may open a tick before this process does.
        last = self._ticks - 1 if self._rules.has_vehicles else self.number
        if isinstance(message, PlantState):
            check_tick(message, self.plant + 1, last)
        else:
            check_tick(message, 0 if self._clock.is_realtime else self.number, last)

    def take_plant_state(self, plant_state: PlantState, now_ns: int) -> None:
        """Note what the plant has recorded."""
        self.plant = plant_state.tick
        self._clock.note_plant(now_ns)
        if self._air is not None:
            self._air.plant_state(plant_state)

    def take_plan(self, plan: Plan, now_ns: int) -> bool:
        """Note a plan; return whether it is an agent's last one of this or an earlier tick."""
        if plan.negotiation > 0:
            self._negotiating[plan.agent] = plan.negotiation
            if self._air is not None:
                self._air.send(plan)
            return False
        if plan.tick > self.number:
            self._early[plan.agent] = plan
            return False
        if plan.tick == self.number:
            self.answered[plan.agent] = plan.shared
            if self._air is not None:  # in lockstep only: no plan is late
                self._air.send(plan)
        self._clock.answer(plan, self.number, now_ns)
        return True

    def hindmost(self, agents: Collection[int]) -> set[int]:
        """Return those of some agents that are furthest behind in their negotiation.

        An agent without a proposal has all iterations remaining.
        """
        all_remaining = self._rules.shape.negotiation_iterations
        remaining = {agent: self._negotiating.get(agent, all_remaining) for agent in agents}
        most_remaining = max(remaining.values())
        return {agent for agent in agents if remaining[agent] == most_remaining}
