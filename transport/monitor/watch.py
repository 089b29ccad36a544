"""Status of an active run, gathered from its messages."""

from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from model.state import StateView
from plant.schedule import FAIL_SAFE
from protocol.scenario.setup import Setup
from protocol.scenario.stage_cost import StageCost
from protocol.wire.messages import (
    Control,
    Message,
    PlantState,
    Rejected,
    Roster,
    StepReport,
    Tick,
    agent_name,
)

# Number of steps for the longest step time, and of kept notices.
_RECENT, _NOTICES = 100, 5

# An agent is silent after this many ticks without a report.
_BEHIND = 5

_COUNTS = (
    "lost",  # plans of others that were lost
    "late",  # plans of others that came more than one tick late
    "missed",  # missed deadlines; real time only
    "fallbacks",  # solves by the second solver
    "failures",  # solves by neither solver
    "off_the_roster",  # removals from the roster
)


@dataclass(slots=True)
class AgentStatus:
    """Status of one agent; counts are since the start of watching."""

    report: StepReport | None = None  # newest, None before the first
    slack_ms: float | None = None  # rest of the period at the arrival of that report, ms; None in an unpaced run
    recent_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_RECENT))  # times of the latest steps, ms
    counts: Counter[str] = field(default_factory=lambda: Counter(dict.fromkeys(_COUNTS, 0)))


@dataclass(slots=True)
class Watch:
    """Status of a run since the start of watching."""

    setup: Setup
    agents: dict[int, AgentStatus] = field(init=False)  # by number
    members: frozenset[int] | None = None  # agents on the roster; None while unknown
    tick: int = -1  # newest open tick, -1 before the first
    plant_state: PlantState | None = None  # newest
    control: Control | None = None  # end of the run
    notices: deque[str] = field(default_factory=lambda: deque(maxlen=_NOTICES))  # latest changes of the roster
    rejections: Counter[str] = field(default_factory=Counter)  # rejected messages by receiver
    _opened: Tick | None = None
    _opened_ns: int = 0
    _first: tuple[int, int] | None = None  # tick and time
    _cost: StageCost = field(init=False)

    def __post_init__(self) -> None:
        self.agents = {agent: AgentStatus() for agent in self.setup.agents}
        self._cost = StageCost(self.setup)

    def take(self, message: Message, at_ns: int) -> None:
        """Update the status from any message; its arrival is on any steady clock, ns."""
        match message:
            case Tick():
                self._open(message, at_ns)
            case StepReport():
                self._report(message, at_ns)
            case PlantState():
                self.plant_state = message
            case Roster():
                self._join(frozenset(message.agents), message.reason)
            case Rejected():
                self.rejections[message.sender] += message.count
            case Control():
                self.control = message

    @property
    def is_whole(self) -> bool:
        """Whether the plant state and a report of every agent on the roster have arrived."""
        return (
            self.plant_state is not None
            and self.members is not None
            and all(self.agents[agent].report is not None for agent in self.members)
        )

    @property
    def real_time_factor(self) -> float | None:
        """Scenario time per wall time since the start of watching; None before two ticks."""
        if self._first is None or self.tick <= self._first[0]:
            return None
        wall_s = (self._opened_ns - self._first[1]) / 1e9
        return (self.tick - self._first[0]) * self.setup.settings.sampling_period_s / wall_s if wall_s > 0.0 else None

    @property
    def cost(self) -> float | None:
        """Stage cost of the whole team at the newest recorded tick, docs/equations.md (21)."""
        state = self.plant_state
        if state is None:
            return None
        y_ref = self.setup.reference.outputs(np.array([state.tick * self.setup.settings.sampling_period_s]))[0]
        return self._cost.at(state.tick, self.setup.model.outputs(state.x), y_ref, state.u)

    @property
    def attitude_deg(self) -> float | None:
        """Largest magnitude of the payload's roll, pitch and yaw, deg."""
        if self.plant_state is None:
            return None
        return float(np.degrees(np.abs(StateView(self.plant_state.x).Theta0)).max())

    def state_of(self, agent: int) -> str:
        """Return the state of an agent: active, silent, off (the roster), or fail-safe; "-" while unknown."""
        uavs = self.setup.owned[agent - 1]
        if self.plant_state is not None and any(self.plant_state.plan_ticks[uav] == FAIL_SAFE for uav in uavs):
            return "fail-safe"
        if self.members is not None and agent not in self.members:
            return "off"
        report = self.agents[agent].report
        if report is None:
            return "-"
        return "active" if self.tick - report.tick <= _BEHIND else "silent"

    def content(self) -> dict[str, Any]:
        """Return the status as JSON data."""
        agents = []
        for number, agent in self.agents.items():
            report = agent.report
            agents.append(
                {
                    "agent": number,
                    "uavs": [uav + 1 for uav in self.setup.owned[number - 1]],
                    "state": self.state_of(number),
                    "tick": report and report.tick,
                    "step_ms": report and float(report.times_ms[-1]),
                    "worst_step_ms": max(agent.recent_ms, default=None),
                    "slack_ms": agent.slack_ms,
                    "plan_ages": report and dict(zip(map(agent_name, report.peers), report.plan_ages, strict=True)),
                    **agent.counts,
                    "rejected": self.rejections[agent_name(number)],
                }
            )
        return {
            "scenario": self.setup.scenario.name,
            "tick": self.tick,
            "ticks": self.setup.ticks,
            "time_s": max(self.tick, 0) * self.setup.settings.sampling_period_s,
            "real_time_factor": self.real_time_factor,
            "cost": self.cost,
            "attitude_deg": self.attitude_deg,
            "agents": agents,
            "notices": list(self.notices),
            "rejections": dict(self.rejections),
            "outcome": self.control and self.control.outcome,
            "reason": self.control and self.control.reason,
        }

    def _open(self, tick: Tick, at_ns: int) -> None:
        realtime, before = self.setup.scenario.clock.mode == "realtime", self._opened
        if realtime and before is not None and tick.tick == before.tick + 1:
            for agent in set(before.members) - set(tick.answered):
                self.agents[agent].counts["missed"] += 1
        if self.members is None:
            self.members = frozenset(tick.members)
        self.tick, self._opened, self._opened_ns = tick.tick, tick, at_ns
        self._first = self._first or (tick.tick, at_ns)

    def _report(self, report: StepReport, at_ns: int) -> None:
        agent = self.agents[report.agent]
        agent.report = report
        agent.recent_ms.append(float(report.times_ms[-1]))
        failed = report.status != "solved"
        agent.counts.update(lost=report.lost, late=report.late, fallbacks=report.fallback, failures=failed)
        speed = self.setup.scenario.clock.speed
        if speed > 0.0 and self._opened is not None and self._opened.tick == report.tick:
            left_ns = self.setup.period_ns / speed - self._opened.late_ns - (at_ns - self._opened_ns)
            agent.slack_ms = left_ns / 1e6

    def _join(self, members: frozenset[int], reason: str) -> None:
        for agent in (self.members or frozenset()) - members:
            self.agents[agent].counts["off_the_roster"] += 1
        self.members = members
        self.notices.append(reason)
