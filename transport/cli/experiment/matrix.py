"""The command `transport experiment matrix`."""

from typing import Annotated

from typer import Option

from transport.cli.experiment.conduct import sweep_command
from transport.cli.experiment.options import SweepOptions
from transport.experiments import network_sweeps
from transport.experiments.experiment import Experiment


@sweep_command(default_seeds=3)
def matrix(
    options: SweepOptions,
    delays: Annotated[
        list[float] | None,
        Option("--delay", metavar="SECONDS", help="Delay, s; by default 0, 0.1, 0.2, 0.4. Repeatable."),
    ] = None,
    losses: Annotated[
        list[float] | None,
        Option("--loss", metavar="SHARE", help="Packet loss; by default 0, 0.1, 0.3, 0.6. Repeatable."),
    ] = None,
) -> Experiment:
    """Maps of cost and completion over delay and loss.

    One map for each scenario: every delay with every loss.

    Example: transport experiment matrix --delay 0 --delay 0.2 --loss 0 --loss 0.3
    """
    delays_s = options.choose(delays, [0.0, 0.1, 0.2, 0.4], quick=[0.0, 0.2])
    return network_sweeps.matrix(
        options.names, delays_s, options.choose(losses, [0.0, 0.1, 0.3, 0.6], quick=[0.0, 0.3])
    )
