"""The command `transport top`: follows the messages of an active run and draws a table of its agents."""

import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text
from typer import Option

from model.state import StateView
from plant.schedule import FAIL_SAFE
from protocol.admission.gate import Gate
from protocol.network.bus import Bus
from protocol.network.endpoints import Endpoints, default_mesh, security_of
from protocol.scenario.setup import Setup
from protocol.scenario.stage_cost import StageCost
from protocol.scenario.targets import with_targets
from protocol.wire import messages
from protocol.wire.exit_codes import EXIT_UNREACHABLE
from protocol.wire.keys import RECORDER, WATCHER, Keys
from protocol.wire.messages import Message, StepReport, Tick, agent_name
from protocol.wire.names import COORDINATOR
from transport.cli.operate import ConnectOption, RunOption, find_active
from transport.cli.options import read_setup
from transport.cli.output import Format, fail, rows, show
from transport.flight import live
from transport.flight.harness import keys_setting

# Number of steps for the longest step time, and of kept notices.
_RECENT, _NOTICES = 100, 5

# An agent is silent after this many ticks without a report.
_BEHIND = 5

# Counts of an agent since the start of watching, as in docs/command-line.md.
_COUNTS = ("lost", "late", "missed", "fallbacks", "failures", "off_the_roster")

# Columns of the table: heading, name of the value, its format.
_COLUMNS = (
    ("agent", "agent", "d"),
    ("UAVs", "uavs", ""),
    ("state", "state", ""),
    ("tick", "tick", "d"),
    ("step ms", "step_ms", ".2f"),
    ("worst", "worst_step_ms", ".1f"),
    ("slack", "slack_ms", ".1f"),
    ("plan ages", "plan_ages", ""),
    ("lost", "lost", "d"),
    ("late", "late", "d"),
    ("missed", "missed", "d"),
    ("fell back", "fallbacks", "d"),
    ("failed", "failures", "d"),
    ("refused", "rejected", "d"),
    ("off", "off_the_roster", "d"),
)
# Shown if an agent has another value than none: terminals are narrow.
_IF_ANY = ("slack", "missed", "fell back", "failed", "refused", "off")
_COLOURS = {"active": "green", "silent": "yellow", "off": "red", "fail-safe": "bold red", "-": ""}
# The table mentions silence that lasts longer.
_QUIET_S = 2.0
# Interval between two tables on a terminal, and elsewhere, s.
_DRAW_S, _PRINT_S = 0.25, 10.0
# Messages gather for this long before the process wakes up: wake-ups cost the run processor time.
_GATHER_S = 0.02
# Time that `--once` waits for reports of all agents.
_PATIENCE_S = 5.0
# Time to wait for the outcome of the run after its coordinator has left.
_OVERTAKEN_S = 0.5


