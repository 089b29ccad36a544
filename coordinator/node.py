"""The coordinator as a state machine.

It opens tick k + 1 when all agents have answered tick k, or at its deadline.

`coordinator.state_machine` has its states and what moves it from one to another,
`coordinator.when_ticks_open_and_close` the difference between lockstep and real time, `coordinator.roster`
how agents leave and join. This file says what is sent in each state.
"""

from collections.abc import Collection, Sequence
from collections.abc import Set as AbstractSet

from transport.coordinator.answers_to_open_tick import OpenTick
from transport.coordinator.coming_down import ComingDown
from transport.coordinator.fleet import Fleet
from transport.coordinator.link_and_target_changes import Changes
from transport.coordinator.operator_requests import RunStatus, answer_request
from transport.coordinator.outcome import Verdict
from transport.coordinator.processes_and_observers import Processes
from transport.coordinator.radio import TeamAir
from transport.coordinator.roster import TeamRoster
from transport.coordinator.state_machine import BEFORE_TICK_0, Cause, Machine, State
from transport.coordinator.team_view import TeamView
from transport.coordinator.when_ticks_open_and_close import Clock
from transport.protocol.scenario.setup.run_rules import RunRules
from transport.protocol.wire.errors_and_exit_codes import (
    EXIT_COLLIDED,
    EXIT_DIVERGED,
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OVERRUN,
    EXIT_UNREACHABLE,
    MessageError,
)
from transport.protocol.wire.messages import (
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
from transport.protocol.wire.names import COORDINATOR, PLANT, agent_names, vehicle_name
from transport.protocol.wire.outbox import Outbox

# Outcomes of runs that are not aborted, by exit code; a run with another code was aborted.
_OUTCOMES = {
    0: "completed",
    EXIT_DIVERGED: "diverged",
    EXIT_FAILED: "failed",
    EXIT_COLLIDED: "collided",
}


class CoordinatorNode:
    """Sampling clock and roster of one run.

    The observers, such as "recorder", must be ready before the first tick, like the plant and the
    agents.

    Attributes:
        finished: The message that ends the run, once it has ended.
        publish_ns: Time that its process has spent publishing, 0: only plans report it.
    """

    name = COORDINATOR
    publish_ns = 0

    def __init__(
        self,
        rules: RunRules,
        team: TeamView,
        incarnation: int = 0,
        observers: Sequence[str] = (),
        wall_offset_ns: int = 0,
    ) -> None:
        self.incarnation = incarnation
        self.finished: Control | None = None

        self._rules = rules
        self._ends_by_loss = rules.clock.on_agent_loss == "abort"

        self._out = Outbox(self.name, incarnation)
        self._machine = Machine()
        self._clock = Clock(rules.clock, rules.period_ns)
        self._roster = TeamRoster(rules, self._out)
        self._changes = Changes(
            self._roster, self._out, team.targets, team.scripted_targets, team.lands_at
        )
        self._verdict = Verdict(
            team.contacts, team.failed_share, ends_by_contact=team.ends_by_contact
        )
        self._air = self._air_of(team)
        self._open = OpenTick(rules, self._clock, self._air)
        self._fleet: Fleet | None = None
        self._coming_down: ComingDown | None = None
        vehicles = self._set_vehicles(team, wall_offset_ns)
        agents = self._roster.agents.keys()
        self._processes = Processes(agents, vehicles, observers, has_plant=rules.has_plant)

    def _air_of(self, team: TeamView) -> TeamAir | None:
        """Return the radio of the team; None where messages take simulated links."""
        if team.radio is None:
            return None
        exchanges = self._rules.shape.negotiation_iterations
        return TeamAir(team.radio, self._out, initial_state=team.initial_state, exchanges=exchanges)

    def _set_vehicles(self, team: TeamView, wall_offset_ns: int) -> set[str]:
        """Set what a run needs whose UAVs have processes of their own; return their names."""
        vehicles = team.vehicles
        if vehicles is None or team.places_I is None:
            return set()
        self._fleet = Fleet(vehicles, team.places_I, self._out, wall_offset_ns, self._changes.told)
        self._coming_down = ComingDown(
            self._changes, self._roster, vehicles.battery_land, self._rules.period_s, team.lands_at
        )
        return {vehicle_name(uav + 1) for uav in range(self._rules.uavs)}

    @property
    def state(self) -> State:
        """State of the run."""
        return self._machine.state

    @property
    def tick(self) -> int:
        """The open tick, -1 before the first."""
        return self._open.number

    # -- Time and events in ----------------------------------------------------------------------

    @property
    def wake_ns(self) -> int | None:
        """Time of the next poll, ns: end of a timeout, or opening of the next tick; None without."""
        match self._machine.state:
            case State.WAITING | State.STOPPED:
                return None
            case State.PREPARING if self._fleet is not None:
                return self._fleet.next_ns
            case State.STARTING if self._fleet is not None:
                return self._fleet.steady_start_ns
            case State.HELD:
                return self._clock.hold_ends_ns
        return self._open.wake_ns(self._roster.members)

    def receive(self, event: Event, now_ns: int) -> Sequence[Message]:
        """Take in presences, plans, plant states, and requests."""
        if self._machine.state is State.STOPPED:
            return ()
        self._clock.excuse_absence(self._open.number, self.wake_ns, now_ns)
        match event:  # what comes most is first
            case Plan():
                self._take_plan(event, now_ns)
            case PlantState() if self._fleet is not None and self._machine.state in BEFORE_TICK_0:
                return ()  # of a run that this process has not joined yet; the end is told again
            case PlantState():
                self._open.take_plant_state(event, now_ns)
                if self._verdict.add_plant_state(event, self._roster.time(event.tick)):
                    self._machine.move(Cause.PLANT_ENDS)
            case Presence():
                return self._presence_changed(event, now_ns)
            case Request():
                messages = answer_request(event, self._status(), self._changes, self._coming_down)
                return self._end() if messages is None else messages
            case VehicleStatus() if self._fleet is not None:
                return [*self._take_status(event, self._fleet, now_ns), *self._advance(now_ns)]
        return self._advance(now_ns)

    def poll(self, now_ns: int) -> Sequence[Message]:
        """Open a tick that is due; take agents that missed the barrier timeout off the roster."""
        if self._machine.state in (State.WAITING, State.STOPPED):
            return ()
        self._clock.excuse_absence(self.tick, self.wake_ns, now_ns)
        match self._machine.state:
            case State.PREPARING if self._fleet is not None:
                return self._prepare(self._fleet, now_ns)
            case State.STARTING if self._fleet is not None:
                is_due = now_ns >= self._fleet.steady_start_ns
                return self._open_next(now_ns) if is_due else ()
            case State.HELD:
                return self._give_up_held(now_ns)

        expired = now_ns >= self._clock.expires_ns
        if expired and self._machine.state is State.ENDING:
            return self._end()
        if self._rules.has_plant and self._clock.plant_is_silent(now_ns):
            reason = f"plant has not answered since tick {self._open.plant}"
            return self._stop(EXIT_UNREACHABLE, reason)

        silent = self._clock.silent(self._roster.members, self._missing, now_ns)
        if silent:
            return self._drop_silent(silent, now_ns)
        if expired and self._open.lacks_state:
            reason = f"plant did not answer tick {self._open.plant + 1} in time"
            return self._stop(EXIT_UNREACHABLE, reason)
        return self._advance(now_ns)

    def interrupt(self, reason: str) -> Sequence[Message]:
        """End the run because of a signal; a team in the air outside is landed before.

        The run goes on while there are messages and no end.
        """
        if self._coming_down is not None and self._takes_changes:
            landing = self._coming_down.interrupt(reason, self.tick + 1)
            if landing:
                return landing
        if self._flies_without:  # it has not taken over yet: the team goes on as before
            return ()
        return self._stop(EXIT_INTERRUPTED, reason)

    def check_moment(self, message: Message) -> None:
        """Raise MessageError for answers to another tick, and plans of agents off the roster."""
        if isinstance(message, Plan):
            is_member = message.agent in self._roster.members
            if not is_member or not self._roster.is_newest(message.sender, message.incarnation):
                text = "plan of an incarnation that is not on the roster"
                raise MessageError("wrong_incarnation", text)
        if isinstance(message, Plan | PlantState):
            self._open.check(message)

    def _take_plan(self, plan: Plan, now_ns: int) -> None:
        """Note an answer to a tick, or a proposal of a negotiation."""
        if self._open.take_plan(plan, now_ns):
            self._verdict.add_plan(plan)

    def _take_status(self, status: VehicleStatus, fleet: Fleet, now_ns: int) -> Sequence[Message]:
        """Take in how a vehicle is; in flight return the messages of a landing that follows."""
        fleet.take(status, now_ns)
        if self._machine.state in BEFORE_TICK_0:
            self._changes.learn(status)
            return ()
        is_flying = self._machine.state is State.OPEN and not self._open.is_last
        if self._coming_down is None or not is_flying:
            return ()
        return self._coming_down.watch(status, self.tick + 1)

    # -- Processes that join and leave -----------------------------------------------------------

    def _presence_changed(self, event: Presence, now_ns: int) -> Sequence[Message]:
        """Handle a process that is ready, has returned, or is gone."""
        if not event.alive:
            return self._process_gone(event, now_ns)
        if self._machine.state is State.WAITING:
            return self._process_ready(event, now_ns)
        if event.name in self._roster.agents:
            return self._agent_returned(event, now_ns)
        if event.name in self._processes.vehicles and self._fleet is not None:
            return self._vehicle_returned(event, self._fleet, now_ns)
        if self._processes.is_departed(event.name) and self._fleet is not None:
            return self._observer_returned(event.name)
        return ()

    def _process_ready(self, event: Presence, now_ns: int) -> Sequence[Message]:
        """Note that a process is ready; open the first tick when all are."""
        if not self._processes.is_expected(event.name):
            return ()
        are_all_ready = self._processes.join(event.name)
        self._roster.start(event.name, event.incarnation)
        if not are_all_ready:
            return ()
        if self._fleet is not None:
            self._machine.move(Cause.JOINED)
            return self._prepare(self._fleet, now_ns)
        return [self._roster.message("all processes are ready", 0), *self._open_next(now_ns)]

    def _agent_returned(self, event: Presence, now_ns: int) -> Sequence[Message]:
        """Let a new incarnation of an agent join at the next tick."""
        if not self._roster.ready(event.name, event.incarnation):
            return ()
        # It may return before its end was noticed: the old incarnation is gone all the same.
        lost = self._lose_member(event.name, now_ns)
        if self._machine.state is State.STOPPED:
            return lost
        return [*lost, *self._advance(now_ns)]

    def _vehicle_returned(self, event: Presence, fleet: Fleet, now_ns: int) -> Sequence[Message]:
        """Tell a vehicle that has returned all changes so far, and when the ticks are."""
        self._roster.replace(event.name, event.incarnation)
        reason = f"{event.name} returned at {self._roster.time(self.tick)}"
        return [
            *self._changes.repeated(),
            self._roster.message(reason, self.tick),
            fleet.word(now_ns),
        ]

    def _observer_returned(self, name: str) -> Sequence[Message]:
        """Tell an observer that was started again what it has missed: vehicles went on without it."""
        self._processes.come_back(name)
        reason = f"{name} has returned at {self._roster.time(self.tick)}"
        return [*self._changes.repeated(), self._roster.message(reason, self.tick)]

    def _process_gone(self, event: Presence, now_ns: int) -> Sequence[Message]:
        """Handle the end of a process: take it off the roster, or end the run."""
        self._roster.gone(event.name, event.incarnation)
        if not self._roster.is_newest(event.name, event.incarnation):
            return ()

        self._processes.depart(event.name)
        if event.name == PLANT:
            return self._stop(EXIT_UNREACHABLE, "plant is gone")
        if event.name in self._processes.vehicles:
            if self._flies_without:
                return ()
            reason = f"{event.name} is gone at {self._roster.time(self.tick)}"
            if self._ends_by_any_loss:
                return self._stop(EXIT_UNREACHABLE, reason)
            return [self._roster.message(reason, self.tick)]
        return self._lose_member(event.name, now_ns)

    def _drop_silent(self, silent: AbstractSet[int], now_ns: int) -> Sequence[Message]:
        """Take agents that have not answered in time off the roster."""
        # An agent that is behind in a negotiation blocks the others: drop it alone and restart
        # their timeout, which is that of lockstep (real time takes no negotiation).
        hindmost = self._open.hindmost(silent)
        if hindmost != silent:
            silent = hindmost
            self._clock.restart(now_ns)

        is_all = len(silent) > 1 and silent == self._roster.members
        if is_all and self._fleet is None:
            # All at once: more likely the plant, on which all depend.
            reason = f"no agent answered tick {self.tick} in time: is the plant alive?"
            return self._stop(EXIT_UNREACHABLE, reason)
        reason = f"{agent_names(silent)} did not answer tick {self.tick} in time"
        return self._lose(silent, reason, now_ns)

    def _lose_member(self, name: str, now_ns: int) -> Sequence[Message]:
        """Take an agent whose process is gone off the roster, if it is on it."""
        agent = self._roster.agents.get(name)
        if agent is None or agent not in self._roster.members:
            return ()
        return self._lose([agent], f"{name} is gone", now_ns)

    def _lose(self, agents: Collection[int], reason: str, now_ns: int) -> Sequence[Message]:
        """Take agents off the roster, and continue or end the run.

        Of a team that flies without this coordinator none is, and nothing ends: one that stays away is
        taken off once this one has taken over.
        """
        if self._flies_without:
            return ()
        reason = f"{reason} at {self._roster.time(self.tick)}"
        if self._ends_by_any_loss:
            return self._stop(EXIT_UNREACHABLE, reason)

        self._roster.remove(agents)
        if not self._roster.members and self._fleet is None:
            return self._stop(EXIT_UNREACHABLE, f"{reason}; no agent is left")
        # Without any agent vehicles fly by the laws of UAVs alone, and may be landed so.
        return [self._roster.message(reason, self.tick), *self._advance(now_ns)]

    @property
    def _ends_by_any_loss(self) -> bool:
        """Whether the loss of any agent or vehicle ends the run: by `clock.on_agent_loss`, or early."""
        return self._ends_by_loss or self._machine.state in BEFORE_TICK_0

    # -- Ticks: opened, held, closed -------------------------------------------------------------

    def _prepare(self, fleet: Fleet, now_ns: int) -> Sequence[Message]:
        """Speak to the vehicles until all are ready; then tell them the instant of tick 0."""
        if fleet.followed_ns and not fleet.learns(now_ns):
            return self._take_over(fleet, now_ns)
        if fleet.is_over(now_ns):
            reason = f"the vehicles are not ready: {fleet.problem()}"
            return self._stop(EXIT_UNREACHABLE, reason)
        word = fleet.speak(now_ns)
        if word is None:
            return ()
        if not fleet.start_ns:
            return [word]
        self._machine.move(Cause.TOLD)
        self._clock.begin(fleet.steady_start_ns)
        return [self._roster.message("all vehicles are ready", 0), word]

    def _take_over(self, fleet: Fleet, now_ns: int) -> Sequence[Message]:
        """Take over a team that flies without a coordinator, from the newest tick on.

        Its ticks go on at their instants; the roster has all agents, in a newer version than any
        vehicle has. Links and targets that an earlier coordinator has changed stay as they are, and
        are repeated for processes that have returned meanwhile.
        """
        fleet.follow()
        self._machine.move(Cause.TOLD)
        self._clock.begin(fleet.steady_start_ns)
        self._open.resume(self._clock.newest(now_ns), now_ns)
        self._roster.follow(fleet.roster)
        reason = f"the coordinator has returned at {self._roster.time(self.tick)}"
        roster = self._roster.message(reason, self.tick)
        repeated = self._changes.repeated()
        return [*repeated, roster, fleet.word(now_ns), *self._open_next(now_ns)]

    def _advance(self, now_ns: int) -> Sequence[Message]:
        """End an exchange whose proposals are all here, and the open tick if it may be closed."""
        if self._machine.state in BEFORE_TICK_0:
            return ()
        if self._air is None:
            return self._close(now_ns)
        return [*self._air.exchanged(self.tick, self._roster.members), *self._close(now_ns)]

    def _close(self, now_ns: int) -> Sequence[Message]:
        """Close the open tick if it may be closed: open the next one, or end the run."""
        is_ending = self._machine.state is State.ENDING
        if is_ending and self.tick > self._open.plant:
            return self._end()

        if not self._open.may_close(self._roster.members, now_ns):
            return ()
        if not is_ending and not self._open.is_last and self._roster.due_back(self.tick + 1):
            if self._machine.move(Cause.AWAITED):
                self._clock.restart(now_ns)
            return ()

        too_late = self._clock.judge_overruns(self.tick, self._missing, now_ns)
        if too_late:
            return self._stop(EXIT_OVERRUN, too_late)
        if self._open.is_last:
            return self._end()
        opened = self._open_next(now_ns)
        if not is_ending:
            return opened
        # The tick after that of the plant's last state is open now: the run ends.
        return [*opened, *self._advance(now_ns)]

    def _give_up_held(self, now_ns: int) -> Sequence[Message]:
        """Open the tick that is held without the agents it waits for, once their time is over."""
        if now_ns < self._clock.hold_ends_ns:
            return ()
        # Without the agents given up the tick is not held again.
        gave_up = self._roster.give_up(self.tick + 1)
        opened = self._advance(now_ns)
        return [gave_up, *opened]

    def _open_next(self, now_ns: int) -> list[Message]:
        """Open the next tick, also for agents that have returned.

        Returns: All that changes at the tick, then the tick itself.
        """
        tick = self.tick + 1
        joined = set(self._roster.joining)
        changes: list[Message] = []
        if joined:
            changes += [*self._changes.repeated(), self._roster.join(tick)]
        changes += self._roster.report_failures(tick)
        changes += self._changes.announce_scripted(tick)
        air = [] if self._air is None else self._air.opened(tick, self._roster.members - joined)
        # Before the tick before is forgotten: it tells who answered that, and how late.
        opened = self._tick_message(tick, now_ns)

        self._machine.move(Cause.OPENED)
        self._clock.open(tick, self._roster.members, joined, now_ns)
        for plan in self._open.open(tick, now_ns):
            self._take_plan(plan, now_ns)
        return [*changes, *air, opened]

    def _tick_message(self, tick: int, now_ns: int) -> Tick:
        """Return the message that opens a tick: roster in force, answers to the tick before.

        In lockstep its bundle carries these plans (`protocol.network.exchange_in_bundles`).
        """
        late_ns, overrun_ns = self._clock.lateness_ns(tick, now_ns)
        answered = self._open.answered
        return self._out.stamp(
            Tick,
            tick=tick,
            members=tuple(sorted(self._roster.members)),
            answered=tuple(sorted(answered)),
            shared=tuple(sorted(agent for agent, is_shared in answered.items() if is_shared)),
            roster=self._roster.version,
            late_ns=late_ns,
            overrun_ns=overrun_ns,
        )

    @property
    def _missing(self) -> AbstractSet[int]:
        """Agents on the roster that have not answered the open tick."""
        return self._open.missing(self._roster.members)

    # -- The end, and answers about the run ------------------------------------------------------

    def _end(self) -> Sequence[Message]:
        """End the run by the plant's states, at its last tick, or once a team that landed is released."""
        exit_code, reason = self._verdict.outcome()
        if exit_code == 0 and self._coming_down is not None and self._coming_down.aborted:
            exit_code, reason = EXIT_INTERRUPTED, self._coming_down.aborted
        return self._stop(exit_code, reason)

    def _stop(self, exit_code: int, reason: str) -> Sequence[Message]:
        """End the run; only the first end counts."""
        if self._machine.state is State.STOPPED:
            return ()
        self._machine.move(Cause.ENDED)
        self.finished = self._out.stamp(
            Control,
            tick=max(self.tick, 0),
            outcome=_OUTCOMES.get(exit_code, "aborted"),
            reason=reason,
            exit_code=exit_code,
        )
        return [self.finished]

    @property
    def _flies_without(self) -> bool:
        """Whether vehicles fly already, and this coordinator has not taken over yet."""
        is_preparing = self._machine.state in BEFORE_TICK_0
        return (
            is_preparing
            and self._fleet is not None
            and bool(self._fleet.followed_ns)
            and not self._fleet.start_ns
        )

    @property
    def _takes_changes(self) -> bool:
        """Whether a tick follows, from which on a change can hold."""
        return self._machine.state not in BEFORE_TICK_0 and not self._open.is_last

    def _status(self) -> RunStatus:
        """Return the progress of the run, for requests."""
        return RunStatus(
            tick=self.tick,
            ticks=self._rules.ticks,
            members=sorted(self._roster.members),
            observers=sorted(self._processes.observers),
            is_before=self._machine.state in BEFORE_TICK_0 and not self._flies_without,
            takes_changes=self._takes_changes,
            period_ns=self._rules.period_ns,
        )
