"""The command `transport top`: follows the messages of an active run and draws a table of its agents."""

import time
from collections import Counter, deque
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text
from typer import Option

from model.state import StateView
from plant.actuators import FAIL_SAFE
from protocol.admission.gate import Gate
from protocol.network.bus import Bus
from protocol.network.endpoints import Endpoints, default_mesh, security_of
from protocol.scenario.setup import Setup
from protocol.scenario.stage_cost import StageCost
from protocol.scenario.targets import with_targets
from protocol.wire.exit_codes import EXIT_UNREACHABLE
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
from transport.cli.operate import ConnectOption, RunOption, find_active
from transport.cli.options import read_setup
from transport.cli.output import Format, fail, rows, show
from transport.flight.harness import keys_setting

# Number of steps for the longest step time, and of kept notices.
_RECENT, _NOTICES = 100, 5
# An agent is silent after this many ticks without a report.
_BEHIND = 5
# Counts of an agent that the table only has if they are not zero.
_RARE = ("missed", "fallbacks", "failures", "rejected", "off")
_COLOURS = {"active": "green", "silent": "yellow", "off": "red", "fail-safe": "bold red"}
# Interval between two tables on a terminal, and elsewhere, s.
_DRAW_S, _PRINT_S = 0.25, 10.0
# Messages gather for this long before the process wakes up: wake-ups cost the run processor time.
_GATHER_S = 0.02
# Time that `--once` waits for reports of all agents, and for the outcome of the run after its coordinator has left.
_PATIENCE_S, _OVERTAKEN_S = 5.0, 0.5


class Watch:
    """Status of a run since the start of watching."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self.agents: dict[int, dict[str, Any]] = {  # by number, as in JSON
            agent: {
                "agent": agent,
                "uavs": [uav + 1 for uav in setup.owned[agent - 1]],
                **dict.fromkeys(("state", "tick", "step_ms", "worst_ms", "plan_ages")),
                **dict.fromkeys(("lost", "late", *_RARE), 0),
            }
            for agent in setup.agents
        }
        self.members: frozenset[int] | None = None  # agents on the roster; None while unknown
        self.tick = -1  # newest open tick, -1 before the first
        self.plant_state: PlantState | None = None  # newest
        self.control: Control | None = None  # end of the run
        self.notices: deque[str] = deque(maxlen=_NOTICES)  # latest changes of the roster
        self.rejections = Counter[str]()  # rejected messages by receiver
        self._recent_ms: dict[int, deque[float]] = {agent: deque(maxlen=_RECENT) for agent in setup.agents}
        self._opened: Tick | None = None
        self._cost = StageCost(setup)

    def take(self, message: Message) -> None:
        """Update the status from any message."""
        match message:
            case Tick():
                self._open(message)
            case StepReport():
                self._report(message)
            case PlantState():
                self.plant_state = message
            case Target():
                self.setup = with_targets(self.setup, [message])
            case Roster():
                members = frozenset(message.agents)
                for agent in (self.members or frozenset()) - members:
                    self.agents[agent]["off"] += 1
                self.members = members
                self.notices.append(message.reason)
            case Rejected():
                self.rejections[message.sender] += message.count
            case Control():
                self.control = message

    @property
    def is_whole(self) -> bool:
        """Whether the plant state and a report of every agent on the roster have arrived."""
        members = self.members or ()
        return self.plant_state is not None and all(self.agents[agent]["tick"] is not None for agent in members)

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
        period_s, state, cost, attitude_deg = self.setup.settings.sampling_period_s, self.plant_state, None, None
        if state is not None:
            y_ref = self.setup.reference.outputs(np.array([state.tick * period_s]))[0]
            cost = self._cost.at(state.tick, self.setup.model.outputs(state.x), y_ref, state.u)
            attitude_deg = float(np.degrees(np.abs(StateView(state.x).Theta0)).max())
        return {
            "scenario": self.setup.scenario.name,
            "tick": self.tick,
            "ticks": self.setup.ticks,
            "time_s": max(self.tick, 0) * period_s,
            "cost": cost,
            "attitude_deg": attitude_deg,
            "outcome": self.control and self.control.outcome,
            "reason": self.control and self.control.reason,
            "rejections": dict(self.rejections),
            "notices": list(self.notices),
            "agents": [
                agent | {"state": self.state_of(number), "rejected": self.rejections[agent_name(number)]}
                for number, agent in self.agents.items()
            ],
        }

    def _open(self, tick: Tick) -> None:
        realtime, before = self.setup.scenario.clock.mode == "realtime", self._opened
        if realtime and before is not None and tick.tick == before.tick + 1:
            for agent in set(before.members) - set(tick.answered):
                self.agents[agent]["missed"] += 1
        if self.members is None:
            self.members = frozenset(tick.members)
        self.tick, self._opened = tick.tick, tick

    def _report(self, report: StepReport) -> None:
        agent, recent_ms = self.agents[report.agent], self._recent_ms[report.agent]
        recent_ms.append(float(report.times_ms[-1]))
        agent |= {"tick": report.tick, "step_ms": recent_ms[-1], "worst_ms": max(recent_ms)}
        agent["plan_ages"] = list(report.plan_ages)  # of the other agents, in their order; -1 for none
        agent["lost"] += report.lost
        agent["late"] += report.late
        agent["fallbacks"] += report.fallback
        agent["failures"] += report.status != "solved"


@dataclass(frozen=True, slots=True)
class _Run:
    """An active run: its name, what it simulates, where to connect."""

    name: str
    setup: Setup
    endpoints: Endpoints


def top(
    run: RunOption = None,
    connect: ConnectOption = None,
    scenario: str | None = Option(None, metavar="SCENARIO", help="Scenario of a run started by hand: file or name."),
    settings: list[str] | None = Option(None, "--set", metavar="KEY=VALUE", help="Changes of that scenario."),
    once: bool = Option(False, "--once", help="Print one table and exit."),
    output: Format = Option(Format.text, "--format", metavar="FORMAT", help="Output format, with --once."),
) -> None:
    """Watch the agents of an active run.

    A table of tick, step time, plan ages, lost messages, faults and rejections, until the run ends. The command only
    listens: no process waits for it, and a lockstep run computes the same bits without it.

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
        patience_s = _PATIENCE_S if once else max(_PATIENCE_S, active.setup.scenario.clock.join_timeout_s)
        _receive(bus, watch, patience_s, until_whole=True)
        if watch.tick < 0 and watch.plant_state is None and watch.control is None:
            where, name = ", ".join(active.endpoints.connect), active.setup.scenario.name
            text = f"no message of run {active.name} at {where}, or its scenario is not {name} as given"
            fail(text, EXIT_UNREACHABLE)
        if not once:
            _follow(bus, active, watch)
    show(output, {"run": active.name, **watch.content()}, table_of(watch, active.name))
    if watch.control is None and not once:
        fail(f"run {active.name}: its coordinator is gone, and its outcome was not received", EXIT_UNREACHABLE)