@dataclass(slots=True)
class Watch:
    """Status of a run since the start of watching."""

    setup: Setup
    agents: dict[int, dict[str, Any]] = field(init=False)  # by number, as in JSON
    members: frozenset[int] | None = None  # agents on the roster; None while unknown
    tick: int = -1  # newest open tick, -1 before the first
    plant_state: messages.PlantState | None = None  # newest
    control: messages.Control | None = None  # end of the run
    notices: deque[str] = field(default_factory=lambda: deque(maxlen=_NOTICES))  # latest changes of the roster
    rejections: Counter[str] = field(default_factory=Counter)  # rejected messages by receiver
    _recent_ms: dict[int, deque[float]] = field(init=False)  # times of the latest steps of each agent, ms
    _opened: Tick | None = None
    _opened_ns: int = 0
    _first: tuple[int, int] | None = None  # tick and time
    _cost: StageCost = field(init=False)

    def __post_init__(self) -> None:
        values = ("tick", "step_ms", "worst_step_ms", "slack_ms", "plan_ages")
        self.agents = {
            agent: {
                "agent": agent,
                "uavs": [uav + 1 for uav in self.setup.owned[agent - 1]],
                **dict.fromkeys(("state", *values)),
                **dict.fromkeys(_COUNTS, 0),
            }
            for agent in self.setup.agents
        }
        self._recent_ms = {agent: deque(maxlen=_RECENT) for agent in self.setup.agents}
        self._cost = StageCost(self.setup)

    def take(self, message: Message, at_ns: int) -> None:
        """Update the status from any message; its arrival is on any steady clock, ns."""
        match message:
            case Tick():
                self._open(message, at_ns)
            case StepReport():
                self._report(message, at_ns)
            case messages.PlantState():
                self.plant_state = message
            case messages.Target():
                self.setup = with_targets(self.setup, [message])
            case messages.Roster():
                members = frozenset(message.agents)
                for agent in (self.members or frozenset()) - members:
                    self.agents[agent]["off_the_roster"] += 1
                self.members = members
                self.notices.append(message.reason)
            case messages.Rejected():
                self.rejections[message.sender] += message.count
            case messages.Control():
                self.control = message

    @property
    def is_silent(self) -> bool:
        """Whether no message that shows the state of the run has arrived."""
        return self.tick < 0 and self.plant_state is None and self.control is None

    @property
    def is_whole(self) -> bool:
        """Whether the plant state and a report of every agent on the roster have arrived."""
        if self.plant_state is None or self.members is None:
            return False
        return all(self.agents[agent]["tick"] is not None for agent in self.members)

    @property
    def real_time_factor(self) -> float | None:
        """Scenario time per wall time since the start of watching; None before two ticks."""
        if self._first is None or self.tick <= self._first[0] or self._opened_ns <= self._first[1]:
            return None
        ticks, wall_s = self.tick - self._first[0], (self._opened_ns - self._first[1]) / 1e9
        return ticks * self.setup.settings.sampling_period_s / wall_s

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
        tick = self.agents[agent]["tick"]
        return "-" if tick is None else "active" if self.tick - tick <= _BEHIND else "silent"

    def content(self) -> dict[str, Any]:
        """Return the status as JSON data."""
        return {
            "scenario": self.setup.scenario.name,
            "tick": self.tick,
            "ticks": self.setup.ticks,
            "time_s": max(self.tick, 0) * self.setup.settings.sampling_period_s,
            "real_time_factor": self.real_time_factor,
            "cost": self.cost,
            "attitude_deg": self.attitude_deg,
            "agents": [
                agent | {"state": self.state_of(number), "rejected": self.rejections[agent_name(number)]}
                for number, agent in self.agents.items()
            ],
            "notices": list(self.notices),
            "rejections": dict(self.rejections),
            "outcome": self.control and self.control.outcome,
            "reason": self.control and self.control.reason,
        }

    def _open(self, tick: Tick, at_ns: int) -> None:
        realtime, before = self.setup.scenario.clock.mode == "realtime", self._opened
        if realtime and before is not None and tick.tick == before.tick + 1:
            for agent in set(before.members) - set(tick.answered):
                self.agents[agent]["missed"] += 1
        if self.members is None:
            self.members = frozenset(tick.members)
        self.tick, self._opened, self._opened_ns = tick.tick, tick, at_ns
        self._first = self._first or (tick.tick, at_ns)

    def _report(self, report: StepReport, at_ns: int) -> None:
        agent, recent_ms = self.agents[report.agent], self._recent_ms[report.agent]
        recent_ms.append(float(report.times_ms[-1]))
        agent |= {"tick": report.tick, "step_ms": recent_ms[-1], "worst_step_ms": max(recent_ms)}
        agent["plan_ages"] = dict(zip(map(agent_name, report.peers), report.plan_ages, strict=True))
        agent["lost"] += report.lost
        agent["late"] += report.late
        agent["fallbacks"] += report.fallback
        agent["failures"] += report.status != "solved"
        speed = self.setup.scenario.clock.speed
        if speed > 0.0 and self._opened is not None and self._opened.tick == report.tick:
            left_ns = self.setup.period_ns / speed - self._opened.late_ns - (at_ns - self._opened_ns)
            agent["slack_ms"] = left_ns / 1e6


@dataclass(frozen=True, slots=True)
class _Run:
    """An active run: its name, what it simulates, where to connect."""

    name: str
    setup: Setup
    endpoints: Endpoints
    folder: Path | None = None  # of a run that this machine has started


def top(
    run: RunOption = None,
    connect: ConnectOption = None,
    scenario: str | None = Option(None, metavar="SCENARIO", help="Scenario of a run started by hand: file or name."),
    settings: list[str] | None = Option(None, "--set", metavar="KEY=VALUE", help="Changes of that scenario."),
    once: bool = Option(False, "--once", help="Print one table and exit."),
    output: Format = Option(Format.text, "--format", metavar="FORMAT", help="Output format, with --once."),
) -> None:
    """Watch the agents of an active run.

    A table of tick, step time, slack to the deadline, plan ages, lost messages, faults and rejections, until the run
    ends. The command only listens: no process waits for it, and a lockstep run computes the same bits without it.

    Exit codes: 0 the run has ended, or --once; 2 no such run; 4 no message from it; 130 Ctrl-C.

    Example: transport top --run runs/20260102-101500-paper
    """
    if output is Format.json and not once:
        fail("--format json: expected it with --once, got it without")
    active = _find(run, connect, scenario, settings)
    watch = Watch(active.setup)
    # Without joining: a liveliness token would make the coordinator expect this process.
    bus = Bus(
        name=WATCHER,
        incarnation=0,
        run=active.name,
        digest=active.setup.scenario.digest(),
        endpoints=active.endpoints,
        gate=Gate(WATCHER, Keys(active.name), active.setup.shape),
        gather_s=_GATHER_S,
    )
    with closing(bus):
        if not once:
            _follow(bus, active, watch)
            return
        _receive(bus, watch, _PATIENCE_S, until_whole=True)
    if watch.is_silent:
        _fail_silent(active)
    show(output, {"run": active.name, **watch.content()}, table_of(watch, active.name))


