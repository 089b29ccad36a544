"""The command `transport experiment sharing`."""

from typing import Annotated

from typer import Option

from transport.cli.experiment.conduct import sweep_command
from transport.cli.experiment.options import SweepOptions
from transport.experiments import network_sweeps
from transport.experiments.experiment import Experiment


@sweep_command(default_seeds=5, default_scenarios=("resilient",))
def sharing(
    options: SweepOptions,
    thresholds: Annotated[
        list[float] | None,
        Option(
            "--threshold", metavar="SHARE", help="Smallest change that is sent, share of the input's range. Repeatable."
        ),
    ] = None,
    heartbeat: Annotated[
        float, Option("--heartbeat", metavar="SECONDS", help="Longest time between two plans, s.")
    ] = 1.0,
) -> Experiment:
    """Cost against the number of plans sent.

    On a perfect network and on one with 200 ms delay and 30 % packet loss.

    Simulates resilient by default: agents need the shared control law.

    Example: transport experiment sharing --threshold 0.01 --threshold 0.1
    """
    chosen = options.choose(thresholds, [0.002, 0.005, 0.01, 0.02, 0.05], quick=[0.01])
    return network_sweeps.sharing(options.names, chosen, heartbeat)
