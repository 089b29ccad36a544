"""The command `transport experiment kill`."""

from typing import Annotated

from typer import Option

from transport.cli.experiment.conduct import sweep_command
from transport.cli.experiment.options import SweepOptions
from transport.experiments import agent_failures
from transport.experiments.experiment import Experiment


@sweep_command()
def kill(
    options: SweepOptions,
    at: Annotated[float | None, Option("--at", metavar="SECONDS", help="Time of the kill, s; by default 8.")] = None,
    restart: Annotated[
        float | None, Option("--restart", metavar="SECONDS", help="Time of the restart, s; by default 10.")
    ] = None,
) -> Experiment:
    """Effect of the death of each agent.

    Kills each agent in turn, with and without a restart, while the others continue.

    Example: transport experiment kill --at 5 --restart 6
    """
    agents = {name: len(scenario.owned) for name, scenario in options.read().items()}
    default = (0.5, 1.0) if options.quick else (8.0, 10.0)
    kill_s, restart_s = (then if given is None else given for given, then in zip((at, restart), default, strict=True))
    return agent_failures.kill(agents, kill_s, restart_s)
