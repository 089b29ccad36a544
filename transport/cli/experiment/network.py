"""The commands `transport experiment latency`, `loss`, `jitter`, `matrix` and `sharing`."""

from typing import Annotated

from typer import Option

from transport.cli.experiment.conduct import sweep_command
from transport.cli.experiment.options import SweepOptions
from transport.experiments import network_sweeps
from transport.experiments.experiment import Experiment


@sweep_command()
def latency(
    options: SweepOptions,
    delays: Annotated[list[float] | None, Option("--delay", help="Delay, s; by default 0 to 0.4. Repeatable.")] = None,
) -> Experiment:
    """Effect of a fixed delay on every link.

    Example: transport experiment latency --delay 0.1 --delay 0.3 --scenario resilient
    """
    delays_s = options.choose(delays, [0.0, 0.05, 0.1, 0.2, 0.4], quick=[0.0, 0.2])
    return network_sweeps.latency(options.names, delays_s)


@sweep_command(default_seeds=5)
def loss(
    options: SweepOptions,
    losses: Annotated[
        list[float] | None, Option("--loss", help="Packet loss; by default 0.1, 0.3, 0.6. Repeatable.")
    ] = None,
    burst: Annotated[float, Option("--burst", help="Mean length of a burst, ticks.")] = 5.0,
) -> Experiment:
    """Effect of packet loss, independent or in bursts.

    Example: transport experiment loss --loss 0.3 --burst 10
    """
    return network_sweeps.loss(options.names, options.choose(losses, [0.1, 0.3, 0.6], quick=[0.3]), burst)


@sweep_command(default_seeds=3)
def jitter(
    options: SweepOptions,
    distributions: Annotated[
        list[str] | None,
        Option("--distribution", help="uniform, normal, exponential, lognormal; by default all. Repeatable."),
    ] = None,
    deviations: Annotated[
        list[float] | None,
        Option("--std", help="Standard deviation of the delay, s; by default 0.02, 0.05, 0.08. Repeatable."),
    ] = None,
    mean: Annotated[float, Option("--mean", help="Mean delay, s.")] = 0.16,
) -> Experiment:
    """Effect of the distribution of random delays.

    Several distributions with the same mean and standard deviation.

    Example: transport experiment jitter --std 0.05 --distribution lognormal
    """
    chosen = options.choose(distributions, list(network_sweeps.JITTER), quick=["uniform", "exponential"])
    deviations_s = options.choose(deviations, [0.02, 0.05, 0.08], quick=[0.05])
    return network_sweeps.jitter(options.names, chosen, deviations_s, mean)


@sweep_command(default_seeds=3)
def matrix(
    options: SweepOptions,
    delays: Annotated[
        list[float] | None, Option("--delay", help="Delay, s; by default 0, 0.1, 0.2, 0.4. Repeatable.")
    ] = None,
    losses: Annotated[
        list[float] | None, Option("--loss", help="Packet loss; by default 0, 0.1, 0.3, 0.6. Repeatable.")
    ] = None,
) -> Experiment:
    """Maps of cost and survival over delay and loss.

    One map for each scenario: every delay with every loss.

    Example: transport experiment matrix --delay 0 --delay 0.2 --loss 0 --loss 0.3
    """
    delays_s = options.choose(delays, [0.0, 0.1, 0.2, 0.4], quick=[0.0, 0.2])
    return network_sweeps.matrix(
        options.names, delays_s, options.choose(losses, [0.0, 0.1, 0.3, 0.6], quick=[0.0, 0.3])
    )


@sweep_command(default_seeds=5, default_scenarios=("resilient",))
def sharing(
    options: SweepOptions,
    thresholds: Annotated[
        list[float] | None,
        Option("--threshold", help="Smallest change that is sent, share of the input's range. Repeatable."),
    ] = None,
    heartbeat: Annotated[float, Option("--heartbeat", help="Longest time between two plans, s.")] = 1.0,
) -> Experiment:
    """Cost against the number of plans sent.

    On a perfect network and on one with 200 ms delay and 30 % packet loss.

    Simulates resilient by default: agents need the shared control law.

    Example: transport experiment sharing --threshold 0.01 --threshold 0.1
    """
    chosen = options.choose(thresholds, [0.002, 0.005, 0.01, 0.02, 0.05], quick=[0.01])
    return network_sweeps.sharing(options.names, chosen, heartbeat)
