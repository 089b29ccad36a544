"""The coordinator as a state machine: opens tick k + 1 when everybody has answered tick k, or at its deadline.

In lockstep the clock waits for everybody on the roster, in real time for nobody. Agents that are gone or do
not answer are taken off the roster; those that come back, with a higher incarnation, are put on it again when
a tick is opened.

waiting  --everybody ready-->  running  --last tick answered and recorded-->  stopped
                               running  --plant gone, agent lost, diverged, overrun, interrupted-->  stopped
"""

import json
from collections.abc import Sequence

from protocol.admission.plausibility import check_moment
from protocol.admission.reception import Reception
from protocol.scenario.faults import uav_faults, uav_name
from protocol.scenario.links import LinkError, link_change
from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_DIVERGED, EXIT_INTERRUPTED, EXIT_OVERRUN, EXIT_UNREACHABLE
from protocol.wire.messages import (
    Control,
    Event,
    LinkChange,
    Message,
    MessageError,
    Outcome,
    Plan,
    PlantState,
    Presence,
    Request,
    Roster,
    Tick,
    agent_name,
)
from protocol.wire.outbox import Outbox

# A process that wakes up so much later than it meant to was frozen, or had no processor to run on.
_AWAY_NS = 200_000_000

# Exit codes a run can end with (docs/command-line.md).


