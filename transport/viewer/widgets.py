"""Callbacks of widgets, how long notifications stay, and the buttons that kill and restart agents."""

from collections.abc import Callable
from functools import partial
from typing import Any

from transport.flight.live import Commands
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import agent_name

# Time after which a notification in the corner of the page ends, s.
NOTIFICATION_S = 8.0


def from_browser(act: Callable[[Any], None]) -> Callable[[Any], None]:
    """Return a callback that passes the new value of a widget if a browser has changed it.

    Changes by this process call nothing.
    """
    return lambda event: None if event.client_id is None else act(event.target.value)


def add_processes(gui: Any, setup: Setup, commands: Commands) -> Any:
    """Return a folder with buttons that kill and restart each agent."""
    folder = gui.add_folder("Processes")
    with folder:
        for agent in setup.agents:
            buttons = gui.add_button_group(f"agent {agent}", ("kill", "restart"))
            buttons.on_click(from_browser(partial(commands.fault, target=agent_name(agent))))
    return folder
