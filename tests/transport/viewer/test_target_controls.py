"""Targets from the viewer, without a browser: the agents that are told."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.support.runs import plant_state, setup
from transport.model.arrays import Array
from transport.protocol.wire.messages import Target
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


class Controls:
    """Controls of a run of which no message has come, and the targets that they have sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[list[float], tuple[int, ...]]] = []
        gui = Gui()
        self.widgets = gui.widgets
        scene = SimpleNamespace(add_transform_controls=lambda *_, **given: Widget(**given))
        run = setup()
        self.history = RunHistory(run)
        commands: Any = SimpleNamespace(target=self._target)
        server = SimpleNamespace(gui=gui, scene=scene)
        self.controls = TargetControls(server, SceneBuilder(run, self.history), commands)

    def _target(self, place: Array, agents: tuple[int, ...]) -> None:
        self.sent.append((place.tolist(), agents))


@pytest.mark.parametrize(
    ("told", "to"), [(None, ()), ("all agents", ()), ("agent3", (3,))], ids=str
)
def test_the_chosen_agent_is_told(told: str | None, to: tuple[int, ...]) -> None:
    """By default all are; the others learn it from the plans of the one that is chosen."""
    shown = Controls()
    widgets = shown.widgets
    assert widgets["told"].options == ("all agents", "agent1", "agent2", "agent3", "agent4")
    if told is not None:
        widgets["told"].value = told
    widgets["x, y, down (m)"].value = "1, 2, -10"
    widgets["Go there"].act_on_click(None)
    assert shown.sent == [([1.0, 2.0, -10.0], to)]


def test_keys_move_the_target_as_the_camera_sees_it() -> None:
    """Half a metre each: right is +x, up on the screen -y, and page up is up, -z."""
    shown = Controls()
    steps = {"arrowright": (0.5, 0.0, 0.0), "arrowup": (0.0, -0.5, 0.0), "pageup": (0.0, 0.0, -0.5)}
    steps |= {"arrowleft": (-0.5, 0.0, 0.0), "arrowdown": (0.0, 0.5, 0.0)}
    steps |= {"pagedown": (0.0, 0.0, 0.5)}
    for key, step in steps.items():
        start = np.array(shown.controls.handle.position)
        shown.widgets[f"target: 0.5 m, shift {key}"].act_on_trigger(None)
        place, to = shown.sent.pop()
        np.testing.assert_allclose(place - start, step, atol=1e-9)
        assert to == ()


def test_a_handle_is_sent_where_it_is_let_go() -> None:
    """To a centimetre, once; while it is dragged its place is shown; a click on it sends nothing."""
    shown = Controls()
    handle, typed = shown.controls.handle, shown.widgets["x, y, down (m)"]
    for phase in ("start", "end"):
        handle.act_on_update(SimpleNamespace(phase=phase))
    assert shown.sent == []

    handle.act_on_update(SimpleNamespace(phase="start"))
    handle.position = (1.234, -0.001, -9.5)
    handle.act_on_update(SimpleNamespace(phase="update"))
    assert (typed.value, shown.sent) == ("1.23, 0, -9.5", [])
    handle.act_on_update(SimpleNamespace(phase="end"))
    assert shown.sent == [([1.23, 0.0, -9.5], ())]


def target(number: int, tick: int, x_m: float) -> Target:
    """Return a target at the height of the start, given at a tick."""
    return Target(
        sender="coordinator", incarnation=0, sequence=number, tick=tick, number=number,
        points=np.array([[x_m, 0.0, -10.0]]), times=np.zeros(1), approach_s=2.0,
        approach_ramp_s=1.0, way_s=0.0, way_ramp_s=0.0,
    )  # fmt: skip


def test_the_target_that_is_told_is_that_of_the_shown_time() -> None:
    """None before it was given; afterwards the newest."""
    shown = Controls()
    run = shown.history.setup
    shown.history.add([plant_state(run, tick) for tick in (0, 40)])
    builder = SceneBuilder(run, shown.history)
    for number, x_m in ((1, 0.5), (2, 1.0)):
        shown.history.add([target(number, 10 * number, x_m)])
    texts = []
    for tick in (0, 40):
        shown.controls.show(builder.at(tick))
        texts.append(shown.controls._state.content)
    assert texts[0] == ""
    assert "target x 1," in texts[1]
