"""Optional packages of the Python interface, and what to install for them."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from transport.interface.settings import ArgumentError


def require_pandas() -> Any:
    """Return the module pandas.

    Raises: ArgumentError: pandas is not installed.
    """
    if find_spec("pandas") is None:
        raise ArgumentError("pandas is not installed: pip install 'payload-transport[pandas]'")
    return import_module("pandas")