class CoordinatorNode:
    """Sampling clock and roster of one run.

    Args:
        setup: The run.
        incarnation: Which start of this process.
        observers: Names that must be ready besides the plant and the agents, such as "recorder".
    """

    name = "coordinator"
    publish_ns = 0

    def __init__(self, setup: Setup, incarnation: int = 0, observers: Sequence[str] = ()) -> None:
        self._clock = setup.scenario.clock
        self._ticks, self._period_ns = setup.ticks, setup.period_ns
        self.incarnation = incarnation
        self._out = Outbox(self.name, incarnation)
        self._agents = {agent_name(agent): agent for agent in setup.agents}
        self._awaited = {"plant", *self._agents, *observers}
        self._observers = set(observers)  # that are there
        self._incarnations: dict[str, int] = {}  # of the processes that take part, by name
        self._members: set[int] = set(setup.agents)
        self._joining: dict[int, int] = {}  # agents to be put on the roster, with their incarnations
        self._answered: set[int] = set()
        self._shared: set[int] = set()  # those of them whose plans the other agents got
        self._negotiating: dict[int, int] = {}  # exchanges still to come in the open tick, of who has proposed in it
        self._owes_ns: dict[int, int] = {}  # in real time: since when there is something that an agent has not answered
        self._waits = self._clock.mode == "lockstep"
        self._barrier_ns = round(self._clock.barrier_timeout_s * 1e9)
        self._setup = setup
        self._changes: list[LinkChange] = []
        self._returns = _returns(setup)  # in lockstep: agents to wait for, by the tick they are to be back at
        self._uav_faults = list(uav_faults(setup.faults))  # still to be reported
        self._off: set[int] = set()  # UAVs without motors, 1-based
        self._released: set[int] = set()
        self._held_ns: int | None = None  # since when a tick is held for them
        self._overruns = 0  # missed deadlines
        self._overrun_ns = 0  # worst since the last tick
        self._tick = -1
        self._opened_ns = 0  # when the present tick was opened
        self._start_ns = 0  # when tick 0 was opened; paced ticks are due relative to it
        self._called_ns = 0  # when this process last had something to do
        self._excused = -1  # tick in which it was found to have been away last
        self._roster_version = 0
        self._last_truth = -1
        self._truth_ns = 0  # when it came, or when the plant was asked for the next
        self._diverged = ""
        self._reception = Reception(setup, self._handle)
        self.rejected = self._reception.rejected
        self.finished: Control | None = None

    @property
    def tick(self) -> int:
        """The open tick, -1 before the first."""
        return self._tick

    @property
    def wake_ns(self) -> int | None:
        """Next pacing, barrier or real-time deadline."""
        if self.finished is not None or self._tick < 0:
            return None
        if self._held_ns is not None:
            return self._held_ns + round(self._clock.join_timeout_s * 1e9)
        barrier = self._opened_ns + self._barrier_ns
        last = self._tick + 1 == self._ticks
        if self._waits:
            return self._due_ns() if self._is_complete() and not last else barrier
        waiting = self._clock.on_overrun == "hold" and not self._is_complete()
        return barrier if waiting or (last and self._last_truth < self._tick) else self._due_ns()

    def receive(self, event: Event, now_ns: int) -> Sequence[Message]:
        """Take in presences, plans, the plant's truth, and what people ask for."""
        if self.finished is not None:
            return ()
        self._excuse(now_ns)
        if isinstance(event, Presence):
            return self._presence(event, now_ns)
        if isinstance(event, Request):
            return self._request(event)
        return self._advance(now_ns) if self._reception.receive(event, now_ns) else ()

    def poll(self, now_ns: int) -> Sequence[Message]:
        """Open a tick that is due; take whoever missed the barrier off the roster."""
        if self.finished is not None or self._tick < 0:
            return ()
        self._excuse(now_ns)
        if self._held_ns is not None and now_ns >= self._held_ns + round(self._clock.join_timeout_s * 1e9):
            missing = ", ".join(agent_name(agent) for agent in sorted(self._returns.pop(self._tick + 1)))
            when = f"{missing} did not come back at {self._time(self._tick + 1)}"
            return [self._roster(when), *self._advance(now_ns)]
        expired = now_ns >= self._opened_ns + self._barrier_ns
        if expired and self._diverged:
            return self._stop("diverged", self._diverged, EXIT_DIVERGED)
        if not self._waits and now_ns >= self._truth_ns + self._barrier_ns:
            return self._stop("aborted", f"plant has not answered since tick {self._last_truth}", EXIT_UNREACHABLE)
        late = self._late(now_ns)
        if late:
            # Of those that negotiate, whoever is behind keeps the others waiting; they get as long again without it.
            negotiation_iterations = self._setup.scenario.controller.negotiation_iterations
            left = {agent: self._negotiating.get(agent, negotiation_iterations) for agent in late}
            behind = {agent for agent in late if left[agent] == max(left.values())}
            if behind < late:
                late, self._opened_ns = behind, now_ns
            if self._answered.isdisjoint(self._members) and len(late) > 1 and late == self._members:
                # All at once: more likely the one they all depend on.
                return self._stop(
                    "aborted", f"no agent answered tick {self._tick} in time: is the plant alive?", EXIT_UNREACHABLE
                )
            names = ", ".join(agent_name(agent) for agent in sorted(late))
            return self._lose(sorted(late), f"{names} did not answer tick {self._tick} in time", now_ns)
        if expired and self._last_truth < self._tick and self._tick + 1 == self._ticks:
            return self._stop("aborted", f"plant did not answer tick {self._tick} in time", EXIT_UNREACHABLE)
        return self._advance(now_ns)

    def interrupt(self, reason: str) -> Sequence[Message]:
        """End the run on a person's wish."""
        return () if self.finished is not None else self._stop("aborted", reason, EXIT_INTERRUPTED)

    def _handle(self, message: Message, now_ns: int) -> None:
        """Take in an agent's plan or the plant's state.

        Raises: MessageError: it is not for now.
        """
        if isinstance(message, PlantState):
            check_moment(message, self._last_truth + 1, self._tick)
            self._last_truth, self._truth_ns = message.tick, now_ns
            if message.diverged:
                self._diverged = f"{message.diverged} at {self._time(message.tick)}"
        elif isinstance(message, Plan):
            on_it = message.agent in self._members
            if not on_it or message.incarnation != self._incarnations.get(message.sender):
                raise MessageError("wrong_incarnation", "plan of an incarnation that is not on the roster")
            check_moment(message, self._tick if self._waits else 0, self._tick)
            if message.negotiation == 0:
                if message.tick == self._tick and message.agent in self._answered:
                    # A plan has two keys it can come under, and only one of them may count.
                    raise MessageError("replayed", f"plan of tick {message.tick} again")
                self._answer(message, now_ns)
            else:
                self._negotiating[message.agent] = message.negotiation

    def _presence(self, event: Presence, now_ns: int) -> Sequence[Message]:
        known = self._incarnations.get(event.name, -1)
        agent = self._agents.get(event.name)
        if event.alive:
            if self._tick < 0 and event.name in {"plant", *self._agents} | self._awaited:
                self._awaited.discard(event.name)
                self._incarnations[event.name] = max(event.incarnation, known)
                if not self._awaited:
                    self._start_ns = self._truth_ns = now_ns
                    return [self._roster("everybody is ready"), *self._open(now_ns)]
            elif agent is not None and self._tick >= 0 and event.incarnation > known:
                self._joining[agent] = event.incarnation
                # Back before its end was noticed: what it was is over all the same.
                lost = self._lose([agent], f"{event.name} is gone", now_ns) if agent in self._members else ()
                return [*lost, *(self._advance(now_ns) if self.finished is None else ())]
            return ()
        if agent in self._joining and event.incarnation == self._joining[agent]:
            del self._joining[agent]
        if event.incarnation != known:
            return ()
        self._observers.discard(event.name)
        if event.name == "plant":
            return self._stop("aborted", "plant is gone", EXIT_UNREACHABLE)
        if agent in self._members:
            return self._lose([agent], f"{event.name} is gone", now_ns)
        return ()

    def _request(self, request: Request) -> Sequence[Message]:
        """Answer a request of a person or a process: who takes part, or a change of links from the next tick on."""
        if request.what == "status":
            request.reply(
                {
                    "tick": self._tick,
                    "ticks": self._ticks,
                    "members": sorted(self._members),
                    "observers": sorted(self._observers),
                }
            )
            return ()
        if request.what != "link":
            request.reply({"error": f"what: expected status or link, got {request.what!r}"})
            return ()
        source, target = (str(request.given.get(end, "")) for end in ("from", "to"))
        names = ["plant", *self._agents]
        try:
            for end, name in (("from", source), ("to", target)):
                if name and name not in names:
                    raise LinkError(f"{end}: expected one of {', '.join(names)}, got {name!r}")
            settings = json.dumps(request.given.get("settings"))
            change = link_change(source, target, settings)
            if not change.settings():
                raise LinkError("expected at least one key of a link, got none")
            if change.distribution == "empirical" and change.samples not in self._setup.samples_s:
                known = ", ".join(sorted(self._setup.samples_s)) or "none"
                raise LinkError(f"samples: expected a file the scenario names ({known}), got {change.samples!r}")
            if self._tick < 0 or self._tick + 1 >= self._ticks:
                raise LinkError("expected a run in flight")
            message = self._out.stamp(
                LinkChange,
                tick=self._tick + 1,
                number=len(self._changes) + 1,
                source=source,
                target=target,
                settings=settings,
            )
        except (LinkError, MessageError) as error:
            request.reply({"error": str(error)})
            return ()
        self._changes.append(message)
        request.reply({"tick": message.tick, "t_s": message.tick * self._period_ns / 1e9})
        ends = f"from {source or 'any agent'} to {target or 'any agent'}"
        # A roster follows: ticks name its version, so nobody opens the next one without knowing of the change.
        return [message, self._roster(f"links {ends} changed: {settings} from {self._time(message.tick)} on")]

    def _lose(self, agents: Sequence[int], reason: str, now_ns: int) -> Sequence[Message]:
        """Take agents off the roster, and go on or end the run by policy."""
        when = f"{reason} at {self._time(max(self._tick, 0))}"
        if self._clock.on_agent_loss == "abort" or self._tick < 0:
            return self._stop("aborted", when, EXIT_UNREACHABLE)
        self._members -= set(agents)
        if not self._members:
            return self._stop("aborted", f"{when}; no agent is left", EXIT_UNREACHABLE)
        return [self._roster(when), *self._advance(now_ns)]

    def _answer(self, plan: Plan, now_ns: int) -> None:
        self._owes_ns[plan.agent] = now_ns
        if plan.tick == self._tick:
            self._answered.add(plan.agent)
            if plan.shared:
                self._shared.add(plan.agent)
            del self._owes_ns[plan.agent]
        if not self._waits:
            self._overrun_ns = max(self._overrun_ns, now_ns - self._deadline_ns(plan.tick + 1))

    def _late(self, now_ns: int) -> set[int]:
        """Agents that have not answered for the barrier's time."""
        if self._waits:
            missed = now_ns >= self._opened_ns + self._barrier_ns and self._held_ns is None
            return self._members - self._answered if missed else set()
        return {a for a in self._members if now_ns >= self._owes_ns.get(a, now_ns) + self._barrier_ns}

    def _excuse(self, now_ns: int) -> None:
        """When this process itself was away, blame nobody for it: what came meanwhile has yet to be read.

        Once in a tick at most: a process that is always late still has to find out who is gone.
        """
        wake_ns, called_ns, self._called_ns = self.wake_ns, self._called_ns, now_ns
        if wake_ns is None or self._excused == self._tick:
            return
        if now_ns > max(wake_ns, called_ns) + _AWAY_NS:
            self._excused = self._tick
            self._opened_ns = self._truth_ns = now_ns
            self._owes_ns = dict.fromkeys(self._owes_ns, now_ns)
            self._held_ns = None if self._held_ns is None else now_ns

    def _is_complete(self) -> bool:
        return self._members <= self._answered

    def _deadline_ns(self, tick: int) -> int:
        """When a tick may open: relative to the first one, so that delays do not add up."""
        return self._start_ns + round(tick * self._period_ns / self._clock.speed)

    def _due_ns(self) -> int:
        """When the next tick may open."""
        return 0 if self._clock.speed == 0.0 else self._deadline_ns(self._tick + 1)

    def _is_held(self, now_ns: int) -> bool:
        """Whether the next tick is held for agents a script brings back at it: lockstep's time is not the host's."""
        expected = self._returns.get(self._tick + 1, set())
        if not self._waits or expected <= self._joining.keys() | self._members:
            self._held_ns = None
        elif self._held_ns is None:
            self._held_ns = now_ns
        return self._held_ns is not None

    def _advance(self, now_ns: int) -> Sequence[Message]:
        if self._diverged and self._tick > self._last_truth:
            # The tick after the last interval is always opened before the end, whichever news came first.
            return self._stop("diverged", self._diverged, EXIT_DIVERGED)
        if self._tick < 0:
            return ()
        return self._advance_lockstep(now_ns) if self._waits else self._advance_realtime(now_ns)

    def _advance_lockstep(self, now_ns: int) -> Sequence[Message]:
        if not self._is_complete():
            return ()
        if self._tick + 1 == self._ticks:
            # The record is complete only with the truth of the last interval.
            return self._finish() if self._last_truth >= self._tick else ()
        if now_ns < self._due_ns() or self._is_held(now_ns):
            return ()
        opened = self._open(now_ns)
        return [*opened, *self._advance(now_ns)] if self._diverged else opened

    def _advance_realtime(self, now_ns: int) -> Sequence[Message]:
        late = self._members - self._answered
        last = self._tick + 1 == self._ticks
        if now_ns < self._due_ns() or (late and self._clock.on_overrun == "hold"):
            return ()
        if last and self._last_truth < self._tick:
            return ()
        self._overruns += len(late)
        overrun = self._overrun(now_ns, late)
        if overrun:
            return self._stop("aborted", overrun, EXIT_OVERRUN)
        return self._finish() if last else self._open(now_ns)

    def _finish(self) -> Sequence[Message]:
        if self._diverged:
            return self._stop("diverged", self._diverged, EXIT_DIVERGED)
        return self._stop("completed", "", 0)

    def _overrun(self, now_ns: int, late: set[int]) -> str:
        """Why the deadline policy ends the run, or nothing."""
        clock = self._clock
        if clock.on_overrun != "abort":
            return ""
        if self._overruns > clock.overrun_limit:
            names = ", ".join(agent_name(agent) for agent in sorted(late))
            return (
                f"{names} missed the deadline of tick {self._tick} at {self._time(self._tick + 1)}: "
                f"{self._overruns} missed in all, {clock.overrun_limit} allowed"
            )
        worst_s = max(self._overrun_ns, now_ns - self._due_ns()) / 1e9
        if clock.overrun_limit_s is not None and worst_s > clock.overrun_limit_s:
            return f"tick {self._tick + 1} came {worst_s:.3f} s late, {clock.overrun_limit_s:g} s allowed"
        return ""

    def _open(self, now_ns: int) -> list[Message]:
        """Open the next tick, for those who have come back, too."""
        news: list[Message] = []
        if self._joining:
            names = ", ".join(agent_name(agent) for agent in sorted(self._joining))
            for agent, incarnation in self._joining.items():
                self._incarnations[agent_name(agent)] = incarnation
                self._owes_ns.pop(agent, None)
            self._members |= self._joining.keys()
            self._joining = {}
            changes = [self._out.again(change) for change in self._changes]
            news = [*changes, self._roster(f"{names} joined at {self._time(self._tick + 1)}", self._tick + 1)]
        news += self._uav_news(self._tick + 1)
        answered, shared = tuple(sorted(self._answered)), tuple(sorted(self._shared))
        late_ns = 0 if self._waits or self._tick < 0 else max(0, now_ns - self._due_ns())
        if self._clock.on_overrun == "hold" and not self._waits:
            self._start_ns += late_ns  # the deadlines move by what was waited
        overrun_ns, self._overrun_ns = self._overrun_ns, 0
        self._tick += 1
        self._answered, self._shared, self._negotiating = set(), set(), {}
        self._opened_ns = now_ns
        if self._last_truth + 1 == self._tick:
            self._truth_ns = now_ns
        for agent in self._members:
            self._owes_ns.setdefault(agent, now_ns)
        return [
            *news,
            self._out.stamp(
                Tick,
                tick=self._tick,
                members=tuple(sorted(self._members)),
                answered=answered,
                shared=shared,
                roster=self._roster_version,
                late_ns=late_ns,
                overrun_ns=overrun_ns,
            ),
        ]

    def _uav_news(self, tick: int) -> list[Message]:
        """Report the UAVs whose motors or rods fail at a tick, as their flight controllers would: not before."""
        news: list[Message] = []
        while self._uav_faults and self._uav_faults[0][0] <= tick:
            _, what, uav = self._uav_faults.pop(0)
            self._off.add(uav + 1)
            if what == "release":
                self._released.add(uav + 1)
            words = "released" if what == "release" else "motors off"
            news.append(self._roster(f"{uav_name(uav)} {words} at {self._time(tick)}", tick))
        return news

    def _roster(self, reason: str, tick: int | None = None) -> Roster:
        members = sorted(self._members)
        self._roster_version += 1
        return self._out.stamp(
            Roster,
            tick=max(self._tick, 0) if tick is None else tick,
            version=self._roster_version,
            agents=tuple(members),
            incarnations=tuple(self._incarnations[agent_name(agent)] for agent in members),
            off=tuple(sorted(self._off)),
            released=tuple(sorted(self._released)),
            reason=reason,
        )

    def _stop(self, outcome: Outcome, reason: str, exit_code: int) -> Sequence[Message]:
        control = self._out.stamp(Control, tick=max(self._tick, 0), outcome=outcome, reason=reason, exit_code=exit_code)
        self.finished = control
        return [control]

    def _time(self, tick: int) -> str:
        return f"t = {tick * self._period_ns / 1e9:.2f} s"


def _returns(setup: Setup) -> dict[int, set[int]]:
    """Agents that scripted faults bring back, by the tick they are to be back at."""
    found: dict[int, set[int]] = {}
    for fault in setup.faults:
        if fault.do in ("continue", "start") and fault.target.startswith("agent"):
            found.setdefault(fault.tick, set()).add(int(fault.target.removeprefix("agent")))
    return found
