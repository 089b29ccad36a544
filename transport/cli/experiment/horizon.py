"""The command `transport experiment horizon`."""

from typing import Annotated

from typer import Option

from transport.cli.experiment.conduct import sweep_command
from transport.cli.experiment.options import SweepOptions
from transport.experiments import tuning
from transport.experiments.experiment import Experiment


@sweep_command()
def horizon(
    options: SweepOptions,
    horizons: Annotated[
        list[int] | None, Option("--horizon", metavar="STEPS", help="Steps N_p; by default 5, 10, 20, 30. Repeatable.")
    ] = None,
    terminals: Annotated[
        list[float] | None,
        Option(
            "--terminal",
            metavar="WEIGHT",
            help="Terminal weight, for open-loop prediction; by default 1, 5, 20. Repeatable.",
        ),
    ] = None,
    delay: Annotated[
        float, Option("--delay", metavar="SECONDS", help="Delay of every plan on the second network, s.")
    ] = 0.2,
) -> Experiment:
    """Effect of horizon and terminal weight.

    Each horizon with each weight, on a perfect network and with a delay.

    Example: transport experiment horizon --horizon 10 --horizon 20 --scenario paper
    """
    steps = options.choose(horizons, [5, 10, 20, 30], quick=[10])
    return tuning.horizon(options.read(), steps, options.choose(terminals, [1.0, 5.0, 20.0], quick=[5.0]), delay)
