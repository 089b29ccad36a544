"""Commands that act on an active run: `status`, `fault`, `link`, `target`, and `metrics` for Prometheus."""

import inspect
import json
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_origin

import typer
from typer import Argument, Option

from transport.cli.lazy import with_options
from transport.cli.options import RUNS, FormatOption, ScenarioOption, SetOption, read_setup
from transport.cli.output import Format, blame, facts, fail, show
from transport.flight import live
from transport.flight.live import request
from transport.protocol.network.endpoints import Endpoints, default_mesh, process_names, security_of
from transport.protocol.network.session import BusError, ask
from transport.protocol.scenario.errors import requested
from transport.protocol.scenario.files import points_of
from transport.protocol.scenario.keys import key_of, meanings
from transport.protocol.scenario.link_sections import LinkSection
from transport.protocol.scenario.links import PERFECT, link_change
from transport.protocol.scenario.schema import Scenario, TargetSection
from transport.protocol.wire.keys import Keys
from transport.protocol.wire.names import COORDINATOR, PLANT, RECORDER

RunOption = Annotated[
    str | None,
    Option(
        "--run",
        metavar="RUN",
        help="Run folder or name; by default the most recent active run in runs/.",
    ),
]
ConnectOption = Annotated[
    list[str] | None,
    Option(
        "--connect",
        metavar="ENDPOINT",
        help="Zenoh endpoint of a process; then --run is the run's name.",
    ),
]
KeysOption = Annotated[
    Path | None,
    Option(
        "--keys",
        metavar="FOLDER",
        help="Folder of keys, with --connect; a run folder knows its keys.",
    ),
]


