"""The command `transport top`: follows the messages of an active run and draws a table of its agents."""

import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NoReturn

import numpy as np
import typer
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text
from typer import Option

from model.state import StateView
from plant.schedule import FAIL_SAFE
from protocol.admission.gate import Gate
from protocol.network.bus import Bus
from protocol.network.endpoints import Endpoints, default_mesh, security_of
from protocol.network.security import SecurityError
from protocol.network.session import BusError
from protocol.scenario.setup import Setup
from protocol.scenario.stage_cost import StageCost
from protocol.scenario.targets import with_targets
from protocol.wire.exit_codes import EXIT_INTERRUPTED, EXIT_SCENARIO, EXIT_UNREACHABLE, EXIT_USAGE
from protocol.wire.keys import RECORDER, WATCHER, Keys
from protocol.wire.messages import (
    Control,
    Message,
    PlantState,
    Presence,
    Rejected,
    Roster,
    StepReport,
    Target,
    Tick,
    agent_name,
)
from protocol.wire.names import COORDINATOR
from transport.cli.active_run import ConnectOption, RunOption, find_active
from transport.cli.output import Format, exit_on, fail, show_json
from transport.cli.scenario_setup import read_setup
from transport.flight import live
from transport.flight.harness import keys_setting

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

# The table mentions silence that lasts longer.
_QUIET_S = 2.0

_COLOURS = {"active": "green", "silent": "yellow", "off": "red", "fail-safe": "bold red", "-": ""}
_LEFT = ("UAVs", "state", "plan ages", "QPs")
# Interval between two tables on a terminal, and elsewhere, s.
_DRAW_S, _PRINT_S = 0.25, 10.0
# Messages gather for this long before the process wakes up: wake-ups cost the run processor time.
_GATHER_S = 0.02
# Time that `--once` waits for reports of all agents.
_PATIENCE_S = 5.0
# Time to wait for the outcome of the run after its coordinator has left.
_OVERTAKEN_S = 0.5


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
            case Target():
                self.setup = with_targets(self.setup, [message])
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


@dataclass(frozen=True, slots=True)
class _Run:
    """An active run: its name, where to connect, and what it simulates."""

    name: str
    endpoints: list[str]
    setup: Setup
    is_client: bool = False
    folder: Path | None = None  # of a run that this machine has started


def top(
    run: RunOption = None,
    connect: ConnectOption = None,
    scenario: Annotated[
        str | None, Option("--scenario", metavar="SCENARIO", help="Scenario of a run started by hand: file or name.")
    ] = None,
    settings: Annotated[
        list[str] | None, Option("--set", metavar="KEY=VALUE", help="Changes of that scenario.")
    ] = None,
    once: Annotated[bool, Option("--once", help="Print one table and exit.")] = False,
    output: Annotated[Format, Option("--format", metavar="FORMAT", help="Output format, with --once.")] = Format.text,
) -> None:
    """Watch the agents of an active run.

    A table of tick, step time, slack to the deadline, plan ages, lost messages, faults and rejections, until the run
    ends. The command only listens: no process waits for it, and a lockstep run computes the same bits without it.

    Exit codes: 0 the run has ended, or --once; 2 no such run; 4 no message from it; 130 Ctrl-C.

    Example: transport top --run runs/20260102-101500-paper
    """
    if output is Format.json and not once:
        fail("--format json: expected it with --once, got it without", EXIT_USAGE)
    try:
        with exit_on(SecurityError, code=EXIT_SCENARIO), exit_on(BusError, code=EXIT_UNREACHABLE):
            active = _find(run, connect, scenario, settings)
            with closing(_listen(active)) as bus:
                if once:
                    _print_once(bus, active, output)
                else:
                    _follow(bus, active)
    except KeyboardInterrupt:
        raise typer.Exit(EXIT_INTERRUPTED) from None


