"""Commands that start one process of a run by hand, or connect hosts, and the server that forks processes.

The commands are agent, coordinator, plant, vehicle, record and router. Each imports only its own role: the
processes of a run start with these commands. `transport run` forks them from one server process, which has the
imports, the model and the control law already (`fork_server_process.py`).
"""

import re
import signal
import threading
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Option

from transport.cli.lazy import with_options
from transport.cli.options import (
    RUNS,
    FiguresOption,
    FormatOption,
    LargeOption,
    ScenarioOption,
    SetOption,
    forget_setup,
    process_setup,
    read_setup,
)
from transport.cli.output import Format, blame, fail
from transport.model.kernels.casadi_functions import needs_compilation
from transport.protocol.network.bus_events_and_clock import Place, wall_offset_ns
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.mesh import endpoints_of, process_names, security_of
from transport.protocol.network.node_process import Journal, run_node
from transport.protocol.scenario.sections.lockstep_and_realtime_section import LONGEST_WAIT_S
from transport.protocol.scenario.setup.model_objects import kinds_of
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.key_expressions import ROUTER, Keys
from transport.protocol.wire.names import COORDINATOR, PLANT, RECORDER, agent_name, vehicle_name
from transport.protocol.wire.node_interface import Node

if TYPE_CHECKING:
    from transport.plant.node import PlantNode

_LOOKS_FOR_SIGNALS_S = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessOptions:
    """Options of a process of a run."""

    scenario: ScenarioOption = "paper"
    settings: SetOption = None
    run: Annotated[
        str | None, Option(metavar="NAME", help="Name of the run; the scenario's name by default.")
    ] = None
    listen: Annotated[
        list[str] | None,
        Option(metavar="ENDPOINT", help="Zenoh endpoint to listen on, e.g. tcp/127.0.0.1:7449."),
    ] = None
    connect: Annotated[
        list[str] | None,
        Option(metavar="ENDPOINT", help="Zenoh endpoint of another process. Repeatable."),
    ] = None
    incarnation: Annotated[
        int | None,
        Option(metavar="NUMBER", min=0, help="Number of this start; by default the time."),
    ] = None
    join_timeout: Annotated[
        float | None,
        Option(
            metavar="SECONDS",
            min=0.0,
            help="Time to wait for the other processes, s; default: the scenario's.",
        ),
    ] = None
    allow_large: LargeOption = False

    def setup(self) -> Setup:
        """Return the setup of the scenario, ready also for targets of a run at a set speed."""
        return process_setup(self.scenario, self.settings, allow_large=self.allow_large)

    def compiled_setup(self) -> Setup:
        """Return the setup with the model compiled for this processor.

        The first start on a host takes seconds longer; each step then takes a third of the time.
        `transport run` has compiled it before its processes start.
        """
        setup = self.setup()
        if not any(needs_compilation(*kind) for kind in kinds_of(setup.scenario)):
            return setup

        from rich.console import Console

        from transport.flight.progress import compile_models

        compile_models([setup.scenario], Console(stderr=True))
        forget_setup()
        return self.setup()

    def place(self, name: str) -> Place:
        """Return the place of a process in its run; options that are refused end the command."""
        scenario = self.setup().scenario
        run = self.run or scenario.name
        with blame("--run"):
            Keys(run)
        check_endpoints(self.listen, self.connect)

        incarnation = self.incarnation
        if incarnation is None:
            incarnation = time.time_ns() // 10**6
        join_timeout_s = self.join_timeout
        if join_timeout_s is None:
            join_timeout_s = scenario.clock.join_timeout_s
        elif join_timeout_s > LONGEST_WAIT_S:
            fail(f"--join-timeout: expected 0 to {LONGEST_WAIT_S:g} s, got {join_timeout_s:g}")
        return Place(
            run=run,
            incarnation=incarnation,
            endpoints=endpoints_of(name, scenario, self.listen, self.connect),
            join_timeout_s=join_timeout_s,
        )


