"""The commands that start one process of a run by hand, or connect hosts: agent, plant, coordinator, record, router.

Each imports only its own role: the processes of a run start with these commands.
"""

import re
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from protocol.network.endpoints import Endpoints, endpoints_of, security_of
from protocol.network.parent import stand_by
from protocol.network.process import Journal, Place, run_node
from protocol.network.security import SecurityError
from protocol.network.session import BusError
from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_SCENARIO, EXIT_UNREACHABLE, EXIT_USAGE
from protocol.wire.keys import ROUTER, Keys, RunNameError
from protocol.wire.names import COORDINATOR, PLANT, RECORDER, agent_name
from transport.cli.options import (
    RUNS,
    FiguresOption,
    FormatOption,
    LargeOption,
    ScenarioOption,
    SetOption,
    with_options,
)
from transport.cli.output import Format, exit_on, fail
from transport.cli.scenario_setup import read_setup, scenario_errors

RunNameOption = Annotated[
    str | None, Option("--run", metavar="NAME", help="Name of the run; the scenario's name by default.")
]
ListenOption = Annotated[
    list[str] | None,
    Option("--listen", metavar="ENDPOINT", help="Zenoh endpoint to listen on, e.g. tcp/127.0.0.1:7449."),
]
ConnectOption = Annotated[
    list[str] | None, Option("--connect", metavar="ENDPOINT", help="Zenoh endpoint of another process. Repeatable.")
]
IncarnationOption = Annotated[
    int | None, Option("--incarnation", metavar="NUMBER", min=0, help="Number of this start; by default the time.")
]
JoinOption = Annotated[
    float | None,
    Option(
        "--join-timeout",
        metavar="SECONDS",
        min=0.0,
        help="Time to wait for the other processes, s; default: the scenario's.",
    ),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessOptions:
    """Options of a process of a run."""

    scenario: ScenarioOption = "paper"
    settings: SetOption = None
    run_name: RunNameOption = None
    listen: ListenOption = None
    connect: ConnectOption = None
    incarnation: IncarnationOption = None
    join_timeout: JoinOption = None
    allow_large: LargeOption = False

    def setup(self) -> Setup:
        """Return the setup of the scenario."""
        return read_setup(self.scenario, self.settings, allow_large=self.allow_large)

    def place(self, setup: Setup, name: str) -> Place:
        """Return the place of a process in its run; options that are refused end the command."""
        run = self.run_name or setup.scenario.name
        with exit_on(RunNameError, code=EXIT_USAGE, option="--run"):
            Keys(run)
        for option, given in (("--listen", self.listen), ("--connect", self.connect)):
            for endpoint in given or []:
                if not re.fullmatch(r"[a-z0-9-]+/\S+", endpoint):
                    fail(f"{option}: expected an endpoint such as tcp/127.0.0.1:7447, got {endpoint!r}", EXIT_USAGE)
        with exit_on(SecurityError, code=EXIT_SCENARIO):
            endpoints = endpoints_of(name, setup.scenario, self.listen, self.connect)
        return Place(
            run=run,
            incarnation=time.time_ns() // 10**6 if self.incarnation is None else self.incarnation,
            endpoints=endpoints,
            join_timeout_s=setup.scenario.clock.join_timeout_s if self.join_timeout is None else self.join_timeout,
        )

    def run(self, name: str, body: Callable[[Setup, Place], int]) -> None:
        """Run the main function of a process and end the command with the exit code it returns."""
        setup = self.setup()
        place = self.place(setup, name)
        with exit_on(BusError, code=EXIT_UNREACHABLE), scenario_errors(self.settings):
            raise typer.Exit(body(setup, place))


@with_options(ProcessOptions)
def agent(
    options: ProcessOptions,
    number: Annotated[int, Option("--id", metavar="NUMBER", min=1, help="Number of the agent, from 1.")],
) -> None:
    """Run one agent: the controller of the UAVs it owns.

    Example: transport agent --id 2
    """
    from agent.node import AgentNode

    setup = options.setup()
    if number not in setup.agents:
        known = f"1 to {len(setup.agents)} of scenario {setup.scenario.name}"
        fail(f"--id: expected an agent from {known}, got {number}", EXIT_USAGE)

    def control(setup: Setup, place: Place) -> int:
        node = AgentNode(setup, number, place.incarnation, time.perf_counter_ns)
        node.warm_up()
        if not stand_by():
            return EXIT_UNREACHABLE
        others = [name for name in map(agent_name, setup.agents) if name != node.name]
        return run_node(node, place, setup, [COORDINATOR, PLANT, *others])

    options.run(f"agent{number}", control)


@with_options(ProcessOptions)
def coordinator(
    options: ProcessOptions,
    observer: Annotated[
        list[str] | None,
        Option("--observer", metavar="PROCESS", help="Also wait for this process before the first tick: recorder."),
    ] = None,
) -> None:
    """Run the coordinator: sampling clock and roster.

    Example: transport coordinator --observer recorder
    """
    from coordinator.node import CoordinatorNode

    def coordinate(setup: Setup, place: Place) -> int:
        node = CoordinatorNode(setup, place.incarnation, observer or [])
        others = [PLANT, *map(agent_name, setup.agents), *(observer or [])]
        return run_node(node, place, setup, others, node.interrupt, others)

    options.run(COORDINATOR, coordinate)


@with_options(ProcessOptions)
def plant(options: ProcessOptions) -> None:
    """Run the plant: dynamics and actuators.

    Example: transport plant --scenario paper
    """
    from plant.node import PlantNode

    def simulate(setup: Setup, place: Place) -> int:
        node = PlantNode(setup, place.incarnation)
        node.engine.warm_up(setup)
        return run_node(node, place, setup, [COORDINATOR, *map(agent_name, setup.agents)])

    options.run(PLANT, simulate)


@with_options(ProcessOptions)
def record(
    options: ProcessOptions,
    out: Annotated[Path | None, Option("--out", metavar="FOLDER", help="Run folder to create.")] = None,
    figures: FiguresOption = True,
    output: FormatOption = Format.text,
) -> None:
    """Record and report a run whose processes were started by hand.

    Start the recorder before the first tick: `transport coordinator --observer recorder` waits for it.

    Example: transport record --scenario paper --out runs/by-hand
    """
    from rich.console import Console

    from transport.cli.run_report import report
    from transport.flight.run import observe
    from transport.flight.run_files import RunError, new_folder

    setup = options.setup()
    place = options.place(setup, RECORDER)
    folder = out if out is not None else new_folder(RUNS, setup.scenario.name)
    with exit_on(RunError):
        finished = observe(setup, place, folder, Console(stderr=True))
    report(finished.folder, output, figures=figures, setup=setup)
    if finished.exit_code != 0:
        fail(finished.reason, finished.exit_code)


def router(
    listen: Annotated[
        list[str], Option("--listen", metavar="ENDPOINT", help="Zenoh endpoint to listen on. Repeatable.")
    ],
    connect: Annotated[
        list[str] | None, Option("--connect", metavar="ENDPOINT", help="Endpoint of another router.")
    ] = None,
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
) -> None:
    """Route messages between hosts without a direct connection.

    Serves any run until Ctrl-C. The scenario says which processes take part, and with which keys.

    Example: transport router --listen tcp/127.0.0.1:7400
    """
    from protocol.network.session import route

    setup = read_setup(scenario, settings, allow_large=True)
    endpoints = Endpoints(listen=listen, connect=connect or [], mode="router", security=security_of(setup.scenario))
    over = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: over.set())
    journal = Journal("any", ROUTER)
    with (
        exit_on(SecurityError, code=EXIT_SCENARIO),
        exit_on(BusError, code=EXIT_UNREACHABLE),
        route(endpoints.checked(ROUTER, setup.scenario)),
    ):
        journal.log("listening", at=", ".join(listen))
        over.wait()
    journal.log("finished")
