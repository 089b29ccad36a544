"""The coordinator as a state machine.

Opens tick k + 1 when all agents have answered tick k, or at its deadline.

`coordinator.clock` has the difference between lockstep and real time. Agents that are gone or do
not answer are taken off the roster; those that return with a higher incarnation are put on it again
when a tick is opened.
"""

from collections.abc import Collection, Sequence
from enum import Enum

from transport.coordinator.clock import Clock
from transport.coordinator.failed_steps import FailedSteps
from transport.coordinator.roster import TeamRoster, names
from transport.protocol.admission.plausibility import check_tick
from transport.protocol.scenario.errors import RequestError, requested
from transport.protocol.scenario.schema import TargetSection
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.errors import MessageError
from transport.protocol.wire.exit_codes import (
    EXIT_DIVERGED,
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OVERRUN,
    EXIT_UNREACHABLE,
)
from transport.protocol.wire.messages import (
    Control,
    Event,
    Message,
    Plan,
    PlantState,
    Presence,
    Request,
    Target,
    Tick,
)
from transport.protocol.wire.names import COORDINATOR, PLANT
from transport.protocol.wire.node import Outbox

# Outcomes of runs that reach their end, by exit code; a run with another code was aborted.
_OUTCOMES = {0: "completed", EXIT_DIVERGED: "diverged", EXIT_FAILED: "failed"}


class State(Enum):
    """State of a run."""

    WAITING = "the processes are joining"
    OPEN = "a tick is open"
    HELD = "the next tick waits for agents that the scenario's faults bring back"
    DIVERGED = "the plant has diverged; the run ends when the next tick is open"
    STOPPED = "the run has ended"


