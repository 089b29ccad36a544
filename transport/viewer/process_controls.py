"""Buttons that kill and restart the agents of an active run."""

from functools import partial
from typing import Any

from transport.flight.live import Commands
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import agent_name
from transport.viewer.widgets import from_browser


def add_processes(gui: Any, setup: Setup, commands: Commands) -> Any:
    """Return a folder with buttons that kill and restart each agent."""
    folder = gui.add_folder("Processes")
    with folder:
        for agent in setup.agents:
            buttons = gui.add_button_group(f"agent {agent}", ("kill", "restart"))
            buttons.on_click(from_browser(partial(commands.fault, target=agent_name(agent))))
    return folder
