"""The command `transport experiment deaths`."""

from typing import Annotated

from typer import Option

from transport.cli.experiment.conduct import sweep_command
from transport.cli.experiment.options import SweepOptions
from transport.experiments import agent_failures
from transport.experiments.experiment import Experiment


@sweep_command(default_scenarios=("resilient",))
def deaths(
    options: SweepOptions,
    count: Annotated[
        int | None, Option("--count", metavar="COUNT", min=1, help="Deaths per scenario; by default 20.")
    ] = None,
    draw: Annotated[
        int, Option("--draw", metavar="SEED", min=0, help="Random seed of the times and of the agents killed.")
    ] = 0,
) -> Experiment:
    """Effect of a permanent kill of a random agent.

    Each run kills one agent at a random time and never restarts it; the others continue.

    Example: transport experiment deaths --processes
    """
    return agent_failures.deaths(options.read(), count or (2 if options.quick else 20), draw)
