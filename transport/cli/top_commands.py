"""The command `transport top`: a table of the agents of a run in flight, for as long as it flies."""

import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from protocol.wire.exit_codes import EXIT_INTERRUPTED, EXIT_SCENARIO, EXIT_UNREACHABLE, EXIT_USAGE
from transport.cli.answers import Format, fail, show_json
from transport.cli.operate import RUNS, ConnectOption, RunOption

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Group
    from rich.text import Text

    from protocol.network.bus import Bus
    from protocol.scenario.setup import Setup
    from transport.monitor.watch import Watch


# How often the table is drawn; without a terminal it is printed this often instead.
_DRAW_S, _PRINT_S = 0.25, 10.0
# How long messages may gather before this process wakes up for them.
_GATHER_S = 0.02
# How long `--once` waits for everybody to report, and `top` for the first sign of the run.
_PATIENCE_S = 5.0
# How long nothing must come before the table says so, and the end of the run after its coordinator's.
_QUIET_S, _OVERTAKEN_S = 2.0, 0.5

_COLOURS = {"flies": "green", "silent": "yellow", "off": "red", "fail-safe": "bold red", "-": ""}
_LEFT = ("UAVs", "state", "plan ages", "QPs")


@dataclass(frozen=True, slots=True)
class _Flight:
    """Where a run is, and what it is."""

    run: str
    endpoints: list[str]
    setup: "Setup"
    is_client: bool = False


def top(
    run: RunOption = None,
    connect: ConnectOption = None,
    scenario: Annotated[
        str | None,
        typer.Option("--scenario", help="Of a run whose processes were started by hand: the file or name they read."),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="With --scenario: the values they were told to change."),
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="Print one table and exit.")] = False,
    output: Annotated[
        Format, typer.Option("--format", help="With --once: what goes to standard output.")
    ] = Format.text,
) -> None:
    """Watch the agents of a run in flight.

    A table of tick, step time, slack to the deadline, plan ages, losses, faults and rejections, until the run ends.
    It only listens: nobody in the run waits for it or knows of it, and a lockstep run gives the same bits.

    Exit codes: 0 the run has ended, or --once; 2 no such run; 4 no sign of it; 130 Ctrl-C.

    Example: transport top --run runs/20260102-101500-paper
    """
    from protocol.network.session import BusError

    if output is Format.json and not once:
        fail("--format json: expected it with --once, got it without", EXIT_USAGE)
    flight = _find(run, connect, scenario, settings or [])
    try:
        with closing(_listen(flight)) as bus:
            _watch(bus, flight, once=once, output=output)
    except BusError as error:
        fail(str(error), EXIT_UNREACHABLE)
    except KeyboardInterrupt:
        raise typer.Exit(EXIT_INTERRUPTED) from None


def _find(run: str | None, connect: list[str] | None, scenario: str | None, settings: list[str]) -> _Flight:
    from protocol.network.endpoints import default_mesh
    from protocol.network.security import SecurityError
    from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
    from protocol.scenario.setup import Setup
    from protocol.wire.keys import RECORDER, Keys
    from transport.flight import live

    try:
        if scenario is not None:
            path = find_scenario(scenario)
            setup = Setup.of(read_scenario(path, settings), str(path))
            name = run or setup.scenario.name
            if not Keys.allows(name):
                fail(f"--run: expected the name of a run with --scenario, got {name!r}", EXIT_USAGE)
            router = setup.scenario.network.router
            usual = [endpoint for place in default_mesh(setup.scenario).values() for endpoint in place.listen]
            return _Flight(name, connect or ([router] if router else usual), setup, router is not None)
        if connect:
            fail("--connect: expected --scenario with it, as the run cannot say what it flies", EXIT_USAGE)
        if settings:
            fail("--set: expected --scenario with it, as a run folder has its values", EXIT_USAGE)
        folder = _folder(run)
        there = None if folder is None else live.read(folder)
        if folder is None or there is None:
            where = f"below {RUNS}/" if run is None else f"in {run}"
            fail(f"no run that flies {where}; name its folder with --run, or what it flies with --scenario", EXIT_USAGE)
        path = folder / "scenario.toml"
        setup = Setup.of(read_scenario(path), str(path))
    except ScenarioError as error:
        fail(str(error.blaming(settings)), EXIT_SCENARIO)
    except SecurityError as error:
        fail(str(error), EXIT_SCENARIO)
    called = {at for name, at in there.endpoints.items() if name != RECORDER}
    return _Flight(there.run, sorted(called), setup, there.is_client)


def _folder(run: str | None) -> Path | None:
    from transport.flight import live

    if run is None:
        return live.newest_folder(RUNS)
    return next((folder for folder in (Path(run), RUNS / run) if live.read(folder) is not None), None)