def _find(run: str | None, connect: list[str] | None, scenario: str | None, settings: list[str] | None) -> _Run:
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
    return _Run(name, setup, places)


def _follow(bus: Bus, run: _Run, watch: Watch) -> None:
    """Draw tables until the run ends."""
    console = Console()
    interval_s = _DRAW_S if console.is_terminal else _PRINT_S
    with Live(table_of(watch, run.name), console=console, auto_refresh=False, transient=True) as shown:
        while watch.control is None:
            table = table_of(watch, run.name)
            if console.is_terminal:
                shown.update(table, refresh=True)
            else:
                console.print(table)
            if _receive(bus, watch, interval_s):  # the coordinator has left
                _receive(bus, watch, _OVERTAKEN_S)
                return


def _receive(bus: Bus, watch: Watch, timeout_s: float, *, until_whole: bool = False) -> bool:
    """Receive messages for a time, or until all agents reported; return whether the coordinator left."""
    deadline = time.monotonic() + timeout_s
    while watch.control is None and (left_s := deadline - time.monotonic()) > 0.0:
        if until_whole and watch.is_whole:
            break
        event = bus.next(left_s)
        if isinstance(event, Message):
            watch.take(event)
        elif isinstance(event, Presence) and event.name == COORDINATOR and not event.alive:
            return True
    return False


def table_of(watch: Watch, run: str) -> Group:
    """Return the table of a run by name."""
    content = watch.content()
    outcome, period_s = content["outcome"], watch.setup.settings.sampling_period_s
    head = f"tick {watch.tick} of {watch.setup.ticks}, {content['time_s']:.2f} of {watch.setup.ticks * period_s:.2f} s"
    if watch.plant_state is not None:
        head += f"  cost {content['cost']:.5f}  attitude {content['attitude_deg']:.2f} deg"
    end = f"  {outcome}{': ' if content['reason'] else ''}{content['reason']}" if outcome else ""
    refused = [f" {count} messages refused by {name}" for name, count in watch.rejections.items()]
    cells = [
        {name.replace("_", " "): value for name, value in agent.items() if name not in _RARE}
        | {"state": Text(agent["state"], _COLOURS.get(agent["state"], ""))}
        | {"": Text(", ".join(f"{agent[name]} {name}" for name in _RARE if agent[name]), "yellow")}
        for agent in content["agents"]
    ]
    lines = [Text(line, "yellow") for line in (*(f" {notice}" for notice in content["notices"]), *refused)]
    colour = "bold green" if outcome == "completed" else "bold red"
    return Group(
        Text.assemble((run, "bold"), (end, colour)), Text(head), rows(cells, "uavs", "state", "plan ages", ""), *lines
    )
