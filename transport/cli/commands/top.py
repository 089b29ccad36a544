"""Command `transport top`: a table of the agents of an active run, read from its growing log."""

import os
import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group
from rich.live import Live
from rich.text import Text
from typer import Option

from transport.cli.active import RunOption, find_active
from transport.cli.options import run_folder
from transport.cli.output import Format, fail, rows, show
from transport.flight import active_runs
from transport.log.run_folder import setup_of
from transport.log.run_log import LogTail
from transport.model.state import StateView
from transport.plant.actuator_schedule import FAIL_SAFE
from transport.protocol.scenario.setup.cost_of_run import StageCost
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.errors_and_exit_codes import EXIT_UNREACHABLE
from transport.protocol.wire.messages import (
    STAGES,
    Control,
    Message,
    PlantState,
    Rejected,
    Roster,
    StepReport,
    Target,
    Tick,
    agent_name,
)

# Number of steps for the longest step time, and of kept notices.
_RECENT = 100
_NOTICES = 5
_TOTAL = STAGES.index("total")  # time of a step in a report
# An agent is silent after this many ticks without a report.
_BEHIND = 5
# Counts of an agent that the table only has if they are not zero.
_RARE = ("missed", "fallbacks", "failures", "rejected", "removed")
_COLOURS = {"active": "green", "silent": "yellow", "off": "red", "fail-safe": "bold red"}
_DRAW_S = 0.25  # interval between two tables on a terminal
_NICE = 10  # the processes of the run have the processors first
_ADVICE = "name its folder with --run"


@dataclass(slots=True, kw_only=True)
class AgentRow:
    """What the messages have told of an agent: its row as JSON and in the table, in this order."""

    agent: int
    uavs: list[int]  # 1-based
    state: str = "-"
    tick: int | None = None  # of the newest report; None before the first, as all of its numbers
    step_ms: float | None = None  # of that step
    worst_ms: float | None = None  # of the last `_RECENT` steps
    # Of the other agents, in their order, ticks; -1 for none.
    plan_ages: list[int] | None = None
    lost: int = 0  # plans lost on their links to the agent
    late: int = 0  # plans older than one tick when they came
    # Plans of the agent that were not there when the next tick opened, in real time.
    missed: int = 0
    fallbacks: int = 0
    failures: int = 0  # steps whose solve failed
    rejected: int = 0  # messages that the agent refused
    removed: int = 0  # times taken off the roster
    recent_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_RECENT))

    def take(self, report: StepReport) -> None:
        """Take note of a step."""
        self.recent_ms.append(float(report.times_ms[_TOTAL]))
        self.tick = report.tick
        self.step_ms = self.recent_ms[-1]
        self.worst_ms = max(self.recent_ms)
        self.plan_ages = list(report.plan_ages)
        self.lost += report.lost
        self.late += report.late
        self.fallbacks += report.fallback
        self.failures += report.status != "solved"

    def as_json(self) -> dict[str, Any]:
        """Return the row without the step times it was made from."""
        content = asdict(self)
        del content["recent_ms"]
        return content


