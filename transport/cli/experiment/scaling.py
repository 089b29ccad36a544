"""The command `transport experiment scaling`."""

from typing import Annotated

from typer import Option

from transport.cli.experiment.conduct import sweep_command
from transport.cli.experiment.options import ExperimentOptions
from transport.experiments import scaling as team_sizes
from transport.experiments.experiment import Experiment

# The paper's speed, 0.5 m/s, in a maneuver of 10 s instead of 25.
_MANEUVER = (
    "maneuver.phase=[{name='hover',duration_s=2.0,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=4.0,displacement_m=[0,0,-2]},"
    "{name='translate',duration_s=4.0,displacement_m=[2,0,0]}]"
)


@sweep_command(ExperimentOptions, default_jobs=1, maneuver=_MANEUVER)
def scaling(
    options: ExperimentOptions,
    largest: Annotated[
        int | None, Option("--max", metavar="COUNT", help="UAVs of the largest team, 2 to 16; by default 12.")
    ] = None,
) -> Experiment:
    """Growth of cost, computation and messages.

    Teams of 2 to 12 UAVs made from `resilient`, each with an agent for every UAV, for every pair, and for all.

    Computation is processor time, measured in the same runs. More than one job in parallel
    disturbs the timing, not costs and messages.

    Example: transport experiment scaling --max 8 --seeds 3
    """
    sizes, default = (team_sizes.QUICK_SIZES, 6) if options.quick else (team_sizes.SIZES, 12)
    return team_sizes.scaling("resilient", default if largest is None else largest, sizes)
