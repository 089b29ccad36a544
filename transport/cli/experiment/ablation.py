"""The command `transport experiment ablation`."""

from transport.cli.experiment.conduct import sweep_command
from transport.cli.experiment.options import SweepOptions
from transport.experiments import ablation as variants
from transport.experiments.experiment import Experiment


@sweep_command(default_seeds=3)
def ablation(options: SweepOptions) -> Experiment:
    """Contribution of each part of the algorithm.

    Changes one setting at a time, on a perfect network and on one with delay and packet loss.

    Example: transport experiment ablation --scenario resilient
    """
    return variants.ablation(options.read())
