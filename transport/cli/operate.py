"""Commands that act on an active run: `status`, `fault`, `link`, `target`, and `metrics` for Prometheus."""

import inspect
import json
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_origin

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text
from typer import Argument, Option

from protocol.network.endpoints import Endpoints, default_mesh, process_names, security_of
from protocol.network.security import SecurityError
from protocol.network.session import BusError, ask
from protocol.scenario.files import TableError, points_of
from protocol.scenario.keys import key_of, meanings, unit_of
from protocol.scenario.link_sections import LinkSection
from protocol.scenario.links import PERFECT, LinkError, link_change
from protocol.scenario.schema import Scenario
from protocol.scenario.targets import TargetError, asked
from protocol.wire.exit_codes import EXIT_SCENARIO, EXIT_USAGE
from protocol.wire.names import COORDINATOR, PLANT, RECORDER
from transport.cli.active_run import ActiveRun
from transport.cli.options import FormatOption, ScenarioOption, SetOption, with_options
from transport.cli.output import Format, exit_on, fail, show_json
from transport.cli.scenario_setup import read_setup
from transport.flight.live import FAULTS

# Timeout after which a process counts as down.
_TIMEOUT_S = 1.0
# Parts of an answer that are for the clock of the asking process.
_HIDDEN = ("asked_ns", "answered_ns")


class Fact(NamedTuple):
    """A number in the answer of a process to `health` (docs/protocol.md)."""

    metric: str  # its name in Prometheus, without the prefix
    text: str  # its description there
    label: str  # its name in the table of `transport status`
    scale: float | None = None  # factor for the table; None for a value as it is
    unit: str = ""  # unit behind the scaled value
    counts: bool = False  # whether it only grows


FACTS = {
    "tick": Fact("tick", "Newest tick of the process", "tick"),
    "memory_bytes": Fact("memory_bytes", "Resident memory", "memory", 1e-6, "MB"),
    "threads": Fact("threads", "Threads", "threads"),
    "open_files": Fact("open_files", "Open files", "open files"),
    "clock_offset_s": Fact(
        "clock_offset_seconds", "Lead of the coordinator's wall clock", "coordinator's clock", 1e3, "ms ahead"
    ),
    "clock_uncertainty_s": Fact("clock_uncertainty_seconds", "Largest error of the offset", "known within", 1e3, "ms"),
    "incarnation": Fact("incarnation", "Number of this start of the process", "incarnation"),
    "cpu_s": Fact("cpu_seconds", "Processor time", "processor time", 1.0, "s", counts=True),
    "refused": Fact("refused_messages", "Rejected messages", "refused messages", counts=True),
}


