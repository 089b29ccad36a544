"""The coordinator's part of the team's radio: what it sends of it, and when."""

from collections import defaultdict
from collections.abc import Collection
from collections.abc import Set as AbstractSet

from transport.coordinator.team_view import Radio
from transport.model.arrays import Array
from transport.protocol.wire.messages import Airtime, Plan, PlantState
from transport.protocol.wire.outbox import Outbox

_STATES_KEPT = 3


class TeamAir:
    """Reports of the radio, once for each exchange of a negotiation and once for each tick.

    The plans of tick k are on the air from t_k on. Positions are those of the plant's state that
    has certainly been received: of tick k - 1 when tick k + 1 is opened, and one tick older in the
    exchanges before.
    """

    def __init__(self, radio: Radio, out: Outbox, *, initial_state: Array, exchanges: int) -> None:
        self._radio = radio
        self._out = out
        self._exchanges = exchanges  # of a tick
        self._plans: list[Plan] = []  # not yet on the air
        self._states: dict[int, Array] = {-1: initial_state}  # of the plant, by tick
        self._proposed: defaultdict[int, set[int]] = defaultdict(set)  # agents, by `negotiation`
        self._following = self._exchanges - 1  # exchanges after the one that goes on

    def plant_state(self, plant_state: PlantState) -> None:
        """Take in a state of the plant."""
        self._states[plant_state.tick] = plant_state.x
        self._states.pop(plant_state.tick - _STATES_KEPT, None)

    def send(self, plan: Plan) -> None:
        """Take in a plan or a proposal of the open tick."""
        self._plans.append(plan)
        if plan.negotiation > 0:
            self._proposed[plan.negotiation].add(plan.agent)

    def exchanged(self, tick: int, members: AbstractSet[int]) -> list[Airtime]:
        """Return the reports of the exchanges for which all proposals are here."""
        reports = []
        while self._following > 0 and members <= self._proposed[self._following]:
            x = self._state(tick - 2)
            self._put_on_air(members)
            fields = self._radio.advance(tick, x, negotiation=self._following)
            reports.append(self._out.stamp(Airtime, **fields))
            self._following -= 1
        return reports

    def may_open(self, tick: int) -> bool:
        """Return whether the state is here whose positions the opening of a tick needs."""
        return tick < 2 or tick - 2 in self._states

    def opened(self, tick: int, members: Collection[int]) -> list[Airtime]:
        """Return the reports until a tick that opens; none before the first.

        `members` took part in the tick before.
        """
        self._proposed.clear()
        self._following = self._exchanges - 1
        if tick == 0:
            return []
        self._put_on_air(members)
        fields = self._radio.advance(tick, self._state(tick - 2))
        return [self._out.stamp(Airtime, **fields)]

    def _put_on_air(self, members: Collection[int]) -> None:
        """Send the plans taken in, for the agents that are on the roster when all plans are here.

        Which of them had come before an agent was lost depends on the host.
        """
        plans = sorted(self._plans, key=_by_agent)
        self._radio.fit_slots(plans)
        for plan in plans:
            self._radio.send(plan, members)
        self._plans.clear()

    def _state(self, tick: int) -> Array:
        """Return the state of a tick; before the first, the initial one."""
        return self._states[max(tick, -1)]


def _by_agent(plan: Plan) -> tuple[int, int]:
    return plan.agent, -plan.negotiation
