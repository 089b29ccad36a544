"""The command line. Heavy imports are inside the commands: six processes start at once."""

import re
import shlex
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from protocol.wire.exit_codes import EXIT_INTERRUPTED, EXIT_SCENARIO, EXIT_UNREACHABLE, EXIT_USAGE
from transport.cli.answers import Format, fail, read_setup
from transport.cli.compare_commands import compare
from transport.cli.deploy_commands import deploy_app, router
from transport.cli.doctor_commands import doctor
from transport.cli.experiment_commands import experiment_app
from transport.cli.log_commands import log_app
from transport.cli.metrics import metrics
from transport.cli.operate import fault, link_app, status
from transport.cli.replay_commands import replay
from transport.cli.top_commands import top
from transport.cli.viewer_commands import view
from transport.cli.viewer_options import HostOption, PortOption, check_viewer
from transport.viewer.process import viewer_beside

if TYPE_CHECKING:
    from collections.abc import Callable

    from protocol.network.process import Place
    from protocol.scenario.setup import Setup


app = typer.Typer(
    name="transport",
    help="Several UAVs carry one payload; each runs its own model predictive controller as a process of its own.\n\n"
    "Start with: transport run paper",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    epilog="Exit codes: 0 done, 2 usage, 3 scenario, 4 peer lost or not reachable, "
    "5 deadlines missed, 6 diverged, 8 plans differ (replay), 9 a check failed (doctor), 130 interrupted.",
)
app.add_typer(link_app, name="link")
app.add_typer(experiment_app, name="experiment")
scenario_app = typer.Typer(help="Make scenarios.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(scenario_app, name="scenario")
app.command()(fault)
app.command()(status)
app.command()(view)
app.command()(replay)
app.command()(top)
app.command()(compare)
app.command()(doctor)
app.add_typer(log_app, name="log")
app.add_typer(deploy_app, name="deploy")
app.command()(router)
app.command()(metrics)


ScenarioArgument = Annotated[
    str,
    typer.Argument(
        help="Scenario file, or the name of a ready one: paper, centralized, resilient, windy, collision.",
        show_default=True,
    ),
]
ScenarioOption = Annotated[str, typer.Option("--scenario", help="Scenario file or name; the same for all processes.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a scenario value, e.g. controller.horizon=10. Repeatable."),
]
RunOption = Annotated[
    str | None, typer.Option("--run", help="Name of the run, part of every key; the scenario's name by default.")
]
ListenOption = Annotated[
    list[str] | None, typer.Option("--listen", help="Zenoh endpoint to listen on, e.g. tcp/127.0.0.1:7449.")
]
ConnectOption = Annotated[
    list[str] | None, typer.Option("--connect", help="Zenoh endpoint of another process. Repeatable.")
]
IncarnationOption = Annotated[
    int | None, typer.Option("--incarnation", min=0, help="Which start of this process; the time by default.")
]
JoinOption = Annotated[
    float | None,
    typer.Option("--join-timeout", min=0.0, help="Seconds to wait for the others; else the scenario's."),
]


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"transport {version('payload-transport')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """What can be asked without a command."""


@app.command()
def run(
    scenario: ScenarioArgument = "paper",
    settings: SetOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Run folder to create; by default runs/<time>-<scenario>.")
    ] = None,
    output: Annotated[Format, typer.Option("--format", help="What goes to standard output.")] = Format.text,
    figures: Annotated[bool, typer.Option("--figures/--no-figures", help="Draw the figures at the end.")] = True,
    viewed: Annotated[bool, typer.Option("--view", help="Show it in the browser while it flies, and after.")] = False,
    host: HostOption = "127.0.0.1",
    port: PortOption = 8080,
) -> None:
    """Fly a scenario with all its processes, record and report it.

    One process per agent, a plant, a coordinator; log, metrics and figures in a run folder.

    Example: transport run paper --set controller.relaxation=0.5 --out runs/relaxed
    """
    from transport.flight.fork_server import fork_server

    fork_server()  # imports for the processes of the run, while this one does so for itself

    from rich.console import Console

    from transport.flight.harness import HarnessError
    from transport.flight.run import RunError, new_folder, simulate

    console = Console(stderr=True)
    setup = read_setup(scenario, settings)
    folder = out if out is not None else new_folder(Path("runs"), setup.scenario.name)
    if viewed:
        check_viewer()
    with viewer_beside(folder, host, port, setup.scenario.clock.join_timeout_s) if viewed else nullcontext() as linger:
        try:
            finished = simulate(setup, folder, console)
        except RunError as error:
            fail(str(error), error.exit_code)
        except HarnessError as error:
            fail(str(error), EXIT_UNREACHABLE)
        _report(finished.folder, output, figures, setup)
        if linger is not None and finished.exit_code != EXIT_INTERRUPTED:
            linger()
    if finished.exit_code != 0:
        fail(finished.reason, finished.exit_code)


@app.command()
def agent(
    number: Annotated[int, typer.Option("--id", min=1, help="Which agent, from 1.")],
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
    run_name: RunOption = None,
    listen: ListenOption = None,
    connect: ConnectOption = None,
    incarnation: IncarnationOption = None,
    join_timeout: JoinOption = None,
) -> None:
    """Run one agent: the controller of the UAVs it owns.

    Example: transport agent --id 2
    """
    setup = read_setup(scenario, settings)
    if number not in setup.agents:
        known = f"1 to {len(setup.agents)} of scenario {setup.scenario.name}"
        fail(f"--id: expected an agent from {known}, got {number}", EXIT_USAGE)
    place = _place(setup, f"agent{number}", run_name, listen, connect, incarnation, join_timeout)

    def body() -> int:
        from agent.main import run as run_agent

        return run_agent(setup, place, number)

    _process(body)


@app.command()
def plant(
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
    run_name: RunOption = None,
    listen: ListenOption = None,
    connect: ConnectOption = None,
    incarnation: IncarnationOption = None,
    join_timeout: JoinOption = None,
) -> None:
    """Run the plant: the physics and the actuators."""
    setup = read_setup(scenario, settings)
    place = _place(setup, "plant", run_name, listen, connect, incarnation, join_timeout)

    def body() -> int:
        from plant.main import run as run_plant

        return run_plant(setup, place)

    _process(body)


@app.command()
def coordinator(
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
    run_name: RunOption = None,
    listen: ListenOption = None,
    connect: ConnectOption = None,
    incarnation: IncarnationOption = None,
    join_timeout: JoinOption = None,
    observer: Annotated[
        list[str] | None, typer.Option("--observer", help="Also wait for this process before the first tick: recorder.")
    ] = None,
) -> None:
    """Run the coordinator: the sampling clock and the roster."""
    setup = read_setup(scenario, settings)
    place = _place(setup, "coordinator", run_name, listen, connect, incarnation, join_timeout)

    def body() -> int:
        from coordinator.main import run as run_coordinator

        return run_coordinator(setup, place, observer or [])

    _process(body)


@app.command()
def record(
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
    run_name: RunOption = None,
    connect: ConnectOption = None,
    out: Annotated[Path | None, typer.Option("--out", help="Run folder to create.")] = None,
    join_timeout: JoinOption = None,
    figures: Annotated[bool, typer.Option("--figures/--no-figures", help="Draw the figures at the end.")] = True,
) -> None:
    """Record and report a run whose processes were started by hand.

    Start it before the coordinator opens the first tick: transport coordinator --observer recorder
    """
    from rich.console import Console

    from transport.flight.run import RunError, new_folder, observe

    setup = read_setup(scenario, settings)
    place = _place(setup, "recorder", run_name, None, connect, None, join_timeout)
    folder = out if out is not None else new_folder(Path("runs"), setup.scenario.name)
    try:
        finished = observe(setup, place, folder, Console(stderr=True))
    except RunError as error:
        fail(str(error), error.exit_code)
    _report(finished.folder, Format.text, figures, setup)
    if finished.exit_code != 0:
        fail(finished.reason, finished.exit_code)


@app.command()
def validate(scenario: ScenarioArgument, settings: SetOption = None) -> None:
    """Check a scenario and print it with every default."""
    import tomli_w

    setup = read_setup(scenario, settings)
    typer.echo(tomli_w.dumps(setup.scenario.tree()), nl=False)
    for doubt in setup.doubts():
        typer.echo(f"warning: {doubt}", err=True)
    hover = ", ".join(f"{thrust:.2f}" for thrust in setup.hover.u[::4])
    sizes = f"{setup.system.N} UAVs, {len(setup.agents)} agents, {setup.ticks} ticks"
    typer.echo(f"valid: {sizes}, hover thrust {hover} N, digest {setup.scenario.digest()}", err=True)


@app.command()
def plot(
    folder: Annotated[Path, typer.Argument(help="Run folder.")],
    output: Annotated[Format, typer.Option("--format", help="What goes to standard output.")] = Format.text,
    animation: Annotated[
        Path | None, typer.Option("--animate", metavar="FILE", help="Also draw it moving, as .gif or .mp4 (ffmpeg).")
    ] = None,
) -> None:
    """Make metrics and figures of a recorded run anew.

    Works on the log of a run that was cut off, too.

    Example: transport plot runs/20260102-101500-paper --animate flight.gif
    """
    from transport.log.run_log import LogError, read_log
    from transport.report.animation import AnimationError, animate_run, check_animation

    try:
        check_animation(animation)
        if not read_log(folder / "run.mcap", horizons=False).messages:
            fail(f"{folder / 'run.mcap'}: not one message can be read", EXIT_USAGE)
    except LogError as error:
        fail(str(error), EXIT_USAGE)
    except AnimationError as error:
        fail(f"--animate: {error}", EXIT_USAGE)
    _report(folder, output, figures=True, setup=None)
    if animation is not None:
        try:
            animate_run(folder, animation)
        except (AnimationError, LogError, OSError) as error:
            fail(f"--animate: {error}", EXIT_USAGE)
        typer.echo(f" {animation}", err=output is Format.json)


@scenario_app.command("new")
def scenario_new(
    uavs: Annotated[int, typer.Option("--uavs", help="Number of UAVs, 2 to 256.")],
    template: Annotated[
        str, typer.Option("--from", help="Scenario file or name that everything but the system is taken from.")
    ] = "resilient",
    group: Annotated[
        int | None,
        typer.Option("--groups", help="UAVs per agent: 1 for one agent each, 2 for pairs; by default as in --from."),
    ] = None,
    name: Annotated[
        str | None, typer.Option("--name", help="Name of the scenario; by default that of --from and the number.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="File to write; by default standard output.")] = None,
) -> None:
    """Write a scenario for a team of any size.

    UAVs in a ring, neighbours as far apart as the paper's four, 0.75 kg of payload for each.

    Example: transport scenario new --uavs 6 --out six.toml
    """
    from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
    from protocol.scenario.setup import Setup
    from protocol.scenario.team import FEWEST, MOST, given, resized
    from transport.cli.scenario_text import scenario_text

    if not FEWEST <= uavs <= MOST:
        why = ": a payload on one rod turns freely about it, and no UAV can turn it back" if uavs == 1 else ""
        fail(f"--uavs: expected {FEWEST} to {MOST}, got {uavs}{why}", EXIT_USAGE)
    if group is not None and not 1 <= group <= uavs:
        fail(f"--groups: expected 1 to {uavs} UAVs per agent, got {group}", EXIT_USAGE)
    if out is not None and out.exists():
        fail(f"--out: expected a file that does not exist yet, got {out}", EXIT_USAGE)
    try:
        path = find_scenario(template)
        ready = read_scenario(path)
    except ScenarioError as error:
        fail(f"--from: {error}", EXIT_SCENARIO)
    source = f"--from {template}"
    try:
        scenario = resized(ready, path.parent, uavs, group=group, name=name, source=source)
        setup = Setup.of(scenario, source)
    except ScenarioError as error:
        if error.field == "name":
            fail(f"--name: {error.problem}", EXIT_USAGE)
        fail(str(error), EXIT_SCENARIO)
    made_by = ["transport", "scenario", "new", "--uavs", str(uavs), "--from", template]
    made_by += [] if group is None else ["--groups", str(group)]
    made_by += [] if name is None else ["--name", name]
    text = scenario_text(
        given(scenario),
        comment=[
            f"Made by: {shlex.join(made_by)}",
            f"{uavs} UAVs in a ring over a payload that fits; all but [system], owned and name is from {ready.name}.",
        ],
    )
    if out is None:
        typer.echo(text, nl=False)
        return
    try:
        with out.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        fail(f"--out: cannot write {out} ({error.strerror})", EXIT_USAGE)
    sizes = f"{setup.system.N} UAVs, {len(setup.agents)} agents, hover thrust {setup.hover.u[0]:.2f} N"
    typer.echo(f"{sizes}; fly it with: transport run {shlex.quote(str(out))}", err=True)


def _place(
    setup: "Setup",
    name: str,
    run_name: str | None,
    listen: list[str] | None,
    connect: list[str] | None,
    incarnation: int | None,
    join_timeout: float | None,
) -> "Place":
    import time

    from protocol.network.endpoints import endpoints_of
    from protocol.network.process import Place
    from protocol.network.security import SecurityError
    from protocol.wire.keys import Keys, RunNameError

    run_name = run_name or setup.scenario.name
    try:
        Keys(run_name)
    except RunNameError as error:
        fail(f"--run: {error}", EXIT_USAGE)
    for option, given in (("--listen", listen), ("--connect", connect)):
        for endpoint in given or []:
            if not re.fullmatch(r"[a-z0-9-]+/\S+", endpoint):
                fail(f"{option}: expected an endpoint such as tcp/127.0.0.1:7447, got {endpoint!r}", EXIT_USAGE)
    try:
        endpoints = endpoints_of(name, setup.scenario, listen, connect)
    except SecurityError as error:
        fail(str(error), EXIT_SCENARIO)
    return Place(
        run=run_name,
        incarnation=time.time_ns() // 10**6 if incarnation is None else incarnation,
        endpoints=endpoints,
        join_timeout_s=setup.scenario.clock.join_timeout_s if join_timeout is None else join_timeout,
    )


def _process(body: "Callable[[], int]") -> None:
    from protocol.network.session import BusError

    try:
        code = body()
    except BusError as error:
        fail(str(error), EXIT_UNREACHABLE)
    raise typer.Exit(code)


def _report(folder: Path, output: Format, figures: bool, setup: "Setup | None") -> None:
    from rich.console import Console

    from protocol.scenario.file import ScenarioError
    from transport.log.run_log import LogError
    from transport.report.report import summary_table, write_report

    try:
        summary = write_report(folder, figures=figures, setup=setup)
    except LogError as error:
        fail(str(error), EXIT_USAGE)
    except ScenarioError as error:
        fail(str(error), EXIT_SCENARIO)
    if output is Format.json:
        import orjson

        sys.stdout.write(orjson.dumps(summary, option=orjson.OPT_INDENT_2).decode() + "\n")
        return
    Console().print(summary_table(summary))
    for file in ["summary.json", "steps.csv", "run.mcap", *[f"figures/{p.name}" for p in folder.glob("figures/*.png")]]:
        typer.echo(f" {folder / file}")
