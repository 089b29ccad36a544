"""Sampling clocks, when a tick opens and which answers to it are late; and the roster of a run with its changes."""

from collections.abc import Collection

from protocol.scenario.faults import uav_faults, uav_name
from protocol.scenario.setup import Setup
from protocol.wire.messages import Plan, Roster, agent_name
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


# A process that wakes up so much later than planned was frozen, or had no processor to run on.
_AWAY_NS = 200_000_000


class Clock:
    """Sampling clock of a run. Ticks are due relative to the first one, so that delays do not add up.

    In lockstep it waits for the answers of all agents; a speed above 0 holds the next tick until it is due. In real
    time it opens ticks at their deadlines; `clock.on_overrun` says what happens when plans miss them.

    All times are ns on a clock that only goes forward. `missing` are the agents on the roster that have not answered
    the open tick; `awaits_plant` says that only the plant's last state is outstanding.

    Attributes:
        counts_late_plans: Whether a plan of an earlier tick than the open one shows that its agent is alive: in real
            time.
        waiting_since_ns: Start of the barrier timeout.
    """

    def __init__(self, setup: Setup) -> None:
        self.waiting_since_ns = 0
        self._settings, self._period_ns = setup.scenario.clock, setup.period_ns
        self.counts_late_plans = self._settings.mode == "realtime"
        self._barrier_ns = round(self._settings.barrier_timeout_s * 1e9)
        self._start_ns = self._plant_ns = 0
        self._owed_since_ns: dict[int, int] = {}  # by agent: since when it owes an answer
        self._overrun_ns = 0  # largest overrun of a plan since the last tick
        self._overruns = 0  # missed deadlines
        self._called_ns = 0  # when the coordinator last handled something
        self._excused_tick = -1  # newest tick at which it was found to have stood still

    def due_ns(self, tick: int) -> int:
        """Return the earliest time at which a tick may open."""
        speed = self._settings.speed
        return 0 if speed == 0.0 else self._start_ns + round(tick * self._period_ns / speed)

    def has_expired(self, now_ns: int) -> bool:
        """Return whether the barrier timeout is over."""
        return now_ns >= self.waiting_since_ns + self._barrier_ns

    def excuse_absence(self, tick: int, wake_ns: int | None, now_ns: int) -> None:
        """Restart all timeouts if the coordinator woke up late: answers that came meanwhile are still to be read.

        At most once in a tick: a process that is always late must still find out which agents are gone.
        """
        called_ns, self._called_ns = self._called_ns, now_ns
        if wake_ns is None or self._excused_tick == tick or now_ns <= max(wake_ns, called_ns) + _AWAY_NS:
            return
        self._excused_tick = tick
        self.waiting_since_ns = self._plant_ns = now_ns
        self._owed_since_ns = dict.fromkeys(self._owed_since_ns, now_ns)

    def open(self, tick: int, members: Collection[int], joined: Collection[int], now_ns: int) -> None:
        """Note that a tick is opened for the members of the roster, some of which have just joined."""
        if tick == 0:
            self._start_ns = now_ns
        self.waiting_since_ns, self._overrun_ns = now_ns, 0
        for agent in joined:
            self._owed_since_ns.pop(agent, None)
        for agent in members:
            self._owed_since_ns.setdefault(agent, now_ns)

    def answer(self, plan: Plan, tick: int, now_ns: int) -> None:
        """Note an agent's plan while a tick is open."""
        self._owed_since_ns[plan.agent] = now_ns
        if plan.tick == tick:
            del self._owed_since_ns[plan.agent]
        self._overrun_ns = max(self._overrun_ns, now_ns - self.due_ns(plan.tick + 1))

    def plant_answer(self, now_ns: int) -> None:
        """Note that the plant has answered, or that it has only now been asked for the next interval."""
        self._plant_ns = now_ns

    def lateness_ns(self, tick: int, now_ns: int) -> tuple[int, int]:
        """Return how late a tick opens, and by how much the latest plan since the tick before missed its deadline.

        Both are 0 in lockstep, where messages do not depend on wall-clock time.
        """
        if not self.counts_late_plans:
            return 0, 0
        late_ns = max(0, now_ns - self.due_ns(tick)) if tick > 0 else 0
        if self._settings.on_overrun == "hold":
            self._start_ns += late_ns  # all later deadlines move by the wait
        return late_ns, self._overrun_ns

    def silent(self, members: set[int], missing: set[int], now_ns: int) -> set[int]:
        """Return the agents that have owed an answer for the barrier timeout."""
        if not self.counts_late_plans:
            return missing if self.has_expired(now_ns) else set()
        return {a for a in members if now_ns >= self._owed_since_ns.get(a, now_ns) + self._barrier_ns}

    def plant_is_silent(self, now_ns: int) -> bool:
        """Return whether the plant has owed an answer for the barrier timeout while agents still answer.

        In lockstep agents without measurements do not answer either.
        """
        return self.counts_late_plans and now_ns >= self._plant_ns + self._barrier_ns

    def may_close(self, tick: int, missing: set[int], now_ns: int, *, last: bool) -> bool:
        """Return whether the open tick may be closed; in lockstep the last one closes with its last answer."""
        is_due = now_ns >= self.due_ns(tick + 1) or (last and not self.counts_late_plans)
        return is_due and not self._waits_for(missing)

    def overrun(self, tick: int, missing: set[int], now_ns: int) -> str:
        """Count the deadlines missed in a tick that is closed; return why they end the run, or an empty text."""
        self._overruns += len(missing)
        settings = self._settings
        if settings.on_overrun != "abort" or not self.counts_late_plans:
            return ""
        if self._overruns > settings.overrun_limit:
            names = ", ".join(agent_name(agent) for agent in sorted(missing))
            at_s = (tick + 1) * self._period_ns / 1e9
            return (
                f"{names} missed the deadline of tick {tick} at t = {at_s:.2f} s: "
                f"{self._overruns} missed in total, {settings.overrun_limit} allowed"
            )
        worst_s = max(self._overrun_ns, now_ns - self.due_ns(tick + 1)) / 1e9
        if settings.overrun_limit_s is not None and worst_s > settings.overrun_limit_s:
            return f"tick {tick + 1} was {worst_s:.3f} s late, {settings.overrun_limit_s:g} s allowed"
        return ""

    def wake_ns(self, tick: int, missing: set[int], *, awaits_plant: bool) -> int:
        """Return when the open tick may be closed at the earliest, or else when the barrier timeout ends."""
        waits = awaits_plant or self._waits_for(missing)
        return self.waiting_since_ns + self._barrier_ns if waits else self.due_ns(tick + 1)

    def _waits_for(self, missing: set[int]) -> bool:
        return bool(missing) and (not self.counts_late_plans or self._settings.on_overrun == "hold")