def check_endpoints(listen: Sequence[str] | None, connect: Sequence[str] | None) -> None:
    """End the command if an endpoint has another form than protocol/address."""
    for option, endpoints in (("--listen", listen), ("--connect", connect)):
        for endpoint in endpoints or []:
            if not re.fullmatch(r"[a-z0-9-]+/\S+", endpoint):
                expected = "an endpoint such as tcp/127.0.0.1:7447"
                fail(f"{option}: expected {expected}, got {endpoint!r}")


@with_options(ProcessOptions)
def agent(
    options: ProcessOptions,
    number: int = Option(..., "--id", metavar="NUMBER", min=1, help="Number of the agent, from 1."),
) -> None:
    """Run one agent: the controller of the UAVs it owns.

    Example: transport agent --id 2
    """
    from transport.agent.node import AgentNode

    setup = options.compiled_setup()
    if number not in setup.agents:
        allowed = f"1 to {len(setup.agents)} of scenario {setup.scenario.name}"
        fail(f"--id: expected an agent from {allowed}, got {number}")

    place = options.place(agent_name(number))
    node = AgentNode(setup.run, number, place.incarnation, time.perf_counter_ns)
    node.warm_up()
    raise typer.Exit(_run(node, place, setup))


@with_options(ProcessOptions)
def coordinator(
    options: ProcessOptions,
    observer: list[str] | None = Option(
        None, metavar="PROCESS", help="Also wait for this process before the first tick: recorder."
    ),
) -> None:
    """Run the coordinator: sampling clock and roster.

    Example: transport coordinator --observer recorder
    """
    from transport.flight.roles import coordinator_of

    setup = options.setup()
    place = options.place(COORDINATOR)
    node = coordinator_of(setup, place.incarnation, observer or [], wall_offset_ns())
    others = [*_others(setup, COORDINATOR), *(observer or [])]
    raise typer.Exit(
        run_node(node, place, setup.rules, others, on_interrupt=node.interrupt, linger_for=others)
    )


@with_options(ProcessOptions)
def plant(options: ProcessOptions) -> None:
    """Run the plant: dynamics and actuators.

    Example: transport plant --scenario paper
    """
    setup = options.compiled_setup()
    if not setup.scenario.has_plant:
        fail("plant: expected a scenario with plant.kind = 'simulated', got 'vehicles'")
    place = options.place(PLANT)
    node = _plant_node(setup, place.incarnation)
    node.warm_up()
    raise typer.Exit(_run(node, place, setup))


def _plant_node(setup: Setup, incarnation: int) -> "PlantNode":
    """Return the plant of a run, whose actuators are simulated or played by autopilots."""
    from transport.flight.roles import plant_run
    from transport.plant.node import PlantNode

    run = plant_run(setup)
    autopilot = setup.scenario.plant.autopilot
    if autopilot is None:
        return PlantNode(run, incarnation)

    from transport.plant.autopilot.autopilot_processes import Autopilots
    from transport.plant.autopilot.betaflight_over_msp import Betaflights
    from transport.plant.autopilot.node import AutopilotBank, PlayedPlant
    from transport.protocol.scenario.sections.vehicles_section import DEFAULT_VEHICLE_PORT

    port = setup.scenario.network.vehicle_port or DEFAULT_VEHICLE_PORT
    bank: AutopilotBank
    bank = Betaflights(run, port) if autopilot == "betaflight" else Autopilots(run, port)
    return PlayedPlant(run, bank, incarnation, wall_offset_ns())


def _run(node: Node, place: Place, setup: Setup) -> int:
    """Run a node that follows the coordinator, as a process of its run; return the exit code."""
    return run_node(node, place, setup.rules, _others(setup, node.name))


def _others(setup: Setup, name: str) -> list[str]:
    """Return the names of the other processes of a run."""
    return [other for other in process_names(setup.scenario) if other != name]


