"""The command `transport agent`."""

from typing import Annotated

from typer import Option

from agent.main import run
from protocol.wire.exit_codes import EXIT_USAGE
from transport.cli.options import with_options
from transport.cli.output import fail
from transport.cli.process import ProcessOptions


@with_options(ProcessOptions)
def agent(
    options: ProcessOptions,
    number: Annotated[int, Option("--id", metavar="NUMBER", min=1, help="Number of the agent, from 1.")],
) -> None:
    """Run one agent: the controller of the UAVs it owns.

    Example: transport agent --id 2
    """
    setup = options.setup()
    if number not in setup.agents:
        known = f"1 to {len(setup.agents)} of scenario {setup.scenario.name}"
        fail(f"--id: expected an agent from {known}, got {number}", EXIT_USAGE)
    options.run(f"agent{number}", lambda setup, place: run(setup, place, number))
