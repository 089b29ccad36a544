"""The command `transport experiment jitter`."""

from typing import Annotated

from typer import Option

from transport.cli.experiment.conduct import sweep_command
from transport.cli.experiment.options import SweepOptions
from transport.experiments import network_sweeps
from transport.experiments.experiment import Experiment


@sweep_command(default_seeds=3)
def jitter(
    options: SweepOptions,
    distributions: Annotated[
        list[str] | None,
        Option(
            "--distribution",
            metavar="NAME",
            help="uniform, normal, exponential, lognormal; by default all. Repeatable.",
        ),
    ] = None,
    deviations: Annotated[
        list[float] | None,
        Option(
            "--std",
            metavar="SECONDS",
            help="Standard deviation of the delay, s; by default 0.02, 0.05, 0.08. Repeatable.",
        ),
    ] = None,
    mean: Annotated[float, Option("--mean", metavar="SECONDS", help="Mean delay, s.")] = 0.16,
) -> Experiment:
    """Effect of the distribution of random delays.

    Several distributions with the same mean and standard deviation.

    Example: transport experiment jitter --std 0.05 --distribution lognormal
    """
    chosen = options.choose(distributions, list(network_sweeps.JITTER), quick=["uniform", "exponential"])
    deviations_s = options.choose(deviations, [0.02, 0.05, 0.08], quick=[0.05])
    return network_sweeps.jitter(options.names, chosen, deviations_s, mean)
