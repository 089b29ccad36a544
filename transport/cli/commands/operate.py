"""Commands that act on an active run: `status`, `fault`, `link`, `target`, `land`, `abort`, `metrics`."""

import inspect
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import typer
from typer import Argument, Option

from transport.cli.active import ActiveRunOption
from transport.cli.lazy import with_options
from transport.cli.options import FormatOption, ScenarioOption, SetOption, read_setup
from transport.cli.output import Format, blame, facts, fail, show
from transport.flight.signals import take_interrupt
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.mesh import default_mesh, process_names, security_of
from transport.protocol.network.session import BusError, Reach, ask
from transport.protocol.scenario.files.named_files import points_of
from transport.protocol.scenario.links.link_changes import PERFECT, split_groups
from transport.protocol.scenario.sections.link_sections import LinkSection
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.scenario_errors import requested
from transport.protocol.scenario.sections.scenario_keys import key_of, meanings, unit_of
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.wire.key_expressions import Keys
from transport.protocol.wire.names import COORDINATOR, RECORDER

# Numbers in the answer of a process to `health` (docs/reference/protocol.md): name in Prometheus and
# description.
METRICS = {
    "tick": ("tick", "Newest tick of the process"),
    "memory_bytes": ("memory_bytes", "Resident memory"),
    "threads": ("threads", "Threads"),
    "open_files": ("open_files", "Open files"),
    "incarnation": ("incarnation", "Number of this start of the process"),
    "cpu_s": ("cpu_seconds", "Processor time"),
    "refused": ("refused_messages", "Rejected messages"),
}
# Those that only grow while a process runs are counters, all others gauges.
_GROWING = ("cpu_s", "refused")
# Timeout after which a process counts as down.
_TIMEOUT_S = 1.0
# Processes that are asked at the same time. Prometheus waits 10 s for a reading: one after the other,
# a few unreachable processes would take longer.
_AT_ONCE = 16
_LOOKS_FOR_SIGNALS_S = 0.2


@with_options(ActiveRunOption)
def status(
    run: ActiveRunOption,
    process: str | None = Option(
        None,
        metavar="PROCESS",
        help="Number of an agent, agent1, ..., plant, coordinator or recorder.",
    ),
    output: FormatOption = Format.text,
) -> None:
    """Show the progress of a run, or the health of one process.

    Tick and roster; with --process its resource use and the messages it rejected.

    Example: transport status --process agent2
    """
    asked, kind = (COORDINATOR, "status") if process is None else (_process_name(process), "health")
    answer = run.ask(asked, kind, {})
    show(output, answer, facts(answer.items()))


class Exporter:
    """Collector of `prometheus_client` that asks processes of a run at each reading."""

    def __init__(self, run: str, places: Mapping[str, Endpoints]) -> None:
        self._run = run
        self._places = places

    def collect(self) -> Iterator[Any]:
        """Yield the metrics, as `prometheus_client` expects of a collector."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        with ThreadPoolExecutor(_AT_ONCE) as pool:
            readings = dict(zip(self._places, pool.map(self._read, self._places), strict=True))

        for key, (metric, text) in {"up": ("up", "1 if the process answers"), **METRICS}.items():
            family = CounterMetricFamily if key in _GROWING else GaugeMetricFamily
            samples = family(f"transport_{metric}", text, labels=["run", "process"])
            for name, reading in readings.items():
                if reading.get(key) is not None:
                    samples.add_metric([self._run, name], float(reading[key]))
            yield samples

    def _read(self, name: str) -> dict[str, Any]:
        """Return the health of a process, and `up`: 1, or 0 alone if it does not answer in time."""
        place = self._places[name]
        reach = Reach(connect=place.connect, security=place.security, timeout_s=_TIMEOUT_S)
        try:
            answer = ask(self._run, reach, name, "health", {})
        except BusError:
            return {"up": 0.0}
        return {**answer, "up": 1.0}


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
        # Waits for Ctrl-C, and wakes up to see it: a signal that a thread of the server takes does
        # not end the sleep of this one.
        while True:
            time.sleep(_LOOKS_FOR_SIGNALS_S)
    except KeyboardInterrupt:
        take_interrupt()
        server.shutdown()
        thread.join()


def process_endpoints(
    scenario: Scenario, connect: Sequence[str] | None = None
) -> dict[str, Endpoints]:
    """Return the endpoints at which to ask each process of a scenario but the recorder, by name.

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


@with_options(ActiveRunOption)
def fault(
    run: ActiveRunOption,
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


def _link_option_parameters() -> Iterator[inspect.Parameter]:
    """Yield a parameter for each key of a link that has an option."""
    meaning = meanings(LinkSection)
    for name, field in LinkSection.model_fields.items():
        option = key_of(field).option
        if not option:
            continue

        kind: Any = _option_type(field.annotation)
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


def _option_type(annotation: Any) -> Any:
    """Return the type that an option has for a key: that of the key, without None and range.

    A choice of words is text: the section checks it, with an error like those of scenario files.
    """
    origin = get_origin(annotation)
    if origin is Literal:
        return str
    if origin is Annotated:
        return _option_type(get_args(annotation)[0])
    if origin in {Union, UnionType}:
        (given,) = (member for member in get_args(annotation) if member is not NoneType)
        return _option_type(given)
    return annotation


def _given_link_settings(**options: Any) -> dict[str, Any]:
    """Return the keys of a link whose options are given."""
    return {key: value for key, value in options.items() if value is not None}


# Typer sees the keys of `LinkSection` as options; `with_options` passes their values here.
_given_link_settings.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
    list(_link_option_parameters())
)


