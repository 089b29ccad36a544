"""The commands `transport experiment ablation`, `horizon` and `hover`."""

from typing import Annotated

from typer import Option

from transport.cli.experiment.conduct import sweep_command
from transport.cli.experiment.options import SweepOptions
from transport.experiments import ablation as variants
from transport.experiments import tuning
from transport.experiments.experiment import Experiment

_HOVER_SCENARIOS = ("paper", "centralized", "resilient", "centralized_lq", "precise")
_QUICK_HOVER = (
    "maneuver.phase=[{name='climb',duration_s=0.5,displacement_m=[0,0,-0.25]},"
    "{name='hover',duration_s=0.5,displacement_m=[0,0,0]}]"
)


@sweep_command(default_seeds=3)
def ablation(options: SweepOptions) -> Experiment:
    """Contribution of each part of the algorithm.

    Changes one setting at a time, on a perfect network and on one with delay and packet loss.

    Example: transport experiment ablation --scenario resilient
    """
    return variants.ablation(options.read())


@sweep_command()
def horizon(
    options: SweepOptions,
    horizons: Annotated[
        list[int] | None, Option("--horizon", help="Steps N_p; by default 5, 10, 20, 30. Repeatable.")
    ] = None,
    terminals: Annotated[
        list[float] | None,
        Option("--terminal", help="Terminal weight, for open-loop prediction; by default 1, 5, 20. Repeatable."),
    ] = None,
    delay: Annotated[float, Option("--delay", help="Delay of every plan on the second network, s.")] = 0.2,
) -> Experiment:
    """Effect of horizon and terminal weight.

    Each horizon with each weight, on a perfect network and with a delay.

    Example: transport experiment horizon --horizon 10 --horizon 20 --scenario paper
    """
    steps = options.choose(horizons, [5, 10, 20, 30], quick=[10])
    return tuning.horizon(options.read(), steps, options.choose(terminals, [1.0, 5.0, 20.0], quick=[5.0]), delay)


@sweep_command(default_scenarios=_HOVER_SCENARIOS, quick_maneuver=_QUICK_HOVER)
def hover(
    options: SweepOptions,
    durations: Annotated[
        list[float] | None,
        Option("--duration", help="Duration of the last phase, s; by default 5, 20, 65. Repeatable."),
    ] = None,
) -> Experiment:
    """Stability in a long hover after the maneuver.

    Only the duration of the last phase changes.

    Example: transport experiment hover --duration 60 --scenario resilient
    """
    return tuning.hover(options.read(), options.choose(durations, [5.0, 20.0, 65.0], quick=[0.5, 1.0]))
