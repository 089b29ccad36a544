"""The command `transport experiment hover`."""

from typing import Annotated

from typer import Option

from transport.cli.experiment.conduct import sweep_command
from transport.cli.experiment.options import SweepOptions
from transport.experiments import tuning
from transport.experiments.experiment import Experiment

_HOVER_SCENARIOS = ("paper", "centralized", "resilient", "centralized_lq", "precise")
_QUICK_HOVER = (
    "maneuver.phase=[{name='climb',duration_s=0.5,displacement_m=[0,0,-0.25]},"
    "{name='hover',duration_s=0.5,displacement_m=[0,0,0]}]"
)


@sweep_command(default_scenarios=_HOVER_SCENARIOS, quick_maneuver=_QUICK_HOVER)
def hover(
    options: SweepOptions,
    durations: Annotated[
        list[float] | None,
        Option(
            "--duration", metavar="SECONDS", help="Duration of the last phase, s; by default 5, 20, 65. Repeatable."
        ),
    ] = None,
) -> Experiment:
    """Stability in a long hover after the maneuver.

    Only the duration of the last phase changes.

    Example: transport experiment hover --duration 60 --scenario resilient
    """
    return tuning.hover(options.read(), options.choose(durations, [5.0, 20.0, 65.0], quick=[0.5, 1.0]))
