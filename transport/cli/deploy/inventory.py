"""The inventory that a command is given, and the packages that deployment needs."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from deploy.hosts import Inventory, InventoryError, read_inventory
from protocol.network.endpoints import process_names
from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_USAGE
from transport.cli.output import exit_on, fail


def inventory_of(path: Path, setup: Setup) -> Inventory:
    """Read an inventory, or end the command if it is refused."""
    with exit_on(InventoryError, code=EXIT_USAGE):
        return read_inventory(path, process_names(setup.scenario))


@contextmanager
def optional_packages() -> Iterator[None]:
    """End the command if an import fails, and name the extra to install."""
    try:
        yield
    except ModuleNotFoundError as error:
        fail(f"expected the package {error.name}, got none: pip install 'payload-transport[deploy]'", EXIT_USAGE)
