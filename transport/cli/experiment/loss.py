"""The command `transport experiment loss`."""

from typing import Annotated

from typer import Option

from transport.cli.experiment.conduct import sweep_command
from transport.cli.experiment.options import SweepOptions
from transport.experiments import network_sweeps
from transport.experiments.experiment import Experiment


@sweep_command(default_seeds=5)
def loss(
    options: SweepOptions,
    losses: Annotated[
        list[float] | None, Option("--loss", metavar="SHARE", help="Packet loss; by default 0.1, 0.3, 0.6. Repeatable.")
    ] = None,
    burst: Annotated[float, Option("--burst", metavar="TICKS", help="Mean length of a burst, ticks.")] = 5.0,
) -> Experiment:
    """Effect of packet loss, independent or in bursts.

    Example: transport experiment loss --loss 0.3 --burst 10
    """
    return network_sweeps.loss(options.names, options.choose(losses, [0.1, 0.3, 0.6], quick=[0.3]), burst)
