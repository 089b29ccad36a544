"""Targets from the viewer, without a browser: the agents that are told."""

from types import SimpleNamespace
from typing import Any

import pytest

from tests.support.runs import setup
from transport.model.arrays import Array
from transport.scene.history import RunHistory
from transport.scene.scene_at_tick import SceneBuilder
from transport.viewer.target_controls import TargetControls


class Widget(SimpleNamespace):
    """A widget that keeps what is to happen when it is clicked, and can be a context."""

    def __getattr__(self, name: str) -> Any:
        if not name.startswith("on_"):
            raise AttributeError(name)
        return lambda act: setattr(self, f"act_{name}", act)

    def __enter__(self) -> None:
        """Begin a folder."""

    def __exit__(self, *_: object) -> None:
        """End it."""


class Gui:
    """Widgets by label, as far as the controls use them."""

    def __init__(self) -> None:
        self.widgets: dict[str, Widget] = {}

    def _added(self, label: str, value: Any = "", **given: Any) -> Widget:
        return self.widgets.setdefault(label, Widget(value=value, **given))

    def add_dropdown(self, label: str, options: Any, **given: Any) -> Widget:
        """Return a dropdown that shows its first option."""
        return self._added(label, options[0], options=options, **given)

    def __getattr__(self, name: str) -> Any:
        return self._added


@pytest.mark.parametrize(
    ("told", "to"), [(None, ()), ("all agents", ()), ("agent3", (3,))], ids=str
)
def test_the_chosen_agent_is_told(told: str | None, to: tuple[int, ...]) -> None:
    """By default all are; the others learn it from the plans of the one that is chosen."""
    sent: list[tuple[list[float], tuple[int, ...]]] = []

    def target(place: Array, agents: tuple[int, ...]) -> None:
        sent.append((place.tolist(), agents))

    gui = Gui()
    scene = SimpleNamespace(add_transform_controls=lambda *_, **given: Widget(**given))
    run = setup()
    commands: Any = SimpleNamespace(target=target)
    TargetControls(
        SimpleNamespace(gui=gui, scene=scene), SceneBuilder(run, RunHistory(run)), commands
    )
    assert gui.widgets["told"].options == ("all agents", "agent1", "agent2", "agent3", "agent4")
    if told is not None:
        gui.widgets["told"].value = told
    gui.widgets["x, y, down (m)"].value = "1, 2, -10"
    gui.widgets["Go there"].act_on_click(None)
    assert sent == [([1.0, 2.0, -10.0], to)]
