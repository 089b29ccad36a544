"""The roster of a run and its changes: agents that leave, join and return, UAVs that fail."""

from collections.abc import Collection

from protocol.scenario.faults import uav_faults, uav_name
from protocol.scenario.setup import Setup
from protocol.wire.messages import Roster, agent_name
from protocol.wire.node import Outbox


class TeamRoster:
    """The agents that take part in a run, and the messages that announce them.

    Attributes:
        agents: All agents of the run, by process name.
        members: Agents on the roster.
        joining: Agents to be put on the roster when the next tick opens, with their incarnations.
        incarnations: Newest incarnations of the processes that take part, by name.
        version: Version of the newest roster.
    """

    def __init__(self, setup: Setup, out: Outbox) -> None:
        self.agents = {agent_name(agent): agent for agent in setup.agents}
        self.members = set(setup.agents)
        self.joining: dict[int, int] = {}
        self.incarnations: dict[str, int] = {}
        self.version = 0
        self._out, self._period_ns = out, setup.period_ns
        self._uav_faults = list(uav_faults(setup.faults))  # still to be reported
        self._off: set[int] = set()  # UAVs without motors, 1-based
        self._released: set[int] = set()
        self._returns: dict[int, set[int]] = {}  # agents that scripted faults bring back, by tick
        if setup.scenario.clock.mode == "lockstep":
            for fault in setup.faults:
                if fault.do in ("continue", "start") and fault.target in self.agents:
                    self._returns.setdefault(fault.tick, set()).add(self.agents[fault.target])

    def time(self, tick: int) -> str:
        """Return the time of a tick as text."""
        return f"t = {tick * self._period_ns / 1e9:.2f} s"

    def message(self, reason: str, tick: int) -> Roster:
        """Return the next version of the roster, which holds from a tick on."""
        members = sorted(self.members)
        self.version += 1
        return self._out.stamp(
            Roster,
            tick=max(tick, 0),
            version=self.version,
            agents=tuple(members),
            incarnations=tuple(self.incarnations[agent_name(agent)] for agent in members),
            off=tuple(sorted(self._off)),
            released=tuple(sorted(self._released)),
            reason=reason,
        )

    def awaited(self, tick: int) -> set[int]:
        """Return the agents a tick waits for: scripted faults bring them back at it, and they are not ready yet."""
        return self._returns.get(tick, set()) - self.joining.keys() - self.members

    def give_up(self, tick: int) -> Roster:
        """Return the roster without the agents that a tick has waited for."""
        reason = f"{names(self._returns.pop(tick))} did not return at {self.time(tick)}"
        return self.message(reason, tick - 1)

    def join(self, tick: int) -> tuple[set[int], list[Roster]]:
        """Put the joining agents on the roster at a tick; return them, and the roster if there are any."""
        joined, self.joining = self.joining, {}
        self.members |= joined.keys()
        self.incarnations |= {agent_name(agent): incarnation for agent, incarnation in joined.items()}
        rosters = [self.message(f"{names(joined)} joined at {self.time(tick)}", tick)] if joined else []
        return set(joined), rosters

    def fail_uavs(self, tick: int) -> list[Roster]:
        """Return rosters that report the UAVs whose motors or rods fail at a tick, never before it."""
        rosters = []
        while self._uav_faults and self._uav_faults[0][0] <= tick:
            _, action, uav = self._uav_faults.pop(0)
            self._off.add(uav + 1)
            if action == "release":
                self._released.add(uav + 1)
            event = "released" if action == "release" else "motors off"
            rosters.append(self.message(f"{uav_name(uav)} {event} at {self.time(tick)}", tick))
        return rosters


def names(agents: Collection[int]) -> str:
    """Return the process names of agents as text."""
    return ", ".join(agent_name(agent) for agent in sorted(agents))
