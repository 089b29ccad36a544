"""The command `transport plant`."""

from plant.main import run
from transport.cli.options import with_options
from transport.cli.process import ProcessOptions


@with_options(ProcessOptions)
def plant(options: ProcessOptions) -> None:
    """Run the plant: dynamics and actuators.

    Example: transport plant --scenario paper
    """
    options.run("plant", run)
