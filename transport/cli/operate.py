"""Commands that act on an active run: `status`, `fault`, `link`, `target` and `metrics`."""

import inspect
import json
import re
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_origin

import typer
from typer import Argument, Option

from transport.cli.active import ActiveRun
from transport.cli.lazy import with_options
from transport.cli.options import FormatOption, ScenarioOption, SetOption, read_setup
from transport.cli.output import Format, blame, facts, fail, show
from transport.flight.signals import take_interrupt
from transport.protocol.network.endpoints import Endpoints, default_mesh, process_names, security_of
from transport.protocol.network.session import BusError, Reach, ask
from transport.protocol.scenario.errors import requested
from transport.protocol.scenario.keys import key_of, meanings, unit_of
from transport.protocol.scenario.link_changes import PERFECT, link_change
from transport.protocol.scenario.link_sections import LinkSection
from transport.protocol.scenario.maneuver_sections import TargetSection
from transport.protocol.scenario.named_files import points_of
from transport.protocol.scenario.schema import Scenario
from transport.protocol.wire.keys import Keys
from transport.protocol.wire.names import COORDINATOR, RECORDER

# Numbers in the answer of a process to `health` (docs/protocol.md): name in Prometheus and
# description. Two only grow.
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
_LOOKS_FOR_SIGNALS_S = 0.2


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
    asked = COORDINATOR if process is None else process
    answer = run.ask(asked, "status" if process is None else "health", {})
    show(output, answer, facts(answer.items()))


