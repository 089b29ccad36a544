"""The command `transport experiment latency`."""

from typing import Annotated

from typer import Option

from transport.cli.experiment.conduct import sweep_command
from transport.cli.experiment.options import SweepOptions
from transport.experiments import network_sweeps
from transport.experiments.experiment import Experiment


@sweep_command()
def latency(
    options: SweepOptions,
    delays: Annotated[
        list[float] | None, Option("--delay", metavar="SECONDS", help="Delay, s; by default 0 to 0.4. Repeatable.")
    ] = None,
) -> Experiment:
    """Effect of a fixed delay on every link.

    Example: transport experiment latency --delay 0.1 --delay 0.3 --scenario resilient
    """
    delays_s = options.choose(delays, [0.0, 0.05, 0.1, 0.2, 0.4], quick=[0.0, 0.2])
    return network_sweeps.latency(options.names, delays_s)
