"""Sentences and tables of the panel: what is late, off or failed has a colour, all else has none."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from tests.support import runs
from tests.support.log_messages import report
from transport.protocol.wire.messages import StepReport
from transport.scene.history import RunHistory
from transport.scene.scene_at_tick import Scene, SceneBuilder
from transport.scene.uav_and_link_colours import uav_colour
from transport.viewer import panel_values

ALARM = "rgb(178, 24, 43)"
PERIOD_S = 0.05
OWNED = ((0,), (1,), (2,), (3,))


@cache
def scene() -> Scene:
    """Return the scene of tick 4, in which all agents have used the plans of the tick before."""
    setup = runs.setup(runs.SHORT)
    history = RunHistory(setup)
    history.add([runs.plant_state(setup, 4)])
    history.add(report(setup, agent, 4) for agent in setup.agents)
    return SceneBuilder(setup, history).at(4)


def with_report(**fields: Any) -> Scene:
    """Return the scene with another report of agent 2."""
    first, second, *others = scene().reports
    assert isinstance(second, StepReport)
    return replace(scene(), reports=(first, structs.replace(second, **fields), *others))


def rows_of(shown: Scene) -> list[str]:
    """Return the rows of the agents."""
    _, *rows = panel_values.agents(shown, OWNED, PERIOD_S).split("<tr>")[1:]
    return rows


def test_an_agent_in_order_has_the_colour_of_its_uav_alone() -> None:
    """Plans one tick old and measurements of the tick are those of a perfect network."""
    for uav, row in enumerate(rows_of(scene())):
        assert row.count("color:rgb") == 1
        assert f"color:rgb{uav_colour(uav)}" in row
        assert row.count("0.05") == 3


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"plan_ages": (1, 2, 1)}, "<b>0.10</b>"),
        ({"measurement_age": 1}, "<b>0.05</b>"),
        ({"status": "<limit>"}, f'color:{ALARM}">&lt;limit&gt;'),
    ],
)
def test_what_is_late_or_has_failed_is_coloured(fields: dict[str, Any], text: str) -> None:
    """Of the agent that it concerns alone."""
    before, after = rows_of(scene()), rows_of(with_report(**fields))
    assert [a == b for a, b in zip(before, after, strict=True)] == [True, False, True, True]
    assert text in after[1]
    assert after[1].count("color:rgb") == 2


def test_an_agent_without_a_step_is_told_from_one_off_the_roster() -> None:
    """Both have no numbers, and the colour of an alarm."""
    first, _, *others = scene().reports
    missing = replace(scene(), reports=(first, None, *others))
    off = replace(scene(), members=frozenset({1, 3, 4}))
    for shown, text in ((missing, "none"), (off, "off")):
        row = rows_of(shown)[1]
        assert f'color:{ALARM}">{text}<' in row
        assert "0.05" not in row


@pytest.mark.parametrize(("behind_s", "is_alarm"), [(0.9, False), (1.0, True)])
def test_a_view_that_is_a_second_behind_is_coloured(behind_s: float, is_alarm: bool) -> None:
    """It says how far in either case."""
    table = panel_values.flight(scene(), 1.5, behind_s)
    assert f"{behind_s:.1f} s ago" in table
    assert (ALARM in table) is is_alarm


@pytest.mark.parametrize(
    ("arrives_s", "when"), [(0.3, "arrives at t = 0.3 s"), (0.1, "since t = 0.1 s")]
)
def test_a_target_is_ahead_or_reached(arrives_s: float, when: str) -> None:
    """The scene is at 0.2 s; the distance is that of the payload now."""
    target_I = scene().payload_I + np.array([3.0, 4.0, 0.0])
    text = panel_values.target(target_I, arrives_s, scene())
    assert when in text
    assert "5.00 m away" in text
    assert np.isclose(scene().time_s, 0.2)
