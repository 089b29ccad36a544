"""The coordinator as a state machine.

It opens tick k + 1 when all agents have answered tick k, or at its deadline.

`coordinator.clock` has the difference between lockstep and real time. Agents that are gone or do
not answer are taken off the roster; those that return with a higher incarnation are put on it again
when a tick is opened.
"""

from collections.abc import Collection, Sequence
from enum import Enum

from transport.coordinator.air import TeamAir
from transport.coordinator.clock import Clock
from transport.coordinator.failed_steps import FailedSteps
from transport.coordinator.fleet import Fleet
from transport.coordinator.requests import RunStatus, answer_request
from transport.coordinator.roster import TeamRoster, names
from transport.protocol.admission.plausibility import check_tick
from transport.protocol.scenario.contacts import Contacts
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.errors import MessageError
from transport.protocol.wire.exit_codes import (
    EXIT_COLLIDED,
    EXIT_DIVERGED,
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OVERRUN,
    EXIT_UNREACHABLE,
)
from transport.protocol.wire.messages import (
    MAX_TEXT,
    Control,
    Event,
    Message,
    Plan,
    PlantState,
    Presence,
    Request,
    Tick,
    VehicleStatus,
)
from transport.protocol.wire.names import COORDINATOR, PLANT, vehicle_name
from transport.protocol.wire.node import Outbox

# Outcomes of runs that are not aborted, by exit code; a run with another code was aborted.
_OUTCOMES = {
    0: "completed",
    EXIT_DIVERGED: "diverged",
    EXIT_FAILED: "failed",
    EXIT_COLLIDED: "collided",
}


class State(Enum):
    """State of a run.

    WAITING ends with the last process that is ready, PREPARING, in a run with vehicles, at the instant
    of tick 0, which is told when all are ready. HELD ends with the last agent that returns or at
    the end of its time. ENDING follows a state of the plant from OPEN and HELD. STOPPED is the end.
    """

    WAITING = "the processes are joining"
    PREPARING = "the vehicles prepare, or tick 0 has been told"
    OPEN = "a tick is open"
    HELD = "the next tick waits for agents that the scenario's faults bring back"
    ENDING = (
        "the plant has diverged, or two UAVs have collided; the run ends when the next tick is open"
    )
    STOPPED = "the run has ended"


