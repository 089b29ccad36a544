"""Options of the commands that are one process of a run, and its start."""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import typer
from typer import Option

from protocol.network.endpoints import endpoints_of
from protocol.network.process import Place
from protocol.network.security import SecurityError
from protocol.network.session import BusError
from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_SCENARIO, EXIT_UNREACHABLE, EXIT_USAGE
from protocol.wire.keys import Keys, RunNameError
from transport.cli.options import LargeOption, ScenarioOption, SetOption
from transport.cli.output import exit_on, fail
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