class Exporter:
    """Collector of `prometheus_client` that asks every process of a run at each reading."""

    def __init__(self, run: str, places: dict[str, Endpoints]) -> None:
        self._run = run
        self._places = places

    def collect(self) -> Iterator[Any]:
        """Yield the metrics, as `prometheus_client` expects of a collector."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        answers: dict[str, dict[str, Any]] = {}
        for name, place in self._places.items():
            try:
                reach = Reach(connect=place.connect, security=place.security, timeout_s=_TIMEOUT_S)
                answer = ask(self._run, reach, name, "health", {})
                answers[name] = {**answer, "up": 1.0}
            except BusError:
                answers[name] = {"up": 0.0}
        for key, (metric, text) in {"up": ("up", "1 if the process answers"), **METRICS}.items():
            family = CounterMetricFamily if key in _GROWING else GaugeMetricFamily
            samples = family(f"transport_{metric}", text, labels=["run", "process"])
            for name, answer in answers.items():
                if answer.get(key) is not None:
                    samples.add_metric([self._run, name], float(answer[key]))
            yield samples


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
    name = run or described.name
    if not Keys.allows(name):
        fail(f"--run: expected the name of a run, as its processes have it, got {name!r}")
    registry = CollectorRegistry()
    registry.register(Exporter(name, process_endpoints(described, connect)))
    try:
        server, thread = start_http_server(port, "127.0.0.1", registry)
    except OSError as error:
        fail(f"--port: cannot serve on {port} ({error.strerror})")
    address = f"http://127.0.0.1:{port}/metrics"
    show(output, {"address": address})
    typer.echo(address, err=True)
    try:
        # A signal that a thread of the server takes does not wake this one.
        while True:
            time.sleep(_LOOKS_FOR_SIGNALS_S)
    except KeyboardInterrupt:
        take_interrupt()
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
    addresses = connect or [[*default[name].listen, *default[name].connect][0] for name in names]
    if len(addresses) != len(names):
        expected = f"expected {len(names)} endpoints, for {', '.join(names)}"
        fail(f"--connect: {expected}, got {len(addresses)}")

    security = security_of(scenario)
    return {
        name: Endpoints(listen=[], connect=[address], mode=default[name].mode, security=security)
        for name, address in zip(names, addresses, strict=True)
    }


@with_options(ActiveRun)
def fault(
    run: ActiveRun,
    action: Literal["kill", "stop", "continue", "restart"] = Argument(
        metavar="ACTION", help="kill, stop, continue or restart."
    ),
    target: str = Argument(
        metavar="PROCESS", help="Number of an agent, agent1, ..., plant or coordinator."
    ),
    output: FormatOption = Format.text,
) -> None:
    """Kill, stop, continue or restart a process of an active run.

    The fault is written to the log of the run.

    Example: transport fault kill agent3
    """
    target = _process_name(target)
    answer = run.ask(RECORDER, "fault", {"do": action, "target": target})
    show(output, answer, f"{action} {target}: done at tick {answer['tick']}")


def _options() -> Iterator[inspect.Parameter]:
    """Yield the options that set the keys of a link."""
    meaning = meanings(LinkSection)
    for name, field in LinkSection.model_fields.items():
        option = key_of(field).option
        if not option:
            continue

        kind: Any = str if get_origin(field.annotation) is Literal else float
        sentence = meaning[name]
        unit = unit_of(name, field)
        after = f", {unit}" if unit else ""
        text = f"{sentence[0].upper()}{sentence[1:]}{after}.".replace("`", "")
        yield inspect.Parameter(
            name,
            inspect.Parameter.KEYWORD_ONLY,
            default=None,
            annotation=Annotated[kind | None, Option(option, help=text)],
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
    groups: str | None = Option(
        None,
        "--between",
        metavar="GROUPS",
        help="All links between groups of agents, both ways, in place of --from and --to: 1,2/3,4.",
    ),
    output: FormatOption = Format.text,
) -> None:
    """Impair or repair links from the next tick on.

    Options that are not given keep their values.

    Example: transport link set --from 1 --to 2 --delay 0.1

    Example: transport link set --between 1,2/3,4 --loss 1
    """
    if not settings:
        fail("expected at least one of --delay, --jitter, --loss, ..., got none")
    link_change("", "", json.dumps(settings))
    changed: dict[str, Any] = {}
    if sender is not None:
        changed["from"] = _process_name(sender)
    if receiver is not None:
        changed["to"] = _process_name(receiver)
    if groups is not None:
        changed["groups"] = _groups(groups)
    answer = run.ask(COORDINATOR, "link", {**changed, "settings": settings})
    show(output, answer, f"links change with tick {answer['tick']} (t = {answer['t_s']:.2f} s)")


@with_options(ActiveRun)
def clear_links(run: ActiveRun, output: FormatOption = Format.text) -> None:
    """Remove all impairments, also from the plant's links.

    Example: transport link clear
    """
    answer = run.ask(COORDINATOR, "link", {"all": True, "settings": dict(PERFECT)})
    cleared = "all links: delay 0, loss 0, no other impairment"
    show(output, answer, f"{cleared}, from tick {answer['tick']} on (t = {answer['t_s']:.2f} s)")


def _process_name(end: str) -> str:
    """Return the name of a process given as 2, agent2 or plant."""
    return f"agent{end}" if end.isdecimal() else end


def _groups(text: str) -> list[list[str]]:
    """Return the names of agents in groups given as 1,2/3,4; a single group is refused."""
    if not re.search("[/|]", text):
        fail(f"--between: expected groups with a slash between them, such as 1,2/3,4, got {text}")
    return [
        [_process_name(name.strip()) for name in group.split(",")]
        for group in re.split("[/|]", text)
    ]


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

    From the next tick on the reference leaves its path smoothly, also that to an earlier target,
    and comes to rest there. A target that cannot be flown is refused with the reason. Way points
    are run through on a smooth curve after the first one.

    Exit codes: 0 accepted; 2 refused; 4 no answer.

    Example: transport target 3 0 -12 --speed 1.5
    """
    coordinates = [value for value in (x, y, z) if value is not None]
    expected = 3 if file is None else 0
    if len(coordinates) != expected:
        also = "" if file is None else " and --file"
        fail(f"expected X Y Z, or --file, got {len(coordinates)} numbers{also}")

    given: dict[str, Any] = {"points_m": [coordinates]}
    if file is not None:
        with blame("--file"):
            given["points_m"], times_s = points_of(file)
        if times_s is not None:
            given["times_s"] = times_s
    if speed is not None:
        given["speed_mps"] = speed
    requested(TargetSection, given)

    answer = run.ask(COORDINATOR, "target", given)
    begin = f"target from tick {answer['tick']} on (t = {answer['t_s']:.2f} s)"
    reached = f"reached at t = {answer['reached_s']:.2f} s"
    end = f"the last way point at t = {answer['ends_s']:.2f} s"
    show(output, answer, f"{begin}, {reached}, {end}")


# A negative coordinate such as -2 is no option.
target.context_settings = {"ignore_unknown_options": True}  # type: ignore[attr-defined]
