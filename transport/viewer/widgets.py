"""Callbacks of widgets, and how long notifications stay."""

from collections.abc import Callable
from typing import Any

# Time after which a notification in the corner of the page ends, s.
NOTIFICATION_S = 8.0


def from_browser(act: Callable[[Any], None]) -> Callable[[Any], None]:
    """Return a callback that passes the new value of a widget if a browser has changed it.

    Changes by this process call nothing.
    """
    return lambda event: None if event.client_id is None else act(event.target.value)