class CoordinatorNode:
    """Sampling clock and roster of one run; `tick` is the open one, -1 before the first.

    The observers, such as "recorder", must be ready before the first tick, like the plant and the
    agents.
    """

    name = COORDINATOR
    publish_ns = 0

    def __init__(self, setup: Setup, incarnation: int = 0, observers: Sequence[str] = ()) -> None:
        self.state, self.tick = State.WAITING, -1
        self.incarnation = incarnation
        self.finished: Control | None = None
        self._setup, self._ticks, self._out = setup, setup.ticks, Outbox(self.name, incarnation)
        self._clock, self._roster = Clock(setup), TeamRoster(setup, self._out)
        self._awaited = {PLANT, *self._roster.agents, *observers}
        self._observers = set(observers)  # that have not left
        self._answered: dict[
            int, bool
        ] = {}  # agents that answered, and whether with a plan the others received
        self._negotiating: dict[
            int, int
        ] = {}  # negotiation iterations left in the open tick, by agent
        self._plant_tick = -1  # newest tick the plant has recorded
        self._divergence = ""
        self._failed_steps = FailedSteps(setup.scenario.agents.failed_share)

    @property
    def wake_ns(self) -> int | None:
        """Next pacing, barrier or real-time deadline."""
        if self.state in (State.WAITING, State.STOPPED):
            return None
        if self.state is State.HELD:
            return self._clock.hold_ends_ns
        waits = self._awaits_plant or self._clock.waits_for(self._missing)
        return self._clock.expires_ns if waits else self._clock.due_ns(self.tick + 1)

    def receive(self, event: Event, now_ns: int) -> Sequence[Message]:
        """Take in presences, plans, plant states, and requests."""
        if self.state is State.STOPPED:
            return ()
        self._clock.excuse_absence(self.tick, self.wake_ns, now_ns)
        match event:
            case Request():
                return self._answer_request(event)
            case Presence(alive=True) if self.state is State.WAITING:
                return self._process_ready(event, now_ns)
            case Presence(alive=True):
                return self._agent_returned(event, now_ns)
            case Presence():
                return self._process_gone(event, now_ns)
            case PlantState():
                self._plant_tick = event.tick
                self._clock.plant_ns = now_ns
                if event.diverged and not self._divergence:
                    self._divergence = f"{event.diverged} at {self._roster.time(event.tick)}"
                    self.state = State.DIVERGED
            case Plan(negotiation=left) if left > 0:
                self._negotiating[event.agent] = left
            case Plan():
                self._failed_steps.count(event)
                if event.tick == self.tick:
                    self._answered[event.agent] = event.shared
                self._clock.answer(event, self.tick, now_ns)
        return self._advance(now_ns)

    def poll(self, now_ns: int) -> Sequence[Message]:
        """Open a tick that is due; take agents that missed the barrier timeout off the roster."""
        if self.state in (State.WAITING, State.STOPPED):
            return ()
        self._clock.excuse_absence(self.tick, self.wake_ns, now_ns)
        if self.state is State.HELD:
            if now_ns < self._clock.hold_ends_ns:
                return ()
            return [self._roster.give_up(self.tick + 1), *self._advance(now_ns)]
        expired = now_ns >= self._clock.expires_ns
        if expired and self.state is State.DIVERGED:
            return self._stop(EXIT_DIVERGED, self._divergence)
        if self._clock.plant_is_silent(now_ns):
            return self._stop(
                EXIT_UNREACHABLE, f"plant has not answered since tick {self._plant_tick}"
            )
        silent = self._clock.silent(self._roster.members, self._missing, now_ns)
        if silent:
            return self._drop_silent(silent, now_ns)
        if expired and self._awaits_plant:
            return self._stop(EXIT_UNREACHABLE, f"plant did not answer tick {self.tick} in time")
        return self._advance(now_ns)

    def interrupt(self, reason: str) -> Sequence[Message]:
        """End the run because of a signal."""
        return self._stop(EXIT_INTERRUPTED, reason)

    @property
    def _is_last(self) -> bool:
        return self.tick + 1 == self._ticks

    @property
    def _awaits_plant(self) -> bool:
        """Whether the plant's last state is missing, without which the record is not complete."""
        return self._is_last and self._plant_tick < self.tick

    @property
    def _missing(self) -> set[int]:
        """Agents on the roster that have not answered the open tick."""
        return self._roster.members - self._answered.keys()

    def check_moment(self, message: Message) -> None:
        """Raise MessageError for answers to other ticks than the open one, and plans of agents off the roster."""
        match message:
            case PlantState():
                check_tick(message, self._plant_tick + 1, self.tick)
            case Plan():
                roster = self._roster
                if (
                    message.agent not in roster.members
                    or message.incarnation != roster.incarnations[message.sender]
                ):
                    raise MessageError(
                        "wrong_incarnation", "plan of an incarnation that is not on the roster"
                    )
                check_tick(message, 0 if self._clock.is_realtime else self.tick, self.tick)

    def _process_ready(self, event: Presence, now_ns: int) -> Sequence[Message]:
        """Note that a process is ready; open the first tick when all are."""
        if event.name not in {PLANT, *self._roster.agents} | self._awaited:
            return ()
        self._awaited.discard(event.name)
        known = self._roster.incarnations.get(event.name, -1)
        self._roster.incarnations[event.name] = max(event.incarnation, known)
        return (
            ()
            if self._awaited
            else [self._roster.message("all processes are ready", 0), *self._open(now_ns)]
        )

    def _agent_returned(self, event: Presence, now_ns: int) -> Sequence[Message]:
        """Let a new incarnation of an agent join at the next tick."""
        agent = self._roster.agents.get(event.name)
        if agent is None or event.incarnation <= self._roster.incarnations.get(event.name, -1):
            return ()
        self._roster.joining[agent] = event.incarnation
        # It may return before its end was noticed: the old incarnation is gone all the same.
        lost = (
            self._lose([agent], f"{event.name} is gone", now_ns)
            if agent in self._roster.members
            else ()
        )
        return lost if self.state is State.STOPPED else [*lost, *self._advance(now_ns)]

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
        return (
            self._lose([agent], f"{event.name} is gone", now_ns)
            if agent in self._roster.members
            else ()
        )

    def _answer_request(self, request: Request) -> Sequence[Message]:
        """Answer a request for the status of the run, or for a change of links or a target from the next tick on."""
        if request.what == "status":
            members, observers = sorted(self._roster.members), sorted(self._observers)
            request.reply(
                {
                    "tick": self.tick,
                    "ticks": self._ticks,
                    "members": members,
                    "observers": observers,
                }
            )
            return ()
        try:
            if request.what not in ("link", "target"):
                raise RequestError(f"what: expected status, link or target, got {request.what!r}")
            if self.state is State.WAITING or self._is_last:
                raise RequestError("expected a running simulation")
            messages: Sequence[Message]
            if request.what == "target":
                messages = self._roster.target(
                    requested(TargetSection, dict(request.given)), self.tick + 1
                )
            else:
                messages = self._roster.link(request.given, self.tick + 1)
        except RequestError as error:
            request.reply({"error": str(error)})
            return ()
        change, since_s = messages[0], (self.tick + 1) * self._setup.period_ns / 1e9
        reply = {"tick": self.tick + 1, "t_s": since_s}
        if isinstance(change, Target):
            reply["reached_s"] = since_s + change.approach_s
            reply["ends_s"] = reply["reached_s"] + change.way_s
        request.reply(reply)
        return messages

    def _drop_silent(self, silent: set[int], now_ns: int) -> Sequence[Message]:
        """Take agents that have not answered in time off the roster."""
        # An agent that is behind in a negotiation blocks the others: drop it alone and restart
        # their timeout.
        iterations = self._setup.scenario.controller.negotiation_iterations
        left = {agent: self._negotiating.get(agent, iterations) for agent in silent}
        behind = {agent for agent in silent if left[agent] == max(left.values())}
        if behind < silent:
            silent, self._clock.waiting_since_ns = behind, now_ns
        members = self._roster.members
        if len(silent) > 1 and silent == members and members.isdisjoint(self._answered):
            # All at once: more likely the plant, on which all depend.
            return self._stop(
                EXIT_UNREACHABLE, f"no agent answered tick {self.tick} in time: is the plant alive?"
            )
        return self._lose(
            silent, f"{names(silent)} did not answer tick {self.tick} in time", now_ns
        )

    def _lose(self, agents: Collection[int], reason: str, now_ns: int) -> Sequence[Message]:
        """Take agents off the roster, and continue or end the run by `clock.on_agent_loss`."""
        reason = f"{reason} at {self._roster.time(max(self.tick, 0))}"
        if self._setup.scenario.clock.on_agent_loss == "abort" or self.state is State.WAITING:
            return self._stop(EXIT_UNREACHABLE, reason)
        self._roster.members.difference_update(agents)
        if not self._roster.members:
            return self._stop(EXIT_UNREACHABLE, f"{reason}; no agent is left")
        return [self._roster.message(reason, self.tick), *self._advance(now_ns)]

    def _advance(self, now_ns: int) -> Sequence[Message]:
        """Close the open tick if it may be closed: open the next one, or end the run."""
        if self.state is State.WAITING:
            return ()
        if self.state is State.DIVERGED and self.tick > self._plant_tick:
            # The tick after the last interval is always opened before the end, whichever message
            # came first.
            return self._stop(EXIT_DIVERGED, self._divergence)
        if (
            not self._clock.may_close(self.tick, self._missing, now_ns, last=self._is_last)
            or self._awaits_plant
        ):
            return ()
        if (
            self.state is not State.DIVERGED
            and not self._is_last
            and self._roster.awaited(self.tick + 1)
        ):
            if self.state is not State.HELD:
                self.state, self._clock.waiting_since_ns = State.HELD, now_ns
            return ()
        overrun = self._clock.overrun(self.tick, self._missing, now_ns)
        if overrun:
            return self._stop(EXIT_OVERRUN, overrun)
        if self._is_last:
            return self._end()
        opened = self._open(now_ns)
        return [*opened, *self._advance(now_ns)] if self.state is State.DIVERGED else opened

    def _open(self, now_ns: int) -> list[Message]:
        """Open the next tick, also for agents that have returned."""
        tick = self.tick + 1
        joined, messages = self._roster.begin(tick)
        late_ns, overrun_ns = self._clock.lateness_ns(tick, now_ns)
        opened = self._out.stamp(
            Tick,
            tick=tick,
            members=tuple(sorted(self._roster.members)),
            answered=tuple(sorted(self._answered)),
            shared=tuple(sorted(agent for agent, shared in self._answered.items() if shared)),
            roster=self._roster.version,
            late_ns=late_ns,
            overrun_ns=overrun_ns,
        )
        self.tick = tick
        if self.state is not State.DIVERGED:
            self.state = State.OPEN
        self._answered, self._negotiating = {}, {}
        self._clock.open(tick, self._roster.members, joined, now_ns)
        if self._plant_tick + 1 == tick:
            self._clock.plant_ns = now_ns  # it owes no earlier interval
        return [*messages, opened]

    def _end(self) -> Sequence[Message]:
        """End the run at its last tick: diverged, failed or completed."""
        if self.state is State.DIVERGED:
            return self._stop(EXIT_DIVERGED, self._divergence)

        failure = self._failed_steps.verdict()
        return self._stop(EXIT_FAILED if failure else 0, failure)

    def _stop(self, exit_code: int, reason: str) -> Sequence[Message]:
        if self.state is State.STOPPED:
            return ()
        self.state = State.STOPPED
        outcome = _OUTCOMES.get(exit_code, "aborted")
        fields = {"outcome": outcome, "reason": reason, "exit_code": exit_code}
        self.finished = self._out.stamp(Control, tick=max(self.tick, 0), **fields)
        return [self.finished]
