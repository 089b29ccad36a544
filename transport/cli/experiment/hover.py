"""The command `transport experiment hover`."""

from typing import Annotated

from typer import Option

from transport.cli.experiment.conduct import sweep_command
from transport.cli.experiment.options import SweepOptions
from transport.experiments import tuning
from transport.experiments.experiment import Experiment

_SCENARIOS = ("paper", "centralized", "resilient", "centralized_lq", "precise")
_QUICK_MANEUVER = (
    "maneuver.phase=[{name='climb',duration_s=0.5,displacement_m=[0,0,-0.25]},"
    "{name='hover',duration_s=0.5,displacement_m=[0,0,0]}]"
)


@sweep_command(default_scenarios=_SCENARIOS, quick_maneuver=_QUICK_MANEUVER)
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
    return tuning.hover(options.read(), durations or ([0.5, 1.0] if options.quick else [5.0, 20.0, 65.0]))