class CoordinatorNode:
    """Sampling clock and roster of one run.

    The observers, such as "recorder", must be ready before the first tick, like the plant and the
    agents.

    Attributes:
        state: State of the run.
        tick: The open tick, -1 before the first.
        finished: The message that ends the run, once it has ended.
        publish_ns: Time that its process has spent publishing, 0: only plans report it.
    """

    name = COORDINATOR
    publish_ns = 0

    def __init__(
        self,
        setup: Setup,
        incarnation: int = 0,
        observers: Sequence[str] = (),
        wall_offset_ns: int = 0,
    ) -> None:
        self.state = State.WAITING
        self.tick = -1
        self.incarnation = incarnation
        self.finished: Control | None = None

        self._setup = setup
        self._ticks = setup.ticks
        self._out = Outbox(self.name, incarnation)
        self._clock = Clock(setup)
        self._roster = TeamRoster(setup, self._out)
        # Processes that the first tick waits for.
        self._has_plant = setup.scenario.has_plant
        vehicles: set[str] = set()
        self._fleet: Fleet | None = None
        if setup.scenario.has_vehicles:
            vehicles = {vehicle_name(uav + 1) for uav in range(setup.system.N)}
            self._fleet = Fleet(setup, self._out, wall_offset_ns)
        self._vehicles = vehicles
        plant = {PLANT} if self._has_plant else set()
        self._not_ready = {*plant, *self._roster.agents, *vehicles, *observers}
        self._observers = set(observers)  # that have not left

        # Agents that answered the open tick, and whether with a plan that the others received.
        self._answered: dict[int, bool] = {}
        self._early: dict[int, Plan] = {}  # plans of ticks to come, by agent
        # Negotiation iterations left in the open tick, by agent.
        self._negotiating: dict[int, int] = {}
        self._plant_tick = -1  # newest tick the plant has recorded
        radio = setup.scenario.radio
        self._air = None if radio is None else TeamAir(setup, radio, self._out)
        self._divergence = ""  # why the run has diverged
        self._contacts = Contacts(setup)
        self._failed_steps = FailedSteps(setup.scenario.agents.failed_share)

    @property
    def wake_ns(self) -> int | None:
        """Time of the next poll, ns: end of a timeout, or opening of the next tick; None without."""
        if self.state in (State.WAITING, State.STOPPED):
            return None
        if self.state is State.PREPARING and self._fleet is not None:
            is_decided = self._fleet.start_ns > 0
            return self._fleet.steady_start_ns if is_decided else self._fleet.next_ns
        if self.state is State.HELD:
            return self._clock.hold_ends_ns
        if self._lacks_state or self._clock.waits_for(self._missing):
            return self._clock.expires_ns
        return self._clock.due_ns(self.tick + 1)

    def receive(self, event: Event, now_ns: int) -> Sequence[Message]:
        """Take in presences, plans, plant states, and requests."""
        if self.state is State.STOPPED:
            return ()
        self._clock.excuse_absence(self.tick, self.wake_ns, now_ns)
        match event:
            case Request():
                return answer_request(event, self._status(), self._roster)
            case Presence():
                return self._presence_changed(event, now_ns)
            case PlantState():
                self._note_plant(event, now_ns)
            case Plan():
                self._note_plan(event, now_ns)
            case VehicleStatus() if self._fleet is not None:
                self._fleet.take(event, now_ns)
        return self._advance(now_ns)

    def poll(self, now_ns: int) -> Sequence[Message]:
        """Open a tick that is due; take agents that missed the barrier timeout off the roster."""
        if self.state in (State.WAITING, State.STOPPED):
            return ()
        self._clock.excuse_absence(self.tick, self.wake_ns, now_ns)
        if self.state is State.PREPARING and self._fleet is not None:
            return self._prepare(self._fleet, now_ns)

        if self.state is State.HELD:
            if now_ns < self._clock.hold_ends_ns:
                return ()
            # Without the agents given up the tick is not held again.
            gave_up = self._roster.give_up(self.tick + 1)
            opened = self._advance(now_ns)
            return [gave_up, *opened]

        expired = now_ns >= self._clock.expires_ns
        if expired and self.state is State.ENDING:
            return self._end()
        if self._has_plant and self._clock.plant_is_silent(now_ns):
            reason = f"plant has not answered since tick {self._plant_tick}"
            return self._stop(EXIT_UNREACHABLE, reason)

        silent = self._clock.silent(self._roster.members, self._missing, now_ns)
        if silent:
            return self._drop_silent(silent, now_ns)
        if expired and self._lacks_state:
            reason = f"plant did not answer tick {self._plant_tick + 1} in time"
            return self._stop(EXIT_UNREACHABLE, reason)
        return self._advance(now_ns)

    def interrupt(self, reason: str) -> Sequence[Message]:
        """End the run because of a signal."""
        return self._stop(EXIT_INTERRUPTED, reason)

    @property
    def _is_last(self) -> bool:
        return self.tick + 1 == self._ticks

    @property
    def _lacks_state(self) -> bool:
        """Whether the plant's state is missing without which the open tick cannot be closed.

        The last one completes the record; on a radio, positions one tick old say who hears whom.
        """
        if self._is_last:
            return self._has_plant and self._plant_tick < self.tick
        return self._air is not None and not self._air.may_open(self.tick + 1)

    @property
    def _missing(self) -> set[int]:
        """Agents on the roster that have not answered the open tick."""
        return self._roster.members - self._answered.keys()

    def check_moment(self, message: Message) -> None:
        """Raise MessageError for answers to another tick, and plans of agents off the roster."""
        match message:
            case PlantState():
                last = self.tick if self._fleet is None else self._ticks - 1
                check_tick(message, self._plant_tick + 1, last)
            case Plan():
                is_member = message.agent in self._roster.members
                newest = self._roster.incarnations.get(message.sender)
                if not is_member or message.incarnation != newest:
                    text = "plan of an incarnation that is not on the roster"
                    raise MessageError("wrong_incarnation", text)
                first = 0 if self._clock.is_realtime else self.tick
                # Agents of vehicles may open a tick before this process does.
                last = self.tick if self._fleet is None else self._ticks - 1
                check_tick(message, first, last)

    def _note_plant(self, plant_state: PlantState, now_ns: int) -> None:
        """Note what the plant has recorded, and whether it has diverged."""
        self._plant_tick = plant_state.tick
        self._clock.plant_ns = now_ns
        if self._air is not None:
            self._air.plant_state(plant_state)
        if plant_state.diverged and not self._divergence:
            time = self._roster.time(plant_state.tick)
            self._divergence = f"{plant_state.diverged} at {time}"
            self.state = State.ENDING
        if self._contacts.add(plant_state) and self._setup.scenario.plant.on_collision == "end":
            self.state = State.ENDING

    def _note_plan(self, plan: Plan, now_ns: int) -> None:
        """Note an answer to a tick, or a proposal of a negotiation."""
        if plan.negotiation > 0:
            self._negotiating[plan.agent] = plan.negotiation
            if self._air is not None:
                self._air.send(plan)
            return
        if plan.tick > self.tick:
            self._early[plan.agent] = plan
            return
        self._failed_steps.count(plan)
        if plan.tick == self.tick:
            self._answered[plan.agent] = plan.shared
            if self._air is not None:  # in lockstep only: no plan is late
                self._air.send(plan)
        self._clock.answer(plan, self.tick, now_ns)

    def _presence_changed(self, event: Presence, now_ns: int) -> Sequence[Message]:
        """Handle a process that is ready, has returned, or is gone."""
        if not event.alive:
            return self._process_gone(event, now_ns)
        if self.state is State.WAITING:
            return self._process_ready(event, now_ns)
        return self._agent_returned(event, now_ns)

    def _process_ready(self, event: Presence, now_ns: int) -> Sequence[Message]:
        """Note that a process is ready; open the first tick when all are."""
        takes_part = event.name in (PLANT, *self._roster.agents, *self._vehicles)
        if not takes_part and event.name not in self._not_ready:
            return ()
        self._not_ready.discard(event.name)

        before = self._roster.incarnations.get(event.name, -1)
        self._roster.incarnations[event.name] = max(event.incarnation, before)
        if self._not_ready:
            return ()
        if self._fleet is not None:
            self.state = State.PREPARING
            return self._prepare(self._fleet, now_ns)
        return [self._roster.message("all processes are ready", 0), *self._open(now_ns)]

    def _prepare(self, fleet: Fleet, now_ns: int) -> Sequence[Message]:
        """Speak to the vehicles until all are ready; open the first tick at its instant."""
        if fleet.start_ns:
            if now_ns < fleet.steady_start_ns:
                return ()
            return self._open(now_ns)
        if fleet.followed_ns:
            return self._take_over(fleet, now_ns)
        if fleet.is_over(now_ns):
            reason = f"the vehicles are not ready: {fleet.problem()}"
            return self._stop(EXIT_UNREACHABLE, reason)
        word = fleet.speak(now_ns)
        if not fleet.start_ns or word is None:
            return () if word is None else [word]
        self._clock.begin(fleet.steady_start_ns)
        return [self._roster.message("all vehicles are ready", 0), word]

    def _take_over(self, fleet: Fleet, now_ns: int) -> Sequence[Message]:
        """Take over a team that flies without a coordinator, from the newest tick on.

        Its ticks go on at their instants; the roster has all agents, in a newer version than any
        vehicle has. Links and targets that an earlier coordinator has changed stay as they are.
        """
        fleet.start_ns = fleet.followed_ns
        self._clock.begin(fleet.steady_start_ns)
        newest = self._clock.newest(now_ns)
        self.tick = min(newest, self._ticks - 1) - 1
        self._plant_tick = max(self._plant_tick, self.tick - 1)
        self._clock.plant_ns = now_ns
        self._roster.version = fleet.roster
        reason = f"the coordinator has returned at {self._roster.time(max(self.tick, 0))}"
        return [self._roster.message(reason, self.tick), fleet.word(now_ns), *self._open(now_ns)]

    def _agent_returned(self, event: Presence, now_ns: int) -> Sequence[Message]:
        """Let a new incarnation of an agent join at the next tick; tell a vehicle all so far."""
        agent = self._roster.agents.get(event.name)
        if agent is None and event.name in self._vehicles and self._fleet is not None:
            self._roster.incarnations[event.name] = event.incarnation
            reason = f"{event.name} returned at {self._roster.time(max(self.tick, 0))}"
            return [
                *self._roster.repeated(),
                self._roster.message(reason, self.tick),
                self._fleet.word(now_ns),
            ]
        if agent is None:
            return ()
        known = self._roster.incarnations.get(event.name, -1)
        newest = max(known, self._roster.joining.get(agent, -1))
        if event.incarnation <= newest:
            return ()
        self._roster.joining[agent] = event.incarnation

        # It may return before its end was noticed: the old incarnation is gone all the same.
        lost = self._lose_member(agent, event.name, now_ns)
        if self.state is State.STOPPED:
            return lost
        return [*lost, *self._advance(now_ns)]

    def _process_gone(self, event: Presence, now_ns: int) -> Sequence[Message]:
        """Handle the end of a process: take it off the roster, or end the run."""
        agent = self._roster.agents.get(event.name)
        if agent is not None and self._roster.joining.get(agent) == event.incarnation:
            del self._roster.joining[agent]
        if event.incarnation != self._roster.incarnations.get(event.name):
            return ()

        self._observers.discard(event.name)
        if event.name == PLANT:
            return self._stop(EXIT_UNREACHABLE, "plant is gone")
        if event.name in self._vehicles:
            return self._vehicle_gone(event.name)
        return self._lose_member(agent, event.name, now_ns)

    def _vehicle_gone(self, name: str) -> Sequence[Message]:
        """Report a vehicle that is gone, or end the run by `clock.on_agent_loss`."""
        reason = f"{name} is gone at {self._roster.time(max(self.tick, 0))}"
        is_early = self.state in (State.WAITING, State.PREPARING)
        if self._setup.scenario.clock.on_agent_loss == "abort" or is_early:
            return self._stop(EXIT_UNREACHABLE, reason)
        return [self._roster.message(reason, self.tick)]

    def _status(self) -> RunStatus:
        """Return the progress of the run, for requests."""
        return RunStatus(
            tick=self.tick,
            ticks=self._ticks,
            members=sorted(self._roster.members),
            observers=sorted(self._observers),
            takes_changes=self.state not in (State.WAITING, State.PREPARING) and not self._is_last,
            period_ns=self._setup.period_ns,
        )

    def _drop_silent(self, silent: set[int], now_ns: int) -> Sequence[Message]:
        """Take agents that have not answered in time off the roster."""
        # An agent that is behind in a negotiation blocks the others: drop it alone and restart
        # their timeout, which is that of lockstep (real time takes no negotiation).
        iterations = self._setup.scenario.controller.negotiation_iterations
        iterations_left = {agent: self._negotiating.get(agent, iterations) for agent in silent}
        most_left = max(iterations_left.values())
        hindmost = {agent for agent in silent if iterations_left[agent] == most_left}
        if hindmost != silent:
            silent = hindmost
            self._clock.waiting_since_ns = now_ns

        members = self._roster.members
        if len(silent) > 1 and silent == members and members.isdisjoint(self._answered):
            # All at once: more likely the plant, on which all depend.
            reason = f"no agent answered tick {self.tick} in time: is the plant alive?"
            return self._stop(EXIT_UNREACHABLE, reason)
        reason = f"{names(silent)} did not answer tick {self.tick} in time"
        return self._lose(silent, reason, now_ns)

    def _lose_member(self, agent: int | None, name: str, now_ns: int) -> Sequence[Message]:
        """Take an agent whose process is gone off the roster, if it is on it."""
        if agent is None or agent not in self._roster.members:
            return ()
        return self._lose([agent], f"{name} is gone", now_ns)

    def _lose(self, agents: Collection[int], reason: str, now_ns: int) -> Sequence[Message]:
        """Take agents off the roster, and continue or end the run by `clock.on_agent_loss`.

        Before the first tick the run ends.
        """
        reason = f"{reason} at {self._roster.time(max(self.tick, 0))}"
        is_early = self.state in (State.WAITING, State.PREPARING)
        if self._setup.scenario.clock.on_agent_loss == "abort" or is_early:
            return self._stop(EXIT_UNREACHABLE, reason)

        self._roster.members.difference_update(agents)
        if not self._roster.members:
            return self._stop(EXIT_UNREACHABLE, f"{reason}; no agent is left")
        return [self._roster.message(reason, self.tick), *self._advance(now_ns)]

    def _advance(self, now_ns: int) -> Sequence[Message]:
        """End an exchange whose proposals are all here, and the open tick if it may be closed."""
        if self._air is None or self.state is State.WAITING:
            return self._close(now_ns)
        return [*self._air.exchanged(self.tick, self._roster.members), *self._close(now_ns)]

    def _close(self, now_ns: int) -> Sequence[Message]:
        """Close the open tick if it may be closed: open the next one, or end the run."""
        if self.state in (State.WAITING, State.PREPARING):
            return ()
        is_ending = self.state is State.ENDING
        if is_ending and self.tick > self._plant_tick:
            # The plant reports a divergence or a contact at tick p. The run ends once tick p + 1 is open,
            # whether its answer or those of the agents came first: the record is the same.
            return self._end()

        may_close = self._clock.may_close(self.tick, self._missing, now_ns, last=self._is_last)
        if not may_close or self._lacks_state:
            return ()
        if not is_ending and not self._is_last and self._roster.due_back(self.tick + 1):
            self._hold(now_ns)
            return ()

        too_late = self._clock.judge_overruns(self.tick, self._missing, now_ns)
        if too_late:
            return self._stop(EXIT_OVERRUN, too_late)
        if self._is_last:
            return self._end()
        opened = self._open(now_ns)
        if not is_ending:
            return opened
        # Tick p + 1 is open now: the run ends.
        return [*opened, *self._advance(now_ns)]

    def _hold(self, now_ns: int) -> None:
        """Wait for the agents that scripted faults bring back at the next tick."""
        if self.state is not State.HELD:
            self.state = State.HELD
            self._clock.waiting_since_ns = now_ns

    def _open(self, now_ns: int) -> list[Message]:
        """Open the next tick, also for agents that have returned.

        Returns: All that changes at the tick, then the tick itself.
        """
        tick = self.tick + 1
        joined, changes = self._roster.begin(tick)
        air = [] if self._air is None else self._air.opened(tick, self._roster.members - joined)
        # Before the resets below: it tells who answered the tick before, and how late.
        opened = self._tick_message(tick, now_ns)

        self.tick = tick
        if self.state is not State.ENDING:
            self.state = State.OPEN
        self._answered = {}
        self._negotiating = {}
        self._clock.open(tick, self._roster.members, joined, now_ns)
        early = [plan for plan in self._early.values() if plan.tick <= tick]
        for plan in early:
            del self._early[plan.agent]
            self._note_plan(plan, now_ns)
        if self._plant_tick + 1 == tick:
            self._clock.plant_ns = now_ns  # it owes no earlier interval
        return [*changes, *air, opened]

    def _tick_message(self, tick: int, now_ns: int) -> Tick:
        """Return the message that opens a tick: roster in force, answers to the tick before.

        In lockstep its bundle carries these plans (`protocol.network.exchange`).
        """
        late_ns, overrun_ns = self._clock.lateness_ns(tick, now_ns)
        shared = (agent for agent, is_shared in self._answered.items() if is_shared)
        return self._out.stamp(
            Tick,
            tick=tick,
            members=tuple(sorted(self._roster.members)),
            answered=tuple(sorted(self._answered)),
            shared=tuple(sorted(shared)),
            roster=self._roster.version,
            late_ns=late_ns,
            overrun_ns=overrun_ns,
        )

    def _end(self) -> Sequence[Message]:
        """End the run by the plant's states or at its last tick: collided, diverged, failed or completed."""
        failure = "" if self._divergence else self._failed_steps.verdict()
        contact = self._contacts.first
        if contact is not None:
            # What came after the contact would not have happened so.
            collision = f"{contact.text} at t = {contact.at_s:.2f} s"
            reasons = [collision, self._divergence, failure]
            return self._stop(EXIT_COLLIDED, "; ".join(filter(None, reasons))[:MAX_TEXT])
        if self._divergence:
            return self._stop(EXIT_DIVERGED, self._divergence)
        return self._stop(EXIT_FAILED if failure else 0, failure)

    def _stop(self, exit_code: int, reason: str) -> Sequence[Message]:
        """End the run; only the first end counts."""
        if self.state is State.STOPPED:
            return ()
        self.state = State.STOPPED
        self.finished = self._out.stamp(
            Control,
            tick=max(self.tick, 0),
            outcome=_OUTCOMES.get(exit_code, "aborted"),
            reason=reason,
            exit_code=exit_code,
        )
        return [self.finished]