class Watch:
    """Status of a run, as far as its messages have been taken."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        # By number; `content` fills in `state` and `rejected`.
        self.agents: dict[int, AgentRow] = {
            agent: AgentRow(agent=agent, uavs=[uav + 1 for uav in setup.owned[agent - 1]])
            for agent in setup.agents
        }
        self.members: frozenset[int] | None = None  # agents on the roster; None while unknown
        self.tick = -1  # newest open tick, -1 before the first
        self.plant_state: PlantState | None = None  # newest
        self.control: Control | None = None  # end of the run
        self.notices: deque[str] = deque(maxlen=_NOTICES)  # latest changes of the roster
        self.rejections = Counter[str]()  # rejected messages by receiver
        self._opened: Tick | None = None
        self._cost = StageCost(setup)

    def read(self, tail: LogTail) -> None:
        """Take the new messages of a log."""
        for message in tail.read():
            self.take(message)

    def take(self, message: Message) -> None:
        """Update the status from any message."""
        match message:
            case Tick():
                self._open(message)
            case StepReport():
                self.agents[message.agent].take(message)
            case PlantState():
                self.plant_state = message
            case Target():
                self.setup = self.setup.after([message])
            case Roster():
                members = frozenset(message.agents)
                for agent in (self.members or frozenset()) - members:
                    self.agents[agent].removed += 1
                self.members = members
                self.notices.append(message.reason)
            case Rejected():
                self.rejections[message.sender] += message.count
            case Control():
                self.control = message

    def state_of(self, agent: int) -> str:
        """Return the state of an agent: active, silent, off (the roster), or fail-safe.

        "-" while unknown.
        """
        uavs = self.setup.owned[agent - 1]
        plant_state = self.plant_state
        if plant_state is not None:
            sources = [plant_state.plan_ticks[uav] for uav in uavs]
            if FAIL_SAFE in sources:
                return "fail-safe"
        if self.members is not None and agent not in self.members:
            return "off"

        tick = self.agents[agent].tick
        if tick is None:
            return "-"
        return "active" if self.tick - tick <= _BEHIND else "silent"

    def content(self) -> dict[str, Any]:
        """Return the status as JSON data."""
        cost, attitude_deg = self._performance()
        for number, row in self.agents.items():
            row.state = self.state_of(number)
            row.rejected = self.rejections[agent_name(number)]

        return {
            "scenario": self.setup.scenario.name,
            "tick": self.tick,
            "ticks": self.setup.ticks,
            "time_s": max(self.tick, 0) * self.setup.settings.sampling_period_s,
            "cost": cost,
            "attitude_deg": attitude_deg,
            "outcome": self.control and self.control.outcome,
            "reason": self.control and self.control.reason,
            "rejections": dict(self.rejections),
            "notices": list(self.notices),
            "agents": [row.as_json() for row in self.agents.values()],
        }

    def _performance(self) -> tuple[float | None, float | None]:
        """Return stage cost and payload attitude, deg, of the newest state.

        None before the first.
        """
        plant_state = self.plant_state
        if plant_state is None:
            return None, None

        t_s = plant_state.tick * self.setup.settings.sampling_period_s
        y = self.setup.model.outputs(plant_state.x)
        y_ref = self.setup.reference.outputs(np.array([t_s]))[0]
        cost = self._cost.at(plant_state.tick, y, y_ref, plant_state.u)
        attitude_deg = float(np.degrees(np.abs(StateView(plant_state.x).Theta0)).max())
        return cost, attitude_deg

    def _open(self, tick: Tick) -> None:
        """Take note of an opened tick, in real time also of the agents that missed its deadline."""
        before = self._opened
        is_realtime = self.setup.scenario.clock.mode == "realtime"
        if is_realtime and before is not None and tick.tick == before.tick + 1:
            for agent in set(before.members) - set(tick.answered):
                self.agents[agent].missed += 1

        if self.members is None:
            self.members = frozenset(tick.members)
        self.tick = tick.tick
        self._opened = tick


def top(
    run: RunOption = None,
    once: bool = Option(False, "--once", help="Print one table and exit."),
    output: Format = Option(
        Format.text, "--format", metavar="FORMAT", help="Output format, with --once."
    ),
) -> None:
    """Watch the agents of an active run.

    A table of tick, step time, plan ages, lost messages, faults and rejections, until the run ends.
    The command reads the log of the run as it grows: no process of the run waits for it or knows
    it.

    Exit codes: 0 the run has ended, or --once; 2 no such run; 4 it ended without an outcome; 130
    Ctrl-C.

    Example: transport top --run runs/20260102-101500-paper
    """
    if output is Format.json and not once:
        fail("--format json: expected it with --once, got it without")
    folder = run_folder(Path(run)) if run is not None else find_active(None, _ADVICE)[0]
    log = folder / "run.mcap"
    if not log.exists():
        fail(f"--run: expected a run folder with a log, got {folder}")

    os.nice(_NICE)
    watch = Watch(setup_of(folder))
    tail = LogTail(log)
    name = folder.resolve().name
    is_marked = active_runs.read(folder) is not None  # a run started by hand is not

    def goes_on() -> bool:
        """Return whether the log may still grow: a marked run that has ended removes its mark."""
        return not tail.ended and (active_runs.read(folder) is not None) == is_marked

    with Live(auto_refresh=False, transient=True) as screen:
        while not once and goes_on():
            watch.read(tail)
            screen.update(table_of(watch, name), refresh=True)
            time.sleep(_DRAW_S)

    watch.read(tail)
    show(output, {"run": name, **watch.content()}, table_of(watch, name))
    if watch.control is None and not once:
        fail(f"{folder}: the log ends without an outcome", EXIT_UNREACHABLE)


def table_of(watch: Watch, run: str) -> Group:
    """Return the table of a run by name."""
    content = watch.content()
    outcome = content["outcome"]
    title = Text(run, "bold")
    if outcome:
        reason = f": {content['reason']}" if content["reason"] else ""
        title.append(f"  {outcome}{reason}", "bold green" if outcome == "completed" else "bold red")

    end_s = watch.setup.ticks * watch.setup.settings.sampling_period_s
    progress = f"tick {watch.tick} of {watch.setup.ticks}, {content['time_s']:.2f} of {end_s:.2f} s"
    if watch.plant_state is not None:
        progress += f"  cost {content['cost']:.5f}  attitude {content['attitude_deg']:.2f} deg"

    refused = [f"refused by {name}: {count}" for name, count in watch.rejections.items()]
    lines = [Text(f" {line}", "yellow") for line in (*content["notices"], *refused)]
    cells = [_cells(agent) for agent in content["agents"]]
    return Group(title, Text(progress), rows(cells, "uavs", "state", "plan ages", ""), *lines)


def _cells(agent: Mapping[str, Any]) -> dict[str, Any]:
    """Return the row of an agent: its values, and in the last column rare counts above zero."""
    values = {name.replace("_", " "): value for name, value in agent.items() if name not in _RARE}
    values["state"] = Text(agent["state"], _COLOURS.get(agent["state"], ""))
    rare = ", ".join(f"{agent[name]} {name}" for name in _RARE if agent[name])
    return values | {"": Text(rare, "yellow")}