@with_options(ProcessOptions)
def vehicle(
    options: ProcessOptions,
    uav: int = Option(..., metavar="NUMBER", min=1, help="Number of the UAV, from 1."),
    link: str = Option(
        ...,
        metavar="ENDPOINT",
        help="MAVLink to the autopilot: udp:HOST:PORT to listen, udpclient:HOST:PORT to call. "
        "MSP to Betaflight: serial:DEVICE, or tcp:HOST:PORT.",
    ),
    autopilot: str | None = Option(
        None, metavar="NAME", help="ardupilot, px4 or betaflight; by default the scenario's."
    ),
    pose: str | None = Option(
        None,
        metavar="ENDPOINT",
        help="Motion capture of a Betaflight, as MAVLink ODOMETRY: udp:HOST:PORT to listen.",
    ),
    key: Path | None = Option(
        None, metavar="FILE", help="Key of MAVLink signing: 64 hexadecimal digits."
    ),
    stands: bool = Option(
        False, "--stands", help="The UAV stands until tick 0: arm it, and give the hover thrust."
    ),
    check: bool = Option(
        False, "--check", help="Only check the autopilot, for 10 s; exit code 9 if it does not fit."
    ),
) -> None:
    """Connect one UAV: its agent and its autopilot.

    Example: transport vehicle --uav 2 --autopilot ardupilot --link udp:127.0.0.1:14550
    """
    from transport.vehicle.link_opening_and_check import (
        LinkOptions,
        check_autopilot,
        open_autopilot,
    )
    from transport.vehicle.node import Conduct, VehicleNode

    setup = options.setup() if check else options.compiled_setup()
    if uav > setup.system.N:
        allowed = f"1 to {setup.system.N} of scenario {setup.scenario.name}"
        fail(f"--uav: expected a UAV from {allowed}, got {uav}")
    section = setup.scenario.vehicles
    limits = setup.scenario.controller.limits
    links = LinkOptions(link=link, autopilot=autopilot, pose=pose, key=key)
    with closing(open_autopilot(section, limits, uav, links)) as driver:
        if check:
            code = check_autopilot(driver, typer.echo)
        else:
            place = options.place(vehicle_name(uav))
            conduct = Conduct(section=section, stands=stands)
            offset_ns = wall_offset_ns()
            node = VehicleNode(setup.run, uav, driver, conduct, place.incarnation, offset_ns)
            node.warm_up()
            code = _run(node, place, setup)
    raise typer.Exit(code)


@with_options(ProcessOptions)
def record(
    options: ProcessOptions,
    out: Path | None = Option(None, metavar="FOLDER", help="Run folder to create."),
    figures: FiguresOption = True,
    output: FormatOption = Format.text,
) -> None:
    """Record and report a run whose processes were started by hand.

    Start the recorder before the first tick: `transport coordinator --observer recorder` waits for
    it.

    Example: transport record --scenario paper --out runs/by-hand
    """
    from rich.console import Console

    from transport.cli.commands.plot import report
    from transport.flight.run_execution import observe
    from transport.log.run_folder import new_folder

    setup = options.setup()
    place = options.place(RECORDER)
    folder = out or new_folder(RUNS, setup.scenario.name)
    finished = observe(setup, place, folder, Console(stderr=True))
    report(finished.folder, output, figures=figures, setup=setup)
    if finished.exit_code != 0:
        fail(finished.reason, finished.exit_code)


def router(
    listen: list[str] = Option(
        ..., metavar="ENDPOINT", help="Zenoh endpoint to listen on. Repeatable."
    ),
    connect: list[str] | None = Option(
        None, metavar="ENDPOINT", help="Endpoint of another router."
    ),
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
) -> None:
    """Route messages between hosts without a direct connection.

    Serves any run until Ctrl-C. The scenario says which processes take part, and with which keys.

    Example: transport router --listen tcp/127.0.0.1:7400
    """
    from transport.protocol.network.session import route

    check_endpoints(listen, connect)
    setup = read_setup(scenario, settings, allow_large=True)
    security = security_of(setup.scenario)
    endpoints = Endpoints(listen=listen, connect=connect or [], mode="router", security=security)

    is_over = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: is_over.set())

    journal = Journal("any", ROUTER)
    with route(endpoints.checked(ROUTER, insecure=setup.scenario.network.insecure)):
        journal.log("listening", at=", ".join(listen))
        # A signal that a thread of Zenoh takes does not wake this one.
        while not is_over.wait(_LOOKS_FOR_SIGNALS_S):
            pass
    journal.log("finished")
