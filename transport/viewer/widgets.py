"""Callbacks of widgets."""

from collections.abc import Callable
from typing import Any


def from_browser(act: Callable[[Any], None]) -> Callable[[Any], None]:
    """Return a callback that passes the new value of a widget if a browser has changed it.

    Changes by this process call nothing.
    """
    return lambda event: None if event.client_id is None else act(event.target.value)