@with_options(_given_link_settings, ActiveRunOption)
def set_links(
    settings: dict[str, Any],
    run: ActiveRunOption,
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
        help="All links between groups of agents, both ways, in place of --from and --to: 1,2/3,4, "
        "or '1,2|3,4'.",
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
    # An error of a value is told here already, before the run is asked.
    requested(LinkSection, settings)

    changed: dict[str, Any] = {}
    if sender is not None:
        changed["from"] = _process_name(sender)
    if receiver is not None:
        changed["to"] = _process_name(receiver)
    if groups is not None:
        changed["groups"] = _groups(groups)
    answer = run.ask(COORDINATOR, "link", {**changed, "settings": settings})
    show(output, answer, f"links change with tick {answer['tick']} (t = {answer['t_s']:.2f} s)")


@with_options(ActiveRunOption)
def clear_links(run: ActiveRunOption, output: FormatOption = Format.text) -> None:
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
    """Return the names of agents in groups, as `split_groups` reads them.

    A single group is refused.
    """
    groups = split_groups(text)
    if len(groups) < 2:
        expected = "expected groups with a slash or | between them, such as 1,2/3,4"
        fail(f"--between: {expected}, got {text}")
    return [[_process_name(agent) for agent in group] for group in groups]


@with_options(ActiveRunOption)
def target(
    run: ActiveRunOption,
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
    to: list[int] = Option(
        [],
        metavar="AGENT",
        min=1,
        help="Agent that is told, repeatable; the others learn it from plans.",
    ),
    output: FormatOption = Format.text,
) -> None:
    """Send the payload of an active run to a target.

    From the next tick on the reference leaves its path smoothly, also that to an earlier target,
    and comes to rest there. A target that cannot be flown is refused with the reason. Way points
    are run through on a smooth curve after the first one. With --to the target travels with plans,
    over the links of the run, from the agents that are told to the others.

    Exit codes: 0 accepted; 2 refused; 4 no answer.

    Example: transport target 3 0 -12 --speed 1.5

    Example: transport target 3 0 -12 --to 2
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
    if to:
        given["to"] = to
    requested(TargetSection, given)  # refused here already, as in `set_links`

    answer = run.ask(COORDINATOR, "target", given)
    begin = f"target from tick {answer['tick']} on (t = {answer['t_s']:.2f} s)"
    reached = f"reached at t = {answer['reached_s']:.2f} s"
    end = f"the last way point at t = {answer['ends_s']:.2f} s"
    show(output, answer, f"{begin}, {reached}, {end}")


@with_options(ActiveRunOption)
def land(
    run: ActiveRunOption,
    x: float | None = Argument(
        None, metavar="X", help="Place in the inertial frame, m: forwards; else where it is."
    ),
    y: float | None = Argument(None, metavar="Y", help="To the right."),
    speed: float | None = Option(
        None, metavar="MPS", min=1e-3, help="Largest speed; else up to 0.5 m/s downwards."
    ),
    output: FormatOption = Format.text,
) -> None:
    """Let the team of an active run come down, and rest.

    From the next tick on the reference leaves its path and leads down to the ground, where the payload
    is or at a place to which it goes first. A landing that cannot be flown before the end of the run is
    refused with the reason.

    Exit codes: 0 accepted; 2 refused; 4 no answer.

    Example: transport land 3 0
    """
    if (x is None) != (y is None):
        fail("expected X Y, or none of them, got 1 number")
    given: dict[str, Any] = {"land": True}
    if x is not None:
        given["land_at_m"] = [x, y]
    if speed is not None:
        given["speed_mps"] = speed
    answer = run.ask(COORDINATOR, "target", given)
    show(output, answer, _landing_in_words(answer))


def _landing_in_words(answer: Mapping[str, Any]) -> str:
    """Return when and where a landing begins and ends."""
    begin = f"landing from tick {answer['tick']} on (t = {answer['t_s']:.2f} s)"
    x_m, y_m, z_m = answer["point_m"]
    return f"{begin}, at ({x_m:g}, {y_m:g}, {z_m:g}) m at t = {answer['ends_s']:.2f} s"


@with_options(ActiveRunOption)
def abort(run: ActiveRunOption, output: FormatOption = Format.text) -> None:
    """Let a team of vehicles come down at once, as fast as it can.

    As `transport land` where it is, up to 2 m/s downwards; the run is aborted when it ends. The UAVs
    are on their rods until `transport release`, or the end of the run: no autopilot takes over before.

    Exit codes: 0 accepted; 2 refused; 4 no answer.

    Example: transport abort
    """
    answer = run.ask(COORDINATOR, "abort", {})
    show(output, answer, _landing_in_words(answer))


@with_options(ActiveRunOption)
def release(run: ActiveRunOption, output: FormatOption = Format.text) -> None:
    """End a run whose UAVs have landed and are off their rods.

    The run ends, and each autopilot holds its UAV, or lands it with `vehicles.at_end` land. Refused
    until the team is at rest after `transport land` or `transport abort`.

    Exit codes: 0 accepted; 2 refused; 4 no answer.

    Example: transport release
    """
    answer = run.ask(COORDINATOR, "release", {})
    show(output, answer, f"released at tick {answer['tick']} (t = {answer['t_s']:.2f} s)")


# A negative coordinate such as -2 is no option.
land.context_settings = {"ignore_unknown_options": True}  # type: ignore[attr-defined]
target.context_settings = {"ignore_unknown_options": True}  # type: ignore[attr-defined]