def _find(run: str | None, connect: list[str] | None, scenario: str | None, settings: list[str] | None) -> _Run:
    if scenario is not None:
        setup = read_setup(scenario, settings, allow_large=True)
        name = run or setup.scenario.name
        if not Keys.allows(name):
            fail(f"--run: expected the name of a run with --scenario, got {name!r}", EXIT_USAGE)
        router = setup.scenario.network.router
        default = [endpoint for place in default_mesh(setup.scenario).values() for endpoint in place.listen]
        return _Run(name, connect or ([router] if router else default), setup, router is not None)
    if connect:
        fail("--connect: expected --scenario with it, as the run cannot name its scenario", EXIT_USAGE)
    if settings:
        fail("--set: expected --scenario with it, as a run folder has its values", EXIT_USAGE)
    folder, there = find_active(run, "name its folder with --run, or its scenario with --scenario")
    changes = [keys_setting(there.keys)] if there.keys else None
    setup = read_setup(str(folder / "scenario.toml"), changes, allow_large=True)
    endpoints = {at for name, at in there.endpoints.items() if name != RECORDER}
    return _Run(there.run, sorted(endpoints), setup, there.is_client, folder)


def _listen(run: _Run) -> Bus:
    # Without joining: a liveliness token would make the coordinator expect this process.
    return Bus(
        name=WATCHER,
        incarnation=0,
        run=run.name,
        digest=run.setup.scenario.digest(),
        endpoints=Endpoints(
            listen=[],
            connect=run.endpoints,
            mode="client" if run.is_client else "peer",
            security=security_of(run.setup.scenario),
        ),
        gate=Gate(WATCHER, Keys(run.name), run.setup.shape),
        relayed=run.setup.scenario.clock.relayed,
        gather_s=_GATHER_S,
    )


def _print_once(bus: Bus, run: _Run, output: Format) -> None:
    watch = Watch(run.setup)
    _receive(bus, watch, _PATIENCE_S, until_whole=True)
    if watch.tick < 0 and watch.plant_state is None and watch.control is None:
        _fail_silent(run)
    if output is Format.json:
        show_json({"run": run.name, **watch.content()})
    else:
        Console().print(table_of(watch, run.name))


def _follow(bus: Bus, run: _Run) -> None:
    """Draw tables until the run ends."""
    watch, console = Watch(run.setup), Console()
    if console.is_terminal:
        with Live(table_of(watch, run.name), console=console, auto_refresh=False, transient=True) as shown:
            _draw_until_end(bus, run, watch, _DRAW_S, lambda table: shown.update(table, refresh=True))
    else:
        _draw_until_end(bus, run, watch, _PRINT_S, console.print)
    console.print(table_of(watch, run.name))
    if watch.control is None:
        fail(f"run {run.name}: its coordinator is gone, and its outcome was not received", EXIT_UNREACHABLE)


def _draw_until_end(bus: Bus, run: _Run, watch: Watch, interval_s: float, draw: Callable[[Group], None]) -> None:
    begun = time.monotonic()
    quiet_s = 0.0
    while watch.control is None:
        # The first table is drawn as soon as all agents have reported.
        received, gone = _receive(bus, watch, interval_s, until_whole=not watch.is_whole)
        if gone and watch.control is None:
            _receive(bus, watch, _OVERTAKEN_S)
            return
        quiet_s = 0.0 if received else quiet_s + interval_s
        waited_s = time.monotonic() - begun
        if watch.tick < 0 and watch.plant_state is None and waited_s > run.setup.scenario.clock.join_timeout_s:
            _fail_silent(run)
        if watch.control is None:
            draw(table_of(watch, run.name, quiet_s))


def _fail_silent(run: _Run) -> NoReturn:
    if run.folder is not None and live.read(run.folder) is None:
        fail(f"run {run.name} has just ended; its folder is {run.folder}", EXIT_UNREACHABLE)
    where = f"at {', '.join(run.endpoints)}"
    scenario = run.setup.scenario.name
    fail(f"no message of run {run.name} {where}, or its scenario is not {scenario} as given", EXIT_UNREACHABLE)