class Exporter:
    """Collector of `prometheus_client` that asks every process of a run, each at its endpoints, at each reading."""

    def __init__(self, run: str, places: dict[str, Endpoints]) -> None:
        self._run, self._places = run, places

    def health(self, name: str) -> dict[str, Any] | None:
        """Return the health of a process, or None after the timeout."""
        place = self._places[name]
        try:
            return dict(ask(self._run, place.connect, name, "health", {}, _TIMEOUT_S, place.security))
        except BusError:
            return None

    def collect(self) -> Iterator[Any]:
        """Yield the metrics, as `prometheus_client` expects of a collector."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily  # an extra

        answers = {name: self.health(name) for name in self._places}
        up = GaugeMetricFamily("transport_up", "1 if the process answers", labels=["run", "process"])
        for name, answer in answers.items():
            up.add_metric([self._run, name], float(answer is not None))
        yield up
        for key, fact in FACTS.items():
            family = CounterMetricFamily if fact.counts else GaugeMetricFamily
            found = family(f"transport_{fact.metric}", fact.text, labels=["run", "process"])
            for name, answer in answers.items():
                if answer is not None and answer.get(key) is not None:
                    found.add_metric([self._run, name], float(answer[key]))
            yield found


@with_options(ActiveRun)
def status(
    run: ActiveRun,
    process: Annotated[
        str | None, Option("--process", metavar="PROCESS", help="Process, such as plant, agent1 or recorder.")
    ] = None,
    output: FormatOption = Format.text,
) -> None:
    """Show the progress of a run, or the health of one process.

    Tick and roster; with --process its resource use and the messages it rejected.

    Example: transport status --process agent2
    """
    name, what = (COORDINATOR, "status") if process is None else (process, "health")
    answer = run.ask(name, what, {})
    if output is Format.json:
        show_json(answer)
    elif process is None:
        typer.echo(_progress(answer))
    else:
        Console().print(_table(answer))


def _progress(answer: Mapping[str, Any]) -> str:
    """Return a sentence about tick, roster and observers."""
    begun = f"tick {answer['tick']} of {answer['ticks']}" if answer["tick"] >= 0 else "before the first tick"
    agents = ", ".join(map(str, answer["members"])) or "none"
    observers = f"; observed by {', '.join(answer['observers'])}" if answer["observers"] else ""
    return f"{begun}; agents on the roster: {agents}{observers}"


def _table(answer: Mapping[str, Any]) -> Table:
    """Return a row for each value."""
    table = Table(box=None, show_header=False)
    table.add_column(style="cyan", no_wrap=True)
    table.add_column()
    for name, value in answer.items():
        if name in _HIDDEN or value is None:
            continue
        fact = FACTS.get(name)
        text = value if isinstance(value, str) else json.dumps(value)
        if fact is not None and fact.scale is not None:
            text = f"{round(fact.scale * value, 3):g} {fact.unit}"
        table.add_row(name if fact is None else fact.label, Text(text))
    return table


def _actions(incomplete: str) -> list[str]:
    """Return the faults that begin like an incomplete word, for the shell."""
    return [action for action in FAULTS if action.startswith(incomplete)]


@with_options(ActiveRun)
def fault(
    run: ActiveRun,
    action: Annotated[
        str, Argument(metavar="ACTION", help="kill, stop, continue or restart.", autocompletion=_actions)
    ],
    target: Annotated[str, Argument(metavar="PROCESS", help="agent1, agent2, ..., plant or coordinator.")],
    output: FormatOption = Format.text,
) -> None:
    """Kill, stop, continue or restart a process of an active run.

    The fault is written to the log of the run.

    Example: transport fault kill agent3
    """
    if action not in FAULTS:
        fail(f"ACTION: expected one of {', '.join(FAULTS)}, got {action!r}", EXIT_USAGE)
    answer = run.ask(RECORDER, "fault", {"do": action, "target": target})
    if output is Format.json:
        show_json(answer)
        return
    typer.echo(f"{action} {target}: done at tick {answer['tick']}")


def metrics(
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
    run: Annotated[
        str | None, Option("--run", metavar="NAME", help="Name of the run; the scenario's by default.")
    ] = None,
    connect: Annotated[
        list[str] | None,
        Option("--connect", metavar="ENDPOINT", help="Endpoints of coordinator, plant, agent 1, ... in this order."),
    ] = None,
    port: Annotated[
        int, Option("--port", metavar="PORT", min=1, max=65535, help="Port to serve on, at 127.0.0.1.")
    ] = 9464,
    output: FormatOption = Format.text,
) -> None:
    """Export process metrics to Prometheus.

    Example: transport metrics --scenario resilient --port 9464
    """
    try:
        from prometheus_client import CollectorRegistry, start_http_server
    except ModuleNotFoundError as error:
        fail(f"expected the package {error.name}, got none: pip install 'payload-transport[metrics]'", EXIT_USAGE)
    described = read_setup(scenario, settings, allow_large=True).scenario
    registry = CollectorRegistry()
    with exit_on(SecurityError, code=EXIT_SCENARIO):
        registry.register(Exporter(run or described.name, process_endpoints(described, connect)))
    try:
        server, thread = start_http_server(port, "127.0.0.1", registry)
    except OSError as error:
        fail(f"--port: cannot serve on {port} ({error.strerror})", EXIT_USAGE)
    address = f"http://127.0.0.1:{port}/metrics"
    if output is Format.json:
        show_json({"address": address})
        sys.stdout.flush()
    else:
        typer.echo(address, err=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        server.shutdown()
        thread.join()


def process_endpoints(scenario: Scenario, connect: Sequence[str] | None = None) -> dict[str, Endpoints]:
    """Return the endpoints at which to ask each process of a scenario, by name.

    Given endpoints, in the order of the mesh, replace the default ones.

    Raises: SecurityError: the keys cannot be used.
    """
    names = process_names(scenario)
    default = default_mesh(scenario)
    if connect is not None and len(connect) != len(names):
        fail(f"--connect: expected {len(names)} endpoints, for {', '.join(names)}, got {len(connect)}", EXIT_USAGE)
    found = {}
    for i, name in enumerate(names):
        at = connect[i] if connect is not None else [*default[name].listen, *default[name].connect][0]
        found[name] = Endpoints(listen=[], connect=[at], mode=default[name].mode, security=security_of(scenario))
    return found


# Placeholders of the options by the unit of their keys.
_METAVARS = {"s": "SECONDS", "1/s": "HZ", "": "PROBABILITY"}


def _options() -> Iterator[inspect.Parameter]:
    """Yield the options that set the keys of a link."""
    meaning = meanings(LinkSection)
    for name, field in LinkSection.model_fields.items():
        if not (option := key_of(field).option):
            continue
        is_choice = get_origin(field.annotation) is Literal
        low, high = (next((getattr(e, end) for e in field.metadata if hasattr(e, end)), None) for end in ("ge", "le"))
        metavar = "NAME" if is_choice else _METAVARS[unit_of(name, field)]
        text = f"{meaning[name][0].upper()}{meaning[name][1:]}.".replace("`", "")
        kind: Any = Annotated[
            (str if is_choice else float) | None, Option(option, metavar=metavar, min=low, max=high, help=text)
        ]
        yield inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind)


def _settings(**given: Any) -> dict[str, Any]:
    """Return the keys of a link whose options are given."""
    return {key: value for key, value in given.items() if value is not None}


_settings.__signature__ = inspect.Signature(list(_options()))  # type: ignore[attr-defined]


@with_options(_settings, ActiveRun)
def set_links(
    settings: dict[str, Any],
    run: ActiveRun,
    sender: Annotated[
        str | None, Option("--from", metavar="PROCESS", help="Sender: number of an agent, or plant; else all agents.")
    ] = None,
    receiver: Annotated[str | None, Option("--to", metavar="PROCESS", help="Receiver, in the same way.")] = None,
    output: FormatOption = Format.text,
) -> None:
    """Impair or repair links from the next tick on.

    Options that are not given keep their values.

    Example: transport link set --from 1 --to 2 --delay 0.1
    """
    if not settings:
        fail("expected at least one of --delay, --jitter, --loss, ..., got none", EXIT_USAGE)
    with exit_on(LinkError, code=EXIT_USAGE):
        link_change("", "", json.dumps(settings))
    ends = {"from": _process_name(sender), "to": _process_name(receiver)}
    answer = run.ask(COORDINATOR, "link", {**ends, "settings": settings})
    if output is Format.json:
        show_json(answer)
        return
    typer.echo(f"links change with tick {answer['tick']} (t = {answer['t_s']:.2f} s)")


@with_options(ActiveRun)
def clear_links(run: ActiveRun, output: FormatOption = Format.text) -> None:
    """Remove all impairments, also from the plant's links.

    Example: transport link clear
    """
    for ends in ({}, {"from": PLANT}, {"to": PLANT}):
        answer = run.ask(COORDINATOR, "link", {**ends, "settings": dict(PERFECT)})
    if output is Format.json:
        show_json(answer)
        return
    cleared = "all links: delay 0, loss 0, no other impairment"
    typer.echo(f"{cleared}, from tick {answer['tick']} on (t = {answer['t_s']:.2f} s)")


def _process_name(end: str | None) -> str:
    """Return the name of a process given as 2, agent2 or plant; empty for all agents."""
    return "" if end is None else f"agent{end}" if end.isdecimal() else end


@with_options(ActiveRun)
def target(
    run: ActiveRun,
    x: Annotated[float | None, Argument(metavar="X", help="Position in the inertial frame, m: forwards.")] = None,
    y: Annotated[float | None, Argument(metavar="Y", help="To the right.")] = None,
    z: Annotated[float | None, Argument(metavar="Z", help="Downwards.")] = None,
    speed: Annotated[
        float | None, Option("--speed", metavar="MPS", min=1e-3, help="Largest speed; else up to 1 m/s, if feasible.")
    ] = None,
    file: Annotated[
        Path | None,
        Option("--file", metavar="CSV", help="Way points instead: columns x,y,z, or t,x,y,z without --speed."),
    ] = None,
    output: FormatOption = Format.text,
) -> None:
    """Send the payload of an active run to a target.

    From the next tick on the reference leaves its path smoothly, also that to an earlier target, and comes to rest
    there. A target that cannot be flown is refused with the reason. Way points are run through on a smooth curve after
    the first one.

    Exit codes: 0 accepted; 2 refused; 4 no answer.

    Example: transport target 3 0 -12 --speed 1.5
    """
    point = [value for value in (x, y, z) if value is not None]
    if len(point) != (3 if file is None else 0):
        fail(f"expected X Y Z, or --file, got {len(point)} numbers{' and --file' if file else ''}", EXIT_USAGE)
    given: dict[str, Any] = {"points_m": [point]}
    if file is not None:
        with exit_on(TableError, code=EXIT_USAGE, option="--file"):
            points, times_s = points_of(file)
        given = {"points_m": points, **({} if times_s is None else {"times_s": times_s})}
    given |= {} if speed is None else {"speed_mps": speed}
    with exit_on(TargetError, code=EXIT_USAGE):
        asked(given)
    answer = run.ask(COORDINATOR, "target", given)
    if output is Format.json:
        show_json(answer)
        return
    typer.echo(in_words(answer))


def in_words(answer: dict[str, Any]) -> str:
    """Return the coordinator's answer to a target as a sentence."""
    further = f", the last way point at t = {answer['ends_s']:.2f} s" if answer["ends_s"] > answer["reached_s"] else ""
    return (
        f"target from tick {answer['tick']} on (t = {answer['t_s']:.2f} s), "
        f"reached at t = {answer['reached_s']:.2f} s{further}"
    )


target.context_settings = {"ignore_unknown_options": True}  # type: ignore[attr-defined]  # -2 is no option
