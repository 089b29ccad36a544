"""The roster of a run: which agents take part, in which incarnation, and the messages about it."""

from collections import deque
from collections.abc import Collection, Mapping
from collections.abc import Set as AbstractSet

from transport.protocol.scenario.faults.faults_by_tick import failures
from transport.protocol.scenario.setup.run_rules import RunRules
from transport.protocol.wire.messages import Message, Roster
from transport.protocol.wire.names import agent_name, agent_names
from transport.protocol.wire.outbox import Outbox


class TeamRoster:
    """The agents that take part in a run.

    An agent is in one of three states. All are on the roster at the start.

        from      to        by                                     told
        on        off       `remove`: gone, or silent too long     with a roster, at once
        on, off   joining   `ready`: a higher incarnation          by nothing: no tick has it yet
        joining   on        `join`: the next tick opens            with a roster, before that tick
        joining   off       `gone` of the joining incarnation      by nothing

    An agent that is on the roster and ready in a higher incarnation has to be removed by the caller
    as well: its old process is gone. A change is announced with a roster, whose version ticks name: no
    process opens the next tick without that version. Only this class changes what it knows.
    """

    def __init__(self, rules: RunRules, out: Outbox) -> None:
        self._period_ns = rules.period_ns
        self._out = out
        self._agents = {agent_name(agent): agent for agent in rules.agents}
        self._members = set(rules.agents)
        self._joining: dict[int, int] = {}  # incarnations, by agent
        # Newest ones of the processes that take part, by name; of the agents, those on the roster.
        self._incarnations: dict[str, int] = {}
        self._version = 0

        self._uav_faults = deque(failures(rules.faults))  # still to be reported
        self._off: set[int] = set()  # UAVs without motors, 1-based
        self._released: set[int] = set()  # UAVs off their rods, 1-based
        self._returns = _scripted_returns(rules, self._agents)

    @property
    def agents(self) -> Mapping[str, int]:
        """All agents of the run, by process name."""
        return self._agents

    @property
    def members(self) -> AbstractSet[int]:
        """The agents on the roster."""
        return self._members

    @property
    def joining(self) -> AbstractSet[int]:
        """The agents that are put on the roster when the next tick opens."""
        return self._joining.keys()

    @property
    def version(self) -> int:
        """Version of the newest roster."""
        return self._version

    def time(self, tick: int) -> str:
        """Return the time of a tick as text; that of tick 0 before it."""
        return f"t = {max(tick, 0) * self._period_ns / 1e9:.2f} s"

    def is_newest(self, name: str, incarnation: int) -> bool:
        """Return whether an incarnation of a process is the newest that takes part."""
        return self._incarnations.get(name) == incarnation

    def start(self, name: str, incarnation: int) -> None:
        """Take in a process that is ready before the first tick; the newest of several counts."""
        before = self._incarnations.get(name, -1)
        self._incarnations[name] = max(incarnation, before)

    def ready(self, name: str, incarnation: int) -> bool:
        """Let a higher incarnation of an agent join at the next tick; return whether it is one."""
        agent = self._agents[name]
        newest = max(self._incarnations.get(name, -1), self._joining.get(agent, -1))
        if incarnation <= newest:
            return False
        self._joining[agent] = incarnation
        return True

    def replace(self, name: str, incarnation: int) -> None:
        """Take in a new incarnation of a process that is not an agent, which takes part at once."""
        self._incarnations[name] = incarnation

    def gone(self, name: str, incarnation: int) -> None:
        """Forget an incarnation of an agent that has not joined yet."""
        agent = self._agents.get(name)
        if agent is not None and self._joining.get(agent) == incarnation:
            del self._joining[agent]

    def remove(self, agents: Collection[int]) -> None:
        """Take agents off the roster."""
        self._members -= set(agents)

    def follow(self, version: int) -> None:
        """Go on after a version of the roster that an earlier coordinator has announced."""
        self._version = version

    def message(self, reason: str, tick: int) -> Roster:
        """Return the next version of the roster, which holds from a tick on.

        A tick that opens takes the roster's changes along; see `report` for changes between ticks.
        """
        members = sorted(self._members)
        self._version += 1
        return self._out.stamp(
            Roster,
            tick=max(tick, 0),
            version=self._version,
            agents=tuple(members),
            incarnations=tuple(self._incarnations[agent_name(agent)] for agent in members),
            off=tuple(sorted(self._off)),
            released=tuple(sorted(self._released)),
            reason=reason,
        )

    def report(self, reason: str, upcoming: int) -> Roster:
        """Return a roster whose members are as before, and which only tells the reason.

        It belongs to the tick that is still open, the one before the upcoming tick.
        """
        return self.message(reason, upcoming - 1)

    def due_back(self, tick: int) -> set[int]:
        """Return the agents that the script brings back at a tick, and that are not ready yet."""
        return self._returns.get(tick, set()) - self._joining.keys() - self._members

    def give_up(self, tick: int) -> Roster:
        """Return the roster without the agents that a tick has waited for."""
        absent = agent_names(self.due_back(tick))
        del self._returns[tick]
        return self.report(f"{absent} did not return at {self.time(tick)}", tick)

    def join(self, tick: int) -> Roster:
        """Put the joining agents on the roster at a tick that opens."""
        self._members |= self._joining.keys()
        for agent, incarnation in self._joining.items():
            self._incarnations[agent_name(agent)] = incarnation

        reason = f"{agent_names(self._joining)} joined at {self.time(tick)}"
        self._joining = {}
        return self.message(reason, tick)

    def report_failures(self, tick: int) -> list[Message]:
        """Return a roster for each failure of a UAV that is due at a tick."""
        messages: list[Message] = []
        while self._uav_faults and self._uav_faults[0].tick <= tick:
            fault = self._uav_faults.popleft()
            event = "motors off"
            self._off.add(fault.uav + 1)
            if fault.do == "release":
                event = "released"
                self._released.add(fault.uav + 1)
            messages.append(self.message(f"{fault.target} {event} at {self.time(tick)}", tick))
        return messages


def _scripted_returns(rules: RunRules, agents: Mapping[str, int]) -> dict[int, set[int]]:
    """Return the agents that the script brings back, by tick; in real time no tick waits."""
    returns: dict[int, set[int]] = {}
    if rules.clock.mode != "lockstep":
        return returns
    for fault in rules.faults:
        if fault.do in ("continue", "start") and fault.target in agents:
            returns.setdefault(fault.tick, set()).add(agents[fault.target])
    return returns