def _receive(bus: Bus, watch: Watch, timeout_s: float, *, until_whole: bool = False) -> tuple[int, bool]:
    """Receive messages for a time, or until all agents reported; return number and whether the coordinator left."""
    received, deadline = 0, time.monotonic() + timeout_s
    while watch.control is None and (left_s := deadline - time.monotonic()) > 0.0:
        if until_whole and watch.is_whole:
            break
        event = bus.next(left_s)
        if isinstance(event, Message):
            watch.take(event, bus.arrived_ns)
            received += 1
        elif isinstance(event, Presence) and event.name == COORDINATOR and not event.alive:
            return received, True
    return received, False


def table_of(watch: Watch, run: str, quiet_s: float = 0.0) -> Group:
    """Return the table of a run by name, with the time since the last message, s, if it is long."""
    content = watch.content()
    outcome, period_s = content["outcome"], watch.setup.settings.sampling_period_s
    ticks = content["ticks"]
    reason = f": {content['reason']}" if content["reason"] else ""
    ended = "" if outcome is None else f"  {outcome}{reason}"
    silence = f"  no message for {quiet_s:.0f} s" if quiet_s > _QUIET_S and outcome is None else ""
    lines: list[Text | Table] = [
        Text.assemble(
            (run, "bold"), (ended, "bold green" if outcome == "completed" else "bold red"), (silence, "yellow")
        ),
        Text(
            f"tick {content['tick']} of {ticks}, {content['time_s']:.2f} of {ticks * period_s:.2f} s  "
            f"{_number(content['real_time_factor'], '.2f')}x  cost {_number(content['cost'], '.5f')}  "
            f"attitude {_number(content['attitude_deg'], '.2f')} deg"
        ),
    ]
    rows = [_row(watch, agent) for agent in content["agents"]]
    # Empty columns are left out: terminals are narrow.
    names = [name for name in rows[0] if any(row[name] is not None for row in rows)]
    table = Table(box=None, padding=(0, 1, 0, 0))
    for name in names:
        table.add_column(name, justify="left" if name in _LEFT else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(row[name] or "" for name in names))
    lines.append(table)
    lines += [Text(f" {notice}", "yellow") for notice in content["notices"]]
    others = {name: count for name, count in content["rejections"].items() if not name.startswith("agent")}
    if others:
        lines.append(Text(" refused by " + ", ".join(f"{name}: {count}" for name, count in others.items())))
    return Group(*lines)


def _row(watch: Watch, agent: dict[str, Any]) -> dict[str, Text | str | None]:
    """Return the cells of an agent by column; None leaves the column out unless another agent needs it."""
    clock, ages, slack = watch.setup.scenario.clock, agent["plan_ages"], agent["slack_ms"]
    troubled = agent["fallbacks"] or agent["failures"]
    slack_cell = Text(_number(slack, ".1f"), "red" if slack is not None and slack < 0.0 else "")
    return {
        "agent": str(agent["agent"]),
        "UAVs": None if agent["uavs"] == [agent["agent"]] else " ".join(map(str, agent["uavs"])),
        "state": Text(agent["state"], _COLOURS[agent["state"]]),
        "tick": _number(agent["tick"], "d"),
        "step ms": _number(agent["step_ms"], ".2f"),
        "worst": _number(agent["worst_step_ms"], ".1f"),
        "slack": None if clock.speed == 0.0 else slack_cell,
        "plan ages": "-" if ages is None else " ".join("-" if age < 0 else str(age) for age in ages.values()),
        "lost": str(agent["lost"]),
        "late": str(agent["late"]),
        "missed": str(agent["missed"]) if clock.mode == "realtime" else None,
        "QPs": f"{agent['fallbacks']} fell back, {agent['failures']} failed" if troubled else None,
        "refused": str(agent["rejected"]) if agent["rejected"] else None,
        "off": str(agent["off_the_roster"]) if agent["off_the_roster"] else None,
    }


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
