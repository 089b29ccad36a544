"""A UAV that has been without its agent for a while is far off its place: its agent's return must not lose the load."""

import numpy as np
import pytest

from model.state import StateView
from protocol.scenario.file import read_scenario
from protocol.scenario.setup import Setup
from protocol.wire.messages import Message, PlantState
from tests.support.runs import SCENARIOS
from transport.flight.memory import simulate

MANEUVER = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=2.5,displacement_m=[0,0,-1.25]},"
    "{name='translate',duration_s=2.5,displacement_m=[1.25,0,0]}]"
)


@pytest.mark.parametrize("back_s", [3.2, 3.5, 4.0])
def test_a_late_return_brings_the_team_together(back_s: float) -> None:
    """Killed in the climb, back in the translation, decimetres off: level again, and no UAV far beyond its limit.

    While its UAV holds itself up the others fly on with a tilted payload; the return itself does not add to that.
    """
    settings = [
        MANEUVER,
        'clock.on_agent_loss="continue"',
        f"faults.event=[{{at_s=1.0,target='agent2',do='kill'}},{{at_s={back_s},target='agent2',do='restart'}}]",
    ]
    run = Setup.of(read_scenario(SCENARIOS / "resilient.toml", settings), "resilient")
    messages: list[Message] = []
    assert simulate(run, messages.append).outcome == "completed"
    x = np.array([message.x for message in messages if isinstance(message, PlantState)])
    attitude_deg = np.abs(np.degrees(StateView(x).Theta0[:, :2])).max(axis=1)
    back = round(back_s / 0.05)
    assert attitude_deg.max() < 10.0
    assert attitude_deg[back:].max() < attitude_deg[:back].max() + 1.0
    assert attitude_deg[-10:].max() < 0.5
    # The limit of what is planned is 15 deg.
    assert np.abs(np.degrees(StateView(x).Theta[..., :2])).max() < 30.0


def test_a_return_at_the_end_holds_nothing() -> None:
    """A return scripted for the instant at which the run ends neither delays nor breaks that end."""
    settings = [
        "maneuver.phase=[{name='hover',duration_s=0.3,displacement_m=[0,0,0]}]",
        'clock.on_agent_loss="continue"',
        "faults.event=[{at_s=0.25,do='restart',target='agent2'}]",
    ]
    run = Setup.of(read_scenario(SCENARIOS / "resilient.toml", settings), "resilient")
    assert max(fault.tick for fault in run.faults) == run.ticks
    end = simulate(run, lambda _: None)
    assert (end.outcome, end.exit_code) == ("completed", 0)
