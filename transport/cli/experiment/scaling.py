"""The command `transport experiment scaling`."""

from typing import Annotated

import typer

from transport.cli.experiment.conduct import conduct, exit_codes
from transport.cli.experiment.options import ExperimentOptions, OutOption, QuickOption, SetOption
from transport.experiments import catalogue

# The paper's speed, 0.5 m/s, in a maneuver of 10 s instead of 25.
_MANEUVER = (
    "maneuver.phase=[{name='hover',duration_s=2.0,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=4.0,displacement_m=[0,0,-2]},"
    "{name='translate',duration_s=4.0,displacement_m=[2,0,0]}]"
)


def scaling(
    largest: Annotated[
        int | None, typer.Option("--max", help="UAVs of the largest team, 2 to 16; by default 12.")
    ] = None,
    settings: SetOption = None,
    seeds: Annotated[
        int, typer.Option("--seeds", min=1, help="Runs of each team; repetitions show the spread of the timing.")
    ] = 1,
    out: OutOption = None,
    jobs: Annotated[
        int, typer.Option("--jobs", min=1, help="Simulations in parallel; more than 1 disturbs the measured timing.")
    ] = 1,
    quick: QuickOption = False,
) -> None:
    """Growth of cost, computation and messages.

    Teams of 2 to 12 UAVs made from `resilient`, each with an agent for every UAV, for every pair, and for all.

    Computation is processor time, measured in the same runs. Costs and messages do not depend on --jobs, timing does.

    Example: transport experiment scaling --max 8 --seeds 3
    """
    options = ExperimentOptions(settings=settings, seeds=seeds, out=out, jobs=jobs, quick=quick, maneuver=_MANEUVER)
    sizes, default = (catalogue.QUICK_SIZES, 6) if quick else (catalogue.SIZES, 12)
    with exit_codes():
        conduct(catalogue.scaling("resilient", default if largest is None else largest, sizes), options)