def _listen(flight: _Flight) -> "Bus":
    from protocol.admission.admission import Admission
    from protocol.network.bus import Bus
    from protocol.network.endpoints import Endpoints, security_of
    from protocol.wire.keys import WATCHER, Keys
    from protocol.wire.rejections import Rejections

    # It never joins: it declares no token, so that nobody counts on it.
    return Bus(
        name=WATCHER,
        incarnation=0,
        run=flight.run,
        digest=flight.setup.scenario.digest(),
        endpoints=Endpoints(
            listen=[],
            connect=flight.endpoints,
            mode="client" if flight.is_client else "peer",
            security=security_of(flight.setup.scenario),
        ),
        admission=Admission(WATCHER, Keys(flight.run), flight.setup, Rejections()),
        gather_s=_GATHER_S,
    )


def _watch(bus: "Bus", flight: _Flight, *, once: bool, output: Format) -> None:
    from rich.console import Console
    from rich.live import Live

    from transport.monitor.watch import Watch

    watch, console = Watch(flight.setup), Console()
    if once:
        _listen_until(bus, watch, lambda: watch.is_whole, _PATIENCE_S)
        if watch.tick < 0 and watch.plant_state is None and watch.control is None:
            _no_sign(flight)
        if output is Format.json:
            show_json({"run": flight.run, **watch.content()})
        else:
            console.print(_table(watch, flight.run))
        return
    if console.is_terminal:
        with Live(_table(watch, flight.run), console=console, auto_refresh=False, transient=True) as picture:
            _until_the_end(bus, flight, watch, _DRAW_S, lambda table: picture.update(table, refresh=True))
    else:
        _until_the_end(bus, flight, watch, _PRINT_S, console.print)
    console.print(_table(watch, flight.run))
    if watch.control is None:
        fail(f"run {flight.run}: its coordinator is gone, and how it ended was not heard", EXIT_UNREACHABLE)


def _until_the_end(bus: "Bus", flight: _Flight, watch: "Watch", every_s: float, draw: "Callable[[Group], Any]") -> None:
    begun = time.monotonic()
    quiet_s = 0.0
    # The first table comes as soon as there is something in every line of it.
    waits = True
    while watch.control is None:
        heard, gone = _listen_until(bus, watch, (lambda: watch.is_whole) if waits else (lambda: False), every_s)
        waits = waits and not watch.is_whole
        if gone and watch.control is None:
            _listen_until(bus, watch, lambda: watch.control is not None, _OVERTAKEN_S)
            return
        quiet_s = 0.0 if heard else quiet_s + every_s
        if (
            watch.tick < 0
            and watch.plant_state is None
            and time.monotonic() - begun > flight.setup.scenario.clock.join_timeout_s
        ):
            _no_sign(flight)
        if watch.control is None:
            draw(_table(watch, flight.run, quiet_s))


def _no_sign(flight: _Flight) -> NoReturn:
    where = f"at {', '.join(flight.endpoints)}"
    fail(
        f"no sign of run {flight.run} {where}, or it flies another scenario than {flight.setup.scenario.name} as given",
        EXIT_UNREACHABLE,
    )


def _listen_until(bus: "Bus", watch: "Watch", enough: "Callable[[], bool]", timeout_s: float) -> tuple[int, bool]:
    """Take in what comes for some time; how many messages that were, and whether the coordinator has left."""
    from protocol.wire.messages import Message, Presence

    heard, deadline = 0, time.monotonic() + timeout_s
    while not enough() and watch.control is None and (left_s := deadline - time.monotonic()) > 0.0:
        event = bus.next(left_s)
        if isinstance(event, Message):
            watch.take(event, bus.arrived_ns)
            heard += 1
        elif isinstance(event, Presence) and event.name == "coordinator" and not event.alive:
            return heard, True
    return heard, False


def _table(watch: "Watch", run: str, quiet_s: float = 0.0) -> "Group":
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    content = watch.content()
    outcome, period_s = content["outcome"], watch.setup.settings.sampling_period_s
    ticks = content["ticks"]
    reason = f": {content['reason']}" if content["reason"] else ""
    ended = "" if outcome is None else f"  {outcome}{reason}"
    silence = f"  no news for {quiet_s:.0f} s" if quiet_s > _QUIET_S and outcome is None else ""
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
    # A column that would say nothing is left out: terminals are narrow.
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


def _row(watch: "Watch", agent: "dict[str, Any]") -> "dict[str, Text | str | None]":
    """An agent's line by column; None where there is nothing worth a column."""
    from rich.text import Text

    clock, ages, slack = watch.setup.scenario.clock, agent["plan_ages"], agent["slack_ms"]
    troubled = agent["fallbacks"] or agent["failures"]
    return {
        "agent": str(agent["agent"]),
        "UAVs": None if agent["uavs"] == [agent["agent"]] else " ".join(map(str, agent["uavs"])),
        "state": Text(agent["state"], _COLOURS[agent["state"]]),
        "tick": _number(agent["tick"], "d"),
        "step ms": _number(agent["step_ms"], ".2f"),
        "worst": _number(agent["worst_step_ms"], ".1f"),
        "slack": None
        if clock.speed == 0.0
        else Text(_number(slack, ".1f"), "red" if slack is not None and slack < 0.0 else ""),
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