def _find(run: str | None, connect: list[str] | None, scenario: str | None, settings: list[str] | None) -> _Run:
    folder = None
    if scenario is not None:
        setup = read_setup(scenario, settings, allow_large=True)
        name, router = run or setup.scenario.name, setup.scenario.network.router
        if not Keys.allows(name):
            fail(f"--run: expected the name of a run with --scenario, got {name!r}")
        default = [endpoint for place in default_mesh(setup.scenario).values() for endpoint in place.listen]
        endpoints, is_client = connect or ([router] if router else default), router is not None
    elif connect or settings:
        fail(f"{'--connect' if connect else '--set'}: expected --scenario with it, got none")
    else:
        folder, there = find_active(run, "name its folder with --run, or its scenario with --scenario")
        changes = [keys_setting(there.keys)] if there.keys else None
        setup = read_setup(str(folder / "scenario.toml"), changes, allow_large=True)
        endpoints = sorted({at for name, at in there.endpoints.items() if name != RECORDER})
        name, is_client = there.run, there.is_client
    security = security_of(setup.scenario)
    places = Endpoints(listen=[], connect=endpoints, mode="client" if is_client else "peer", security=security)
    return _Run(name, setup, places, folder)


def _follow(bus: Bus, run: _Run, watch: Watch) -> None:
    """Draw tables until the run ends."""
    console = Console()
    if console.is_terminal:
        with Live(table_of(watch, run.name), console=console, auto_refresh=False, transient=True) as shown:
            _draw_until_end(bus, run, watch, _DRAW_S, lambda table: shown.update(table, refresh=True))
    else:
        _draw_until_end(bus, run, watch, _PRINT_S, console.print)
    console.print(table_of(watch, run.name))
    if watch.control is None:
        fail(f"run {run.name}: its coordinator is gone, and its outcome was not received", EXIT_UNREACHABLE)


def _draw_until_end(bus: Bus, run: _Run, watch: Watch, interval_s: float, draw: Callable[[Group], None]) -> None:
    begun_s, quiet_s = time.monotonic(), 0.0
    while watch.control is None:
        # The first table is drawn as soon as all agents have reported.
        received, gone = _receive(bus, watch, interval_s, until_whole=not watch.is_whole)
        if gone:
            _receive(bus, watch, _OVERTAKEN_S)
            return
        quiet_s = 0.0 if received else quiet_s + interval_s
        if watch.is_silent and time.monotonic() - begun_s > run.setup.scenario.clock.join_timeout_s:
            _fail_silent(run)
        if watch.control is None:
            draw(table_of(watch, run.name, quiet_s))


def _fail_silent(run: _Run) -> NoReturn:
    if run.folder is not None and live.read(run.folder) is None:
        fail(f"run {run.name} has just ended; its folder is {run.folder}", EXIT_UNREACHABLE)
    where, scenario = ", ".join(run.endpoints.connect), run.setup.scenario.name
    fail(f"no message of run {run.name} at {where}, or its scenario is not {scenario} as given", EXIT_UNREACHABLE)


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
        elif isinstance(event, messages.Presence) and event.name == COORDINATOR and not event.alive:
            return received, True
    return received, False


def table_of(watch: Watch, run: str, quiet_s: float = 0.0) -> Group:
    """Return the table of a run by name, with the time since the last message, s, if it is long."""
    content = watch.content()
    outcome, agents = content["outcome"], content["agents"]
    end = f"  {outcome}{': ' if content['reason'] else ''}{content['reason']}" if outcome else ""
    silence = f"  no message for {quiet_s:.0f} s" if quiet_s > _QUIET_S and not outcome else ""
    colour = "bold green" if outcome == "completed" else "bold red"
    until_s = watch.setup.ticks * watch.setup.settings.sampling_period_s
    head = (
        f"tick {watch.tick} of {watch.setup.ticks}, {content['time_s']:.2f} of {until_s:.2f} s  "
        f"{_cell(content['real_time_factor'], '.2f')}x  cost {_cell(content['cost'], '.5f')}  "
        f"attitude {_cell(content['attitude_deg'], '.2f')} deg"
    )
    shown = [column for column in _COLUMNS if column[0] not in _IF_ANY or any(agent[column[1]] for agent in agents)]
    cells = [{heading: _cell(agent[name], form) for heading, name, form in shown} for agent in agents]
    refused = [f"{name}: {count}" for name, count in watch.rejections.items() if not name.startswith("agent")]
    return Group(
        Text.assemble((run, "bold"), (end, colour), (silence, "yellow")),
        Text(head),
        rows(cells, "UAVs", "state", "plan ages"),
        *(Text(f" {notice}", "yellow") for notice in content["notices"]),
        *([Text(f" refused by {', '.join(refused)}")] if refused else []),
    )


def _cell(value: Any, form: str) -> Text:
    """Return a value as text: numbers by their format, entries of lists and ages of plans one after the other."""
    if isinstance(value, dict):
        return Text(" ".join("-" if age < 0 else str(age) for age in value.values()))
    if isinstance(value, list):
        return Text(" ".join(map(str, value)))
    return Text("-") if value is None else Text(format(value, form), _COLOURS.get(value, ""))
