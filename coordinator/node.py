"""The coordinator as a state machine: opens tick k + 1 when everybody has answered tick k.

waiting  --everybody ready-->  running  --last tick answered and recorded-->  stopped
                               running  --plant gone, agent lost, diverged, interrupted-->  stopped
"""

from collections import Counter
from collections.abc import Sequence

from protocol.messages import Control, Message, Outcome, Plan, Presence, Roster, Tick, Truth, agent_name
from protocol.outbox import EXIT_LOST, Outbox
from protocol.setup import Setup

# Exit codes a run can end with (docs/command-line.md).
EXIT_DIVERGED, EXIT_INTERRUPTED = 6, 130


class CoordinatorNode:
    """Sampling clock and roster of one run.

    Args:
        setup: The run.
        incarnation: Which start of this process.
        observers: Names that must be ready besides the plant and the agents, such as "recorder".
    """

    name = "coordinator"

    def __init__(self, setup: Setup, incarnation: int = 0, observers: Sequence[str] = ()) -> None:
        self._clock = setup.scenario.clock
        self._ticks, self._period_ns = setup.ticks, setup.period_ns
        self._out = Outbox(self.name, incarnation)
        self._agents = {agent_name(agent): agent for agent in setup.agents}
        self._awaited = {"plant", *self._agents, *observers}
        self._incarnations: dict[str, int] = {}  # of the processes that take part, by name
        self._members: set[int] = set(setup.agents)
        self._answered: set[int] = set()
        self._tick = -1
        self._opened_ns = 0  # when the present tick was opened
        self._start_ns = 0  # when tick 0 was opened; paced ticks are due relative to it
        self._roster_version = 0
        self._last_truth = -1
        self._diverged = ""
        self.rejected: Counter[tuple[str, str]] = Counter()
        self.finished: Control | None = None

    @property
    def tick(self) -> int:
        """The open tick, -1 before the first."""
        return self._tick

    @property
    def wake_ns(self) -> int | None:
        """Next pacing or barrier deadline."""
        if self.finished is not None or self._tick < 0:
            return None
        barrier = self._opened_ns + round(self._clock.barrier_timeout_s * 1e9)
        return self._due_ns() if self._is_complete() and self._tick + 1 < self._ticks else barrier

    def receive(self, event: Message | Presence, now_ns: int) -> Sequence[Message]:
        """Take in presences, plans and the plant's truth."""
        if self.finished is not None:
            return ()
        if isinstance(event, Presence):
            return self._presence(event, now_ns)
        if isinstance(event, Plan):
            if event.incarnation != self._incarnations.get(event.sender):
                self.rejected[(event.sender, "plan of another incarnation")] += 1
            elif event.tick == self._tick and event.agent in self._members:
                self._answered.add(event.agent)
        elif isinstance(event, Truth):
            self._last_truth = event.tick
            if event.diverged:
                self._diverged = f"{event.diverged} at {self._time(event.tick)}"
        return self._advance(now_ns)

    def poll(self, now_ns: int) -> Sequence[Message]:
        """Open a paced tick that is due; take whoever missed the barrier off the roster."""
        if self.finished is not None or self._tick < 0:
            return ()
        expired = now_ns >= self._opened_ns + round(self._clock.barrier_timeout_s * 1e9)
        if expired and self._diverged:
            return self._stop("diverged", self._diverged, EXIT_DIVERGED)
        if expired and not self._is_complete():
            late = sorted(self._members - self._answered)
            names = ", ".join(agent_name(agent) for agent in late)
            if not self._answered and len(late) > 1:
                # All at once: more likely the one they all depend on.
                return self._stop(
                    "aborted", f"no agent answered tick {self._tick} in time: is the plant alive?", EXIT_LOST
                )
            return self._lose(late, f"{names} did not answer tick {self._tick} in time", now_ns)
        if expired and self._tick + 1 == self._ticks and self._last_truth < self._tick:
            return self._stop("aborted", f"plant did not answer tick {self._tick} in time", EXIT_LOST)
        return self._advance(now_ns)

    def interrupt(self, reason: str) -> Sequence[Message]:
        """End the run on a person's wish."""
        return () if self.finished is not None else self._stop("aborted", reason, EXIT_INTERRUPTED)

    def _presence(self, event: Presence, now_ns: int) -> Sequence[Message]:
        known = self._incarnations.get(event.name, -1)
        if event.alive:
            if self._tick < 0 and event.name in {"plant", *self._agents} | self._awaited:
                self._awaited.discard(event.name)
                self._incarnations[event.name] = max(event.incarnation, known)
                if not self._awaited:
                    self._start_ns = now_ns
                    return [self._roster("everybody is ready"), self._open(now_ns)]
            return ()
        if event.incarnation != known:
            return ()
        if event.name == "plant":
            return self._stop("aborted", "plant is gone", EXIT_LOST)
        agent = self._agents.get(event.name)
        if agent in self._members:
            return self._lose([agent], f"{event.name} is gone", now_ns)
        return ()

    def _lose(self, agents: Sequence[int], reason: str, now_ns: int) -> Sequence[Message]:
        """Take agents off the roster, and go on or end the run by policy."""
        when = f"{reason} at {self._time(max(self._tick, 0))}"
        if self._clock.on_agent_loss == "abort" or self._tick < 0:
            return self._stop("aborted", when, EXIT_LOST)
        self._members -= set(agents)
        if not self._members:
            return self._stop("aborted", f"{when}; no agent is left", EXIT_LOST)
        return [self._roster(when), *self._advance(now_ns)]

    def _is_complete(self) -> bool:
        return self._members <= self._answered

    def _due_ns(self) -> int:
        """When the next tick may open: paced from the first one, so that delays do not add up."""
        if self._clock.speed == 0.0:
            return 0
        return self._start_ns + round((self._tick + 1) * self._period_ns / self._clock.speed)

    def _advance(self, now_ns: int) -> Sequence[Message]:
        if self._diverged and self._tick > self._last_truth:
            # The tick after the last interval is always opened before the end, whichever news came first.
            return self._stop("diverged", self._diverged, EXIT_DIVERGED)
        if self._tick < 0 or not self._is_complete():
            return ()
        if self._tick + 1 == self._ticks:
            # The record is complete only with the truth of the last interval.
            if self._last_truth < self._tick:
                return ()
            if self._diverged:
                return self._stop("diverged", self._diverged, EXIT_DIVERGED)
            return self._stop("completed", "", 0)
        if now_ns < self._due_ns():
            return ()
        opened = self._open(now_ns)
        return [opened, *self._advance(now_ns)] if self._diverged else [opened]

    def _open(self, now_ns: int) -> Tick:
        answered = tuple(sorted(self._answered))
        self._tick += 1
        self._answered = set()
        self._opened_ns = now_ns
        return self._out.stamp(
            Tick,
            tick=self._tick,
            members=tuple(sorted(self._members)),
            answered=answered,
            roster=self._roster_version,
        )

    def _roster(self, reason: str) -> Roster:
        members = sorted(self._members)
        self._roster_version += 1
        return self._out.stamp(
            Roster,
            tick=max(self._tick, 0),
            version=self._roster_version,
            agents=tuple(members),
            incarnations=tuple(self._incarnations[agent_name(agent)] for agent in members),
            reason=reason,
        )

    def _stop(self, outcome: Outcome, reason: str, exit_code: int) -> Sequence[Message]:
        control = self._out.stamp(Control, tick=max(self._tick, 0), outcome=outcome, reason=reason, exit_code=exit_code)
        self.finished = control
        return [control]

    def _time(self, tick: int) -> str:
        return f"t = {tick * self._period_ns / 1e9:.2f} s"
