"""A UAV that has been without its agent for a while is far off its place.

Its agent's return must not lose the load.
"""

import numpy as np
import pytest

from tests.support.runs import completed, plant_states, ready, ticks
from transport.model.state import StateView

CONTINUE = "clock.on_agent_loss=continue"
MANEUVER = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=2.5,displacement_m=[0,0,-1.25]},"
    "{name='translate',duration_s=2.5,displacement_m=[1.25,0,0]}]"
)


@pytest.mark.parametrize("back_s", [3.2, 3.5, 4.0])
def test_a_late_return_brings_the_team_together(back_s: float) -> None:
    """Killed in the climb, back in the translation, decimetres off.

    Level again, and no UAV far beyond its limit.

    While its UAV holds itself up the others fly on with a tilted payload; the return itself does
    not add to that.
    """
    faults = f"faults.event=[{{at_s=1.0,target='agent2',do='kill'}},{{at_s={back_s},target='agent2',do='restart'}}]"
    run = ready("resilient", MANEUVER, CONTINUE, faults)
    x = np.array([state.x for state in plant_states(completed(run))])
    attitude_deg = np.abs(np.degrees(StateView(x).Theta0[:, :2])).max(axis=1)
    back = round(back_s / 0.05)
    assert attitude_deg.max() < 10.0
    assert attitude_deg[back:].max() < attitude_deg[:back].max() + 1.0
    assert attitude_deg[-10:].max() < 0.5
    # The limit of what is planned is 15 deg.
    assert np.abs(np.degrees(StateView(x).Theta[..., :2])).max() < 30.0


def test_a_return_at_the_end_holds_nothing() -> None:
    """A return scripted for the instant at which the run ends neither delays nor breaks that end."""
    run = ready(
        "resilient", ticks(6), CONTINUE, "faults.event=[{at_s=0.25,do='restart',target='agent2'}]"
    )
    assert max(fault.tick for fault in run.faults) == run.ticks
    completed(run)