def find_active(run: str | None, advice: str) -> tuple[Path, live.LiveRun]:
    """Return folder and addresses of an active run, the most recent one by default; or end the command with advice."""
    folders = [live.newest_folder(RUNS)] if run is None else [Path(run), RUNS / run]
    found = next(
        ((at, there) for at in folders if at is not None and (there := live.read(at)) is not None),
        None,
    )
    if found is None:
        fail(f"no active run in {f'{RUNS}/' if run is None else run}; {advice}")
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class ActiveRun:
    """Options that select an active run."""

    run: RunOption = None
    connect: ConnectOption = None
    keys: KeysOption = None

    def ask(self, name: str, what: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """Return the answer of a process to a request (docs/protocol.md), or end the command."""
        if self.connect:
            if not (self.run and Keys.allows(self.run)):
                fail(f"--run: expected the name of a run with --connect, got {self.run!r}")
            return request(self.run, self.connect, name, what, arguments, self.keys)
        _, there = find_active(
            self.run, "name its folder with --run, or its endpoints with --connect"
        )
        if name not in there.endpoints:
            fail(f"--process: expected one of {', '.join(there.endpoints)}, got {name!r}")
        return there.ask(name, what, arguments, self.keys)


# Numbers in the answer of a process to `health` (docs/protocol.md): name in Prometheus, description. Two only grow.
METRICS = {
    "tick": ("tick", "Newest tick of the process"),
    "memory_bytes": ("memory_bytes", "Resident memory"),
    "threads": ("threads", "Threads"),
    "open_files": ("open_files", "Open files"),
    "incarnation": ("incarnation", "Number of this start of the process"),
    "cpu_s": ("cpu_seconds", "Processor time"),
    "refused": ("refused_messages", "Rejected messages"),
}
_GROWING = ("cpu_s", "refused")
# Timeout after which a process counts as down.
_TIMEOUT_S = 1.0


@with_options(ActiveRun)
def status(
    run: ActiveRun,
    process: str | None = Option(
        None, metavar="PROCESS", help="Process, such as plant, agent1 or recorder."
    ),
    output: FormatOption = Format.text,
) -> None:
    """Show the progress of a run, or the health of one process.

    Tick and roster; with --process its resource use and the messages it rejected.

    Example: transport status --process agent2
    """
    answer = (
        run.ask(COORDINATOR, "status", {}) if process is None else run.ask(process, "health", {})
    )
    show(output, answer, facts(answer.items()))


class Exporter:
    """Collector of `prometheus_client` that asks every process of a run, each at its endpoints, at each reading."""

    def __init__(self, run: str, places: dict[str, Endpoints]) -> None:
        self._run, self._places = run, places

    def collect(self) -> Iterator[Any]:
        """Yield the metrics, as `prometheus_client` expects of a collector."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        answers: dict[str, dict[str, Any]] = {}
        for name, place in self._places.items():
            try:
                answer = ask(
                    self._run, place.connect, name, "health", {}, _TIMEOUT_S, place.security
                )
                answers[name] = {**answer, "up": 1.0}
            except BusError:
                answers[name] = {"up": 0.0}
        for key, (metric, text) in {"up": ("up", "1 if the process answers"), **METRICS}.items():
            family = CounterMetricFamily if key in _GROWING else GaugeMetricFamily
            found = family(f"transport_{metric}", text, labels=["run", "process"])
            for name, answer in answers.items():
                if answer.get(key) is not None:
                    found.add_metric([self._run, name], float(answer[key]))
            yield found


def metrics(
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
    run: str | None = Option(
        None, metavar="NAME", help="Name of the run; the scenario's by default."
    ),
    connect: list[str] | None = Option(
        None,
        metavar="ENDPOINT",
        help="Endpoints of coordinator, plant, agent 1, ... in this order.",
    ),
    port: int = Option(
        9464, metavar="PORT", min=1, max=65535, help="Port to serve on, at 127.0.0.1."
    ),
    output: FormatOption = Format.text,
) -> None:
    """Export process metrics to Prometheus.

    Example: transport metrics --scenario resilient --port 9464
    """
    from prometheus_client import CollectorRegistry, start_http_server

    described = read_setup(scenario, settings, allow_large=True).scenario
    registry = CollectorRegistry()
    registry.register(Exporter(run or described.name, process_endpoints(described, connect)))
    try:
        server, thread = start_http_server(port, "127.0.0.1", registry)
    except OSError as error:
        fail(f"--port: cannot serve on {port} ({error.strerror})")
    address = f"http://127.0.0.1:{port}/metrics"
    show(output, {"address": address})
    typer.echo(address, err=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        server.shutdown()
        thread.join()


def process_endpoints(
    scenario: Scenario, connect: Sequence[str] | None = None
) -> dict[str, Endpoints]:
    """Return the endpoints at which to ask each process of a scenario, by name.

    Given endpoints, in the order of the mesh, replace the default ones.

    Raises: SecurityError: the keys cannot be used.
    """
    default = default_mesh(scenario)
    names = process_names(scenario)
    at = connect or [[*default[name].listen, *default[name].connect][0] for name in names]
    if len(at) != len(names):
        fail(f"--connect: expected {len(names)} endpoints, for {', '.join(names)}, got {len(at)}")
    security = security_of(scenario)
    return {
        name: Endpoints(listen=[], connect=[place], mode=default[name].mode, security=security)
        for name, place in zip(names, at, strict=True)
    }


@with_options(ActiveRun)
def fault(
    run: ActiveRun,
    action: Literal["kill", "stop", "continue", "restart"] = Argument(
        metavar="ACTION", help="kill, stop, continue or restart."
    ),
    target: str = Argument(metavar="PROCESS", help="agent1, agent2, ..., plant or coordinator."),
    output: FormatOption = Format.text,
) -> None:
    """Kill, stop, continue or restart a process of an active run.

    The fault is written to the log of the run.

    Example: transport fault kill agent3
    """
    answer = run.ask(RECORDER, "fault", {"do": action, "target": target})
    show(output, answer, f"{action} {target}: done at tick {answer['tick']}")


def _options() -> Iterator[inspect.Parameter]:
    """Yield the options that set the keys of a link."""
    meaning = meanings(LinkSection)
    for name, field in LinkSection.model_fields.items():
        if option := key_of(field).option:
            kind: Any = str if get_origin(field.annotation) is Literal else float
            text = f"{meaning[name][0].upper()}{meaning[name][1:]}.".replace("`", "")
            annotation = Annotated[kind | None, Option(option, help=text)]
            yield inspect.Parameter(
                name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation
            )


def _settings(**given: Any) -> dict[str, Any]:
    """Return the keys of a link whose options are given."""
    return {key: value for key, value in given.items() if value is not None}


_settings.__signature__ = inspect.Signature(list(_options()))  # type: ignore[attr-defined]


@with_options(_settings, ActiveRun)
def set_links(
    settings: dict[str, Any],
    run: ActiveRun,
    sender: str | None = Option(
        None,
        "--from",
        metavar="PROCESS",
        help="Sender: number of an agent, or plant; else all agents.",
    ),
    receiver: str | None = Option(
        None, "--to", metavar="PROCESS", help="Receiver, in the same way."
    ),
    output: FormatOption = Format.text,
) -> None:
    """Impair or repair links from the next tick on.

    Options that are not given keep their values.

    Example: transport link set --from 1 --to 2 --delay 0.1
    """
    if not settings:
        fail("expected at least one of --delay, --jitter, --loss, ..., got none")
    link_change("", "", json.dumps(settings))
    ends = {"from": _process_name(sender), "to": _process_name(receiver)}
    answer = run.ask(COORDINATOR, "link", {**ends, "settings": settings})
    show(output, answer, f"links change with tick {answer['tick']} (t = {answer['t_s']:.2f} s)")


@with_options(ActiveRun)
def clear_links(run: ActiveRun, output: FormatOption = Format.text) -> None:
    """Remove all impairments, also from the plant's links.

    Example: transport link clear
    """
    for ends in ({}, {"from": PLANT}, {"to": PLANT}):
        answer = run.ask(COORDINATOR, "link", {**ends, "settings": dict(PERFECT)})
    cleared = "all links: delay 0, loss 0, no other impairment"
    show(output, answer, f"{cleared}, from tick {answer['tick']} on (t = {answer['t_s']:.2f} s)")


def _process_name(end: str | None) -> str:
    """Return the name of a process given as 2, agent2 or plant; empty for all agents."""
    return "" if end is None else f"agent{end}" if end.isdecimal() else end


@with_options(ActiveRun)
def target(
    run: ActiveRun,
    x: float | None = Argument(
        None, metavar="X", help="Position in the inertial frame, m: forwards."
    ),
    y: float | None = Argument(None, metavar="Y", help="To the right."),
    z: float | None = Argument(None, metavar="Z", help="Downwards."),
    speed: float | None = Option(
        None, metavar="MPS", min=1e-3, help="Largest speed; else up to 1 m/s, if feasible."
    ),
    file: Path | None = Option(
        None, metavar="CSV", help="Way points instead: columns x,y,z, or t,x,y,z without --speed."
    ),
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
        fail(f"expected X Y Z, or --file, got {len(point)} numbers{' and --file' if file else ''}")
    given: dict[str, Any] = {"points_m": [point]}
    if file is not None:
        with blame("--file"):
            given["points_m"], times_s = points_of(file)
        given |= {} if times_s is None else {"times_s": times_s}
    given |= {} if speed is None else {"speed_mps": speed}
    requested(TargetSection, given)
    answer = run.ask(COORDINATOR, "target", given)
    show(
        output,
        answer,
        f"target from tick {answer['tick']} on (t = {answer['t_s']:.2f} s), "
        f"reached at t = {answer['reached_s']:.2f} s, the last way point at t = {answer['ends_s']:.2f} s",
    )


target.context_settings = {"ignore_unknown_options": True}  # type: ignore[attr-defined]  # -2 is no option
