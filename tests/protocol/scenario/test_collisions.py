"""Contacts of UAVs with a size: told by time and pair, and the outcome of the run."""

from typing import Any

import numpy as np
import pytest

import transport
from tests.support.messages import changed
from tests.support.runs import SCENARIOS, plant_state, ready, setup
from transport.model.arrays import Array
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.team_of_any_size import Team, resized
from transport.protocol.wire.errors_and_exit_codes import EXIT_COLLIDED
from transport.protocol.wire.messages import PlantState

# Commands that reach the actuators 100 ms late: the UAVs swing into each other.
LATE = {"links.actuation.delay_s": 0.1}
# On this way they do.
ASIDE = {
    "maneuver.phase": [
        {"name": "hover", "duration_s": 1.0, "displacement_m": [0.0, 0.0, 0.0]},
        {"name": "translate", "duration_s": 5.0, "displacement_m": [2.5, 0.0, 0.0]},
    ]
}
RUN = ready("resilient")
RADIUS_M = 0.1
ROUNDING = 1e-9


def flown(*changes: tuple[str, Any]) -> dict[str, Any]:
    """Return the summary of a flight with late commands."""
    return transport.fly("resilient", LATE | dict(changes), progress=False).summary


def leaning(run: Setup, k: int, angles: dict[int, float]) -> PlantState:
    """Return the plant state of a tick with rods leaning towards +x, by angle of the UAV, 0-based."""
    message = plant_state(run, k)
    x = message.x.copy()
    for uav, angle in angles.items():
        x[12 + 12 * uav : 15 + 12 * uav] = [-np.sin(angle), 0.0, np.cos(angle)]
    return changed(message, x=x)


def positions(run: Setup, message: PlantState) -> Array:
    """Return the positions of the UAVs, (N, 3), m."""
    return run.model.outputs(message.x)[: 3 * run.system.N].reshape(-1, 3)


def test_they_touch_between_two_ticks() -> None:
    """The moment is that at which the line of motion comes to the sum of the radii.

    UAV4 passes through UAV1 within one period: at no tick do they touch.
    """
    through = 2.0 * np.arcsin(0.5 / 3.2)  # of a rod, to as far beyond UAV1 as it was before it
    before, after = plant_state(RUN, 0), leaning(RUN, 1, {3: through})
    start, end = (positions(RUN, message) for message in (before, after))
    assert min(np.linalg.norm(r[0] - r[3]) for r in (start, end)) > 2.0 * RADIUS_M

    contact = RUN.contacts().over([before, after])
    assert contact is not None
    assert contact.uavs == (1, 4)
    share = contact.at_s / 0.05
    r = start + share * (end - start)
    assert np.linalg.norm(r[0] - r[3]) == pytest.approx(2.0 * RADIUS_M, abs=ROUNDING)
    assert 0.0 < share < 0.5


def test_the_first_contact_counts() -> None:
    """Of two in one period the earlier one, and none after it."""
    contacts = RUN.contacts()
    assert contacts.add(plant_state(RUN, 0)) is None
    first = contacts.add(leaning(RUN, 1, {2: 0.3, 3: 0.1}))
    assert first is not None
    assert first.uavs == (2, 3)
    assert contacts.add(leaning(RUN, 2, {3: 0.3})) is None
    assert contacts.first == first


def test_what_touches_nothing() -> None:
    """UAVs without a size, and released ones; nothing is known across a gap of the record."""
    swing = [plant_state(RUN, 0), leaning(RUN, 1, {3: 2.0 * np.arcsin(0.5 / 3.2)})]
    assert ready("paper").contacts().over(swing) is None
    one = ready("resilient", "system.uav.1.radius_m=0.0011")
    assert one.contacts().over(swing) is not None
    released = ready("resilient", "faults.event=[{at_s=0.0,do='release',target='uav4'}]")
    assert released.contacts().over(swing) is None
    assert RUN.contacts().over([swing[0], changed(swing[1], tick=2)]) is None


def test_a_collision_is_the_outcome() -> None:
    """The run goes on, or ends by a key, with the same contact and exit code either way."""
    went_on = transport.fly("resilient", LATE | ASIDE, progress=False).summary
    end = {"plant.on_collision": "end"}
    ended = transport.fly("resilient", LATE | ASIDE | end, progress=False).summary
    collision = went_on["collision"]
    assert ended["collision"] == collision
    for summary in (went_on, ended):
        assert (summary["outcome"], summary["exit_code"]) == ("collided", EXIT_COLLIDED)
        one, other = collision["uavs"]
        assert summary["reason"].startswith(f"UAV{one} and UAV{other} collide")
    assert collision["distance_m"] == 2.0 * RADIUS_M
    assert went_on["ticks"] == 120
    # The period of the contact, and the tick whose state tells it.
    assert ended["ticks"] == int(collision["at_s"] / 0.05) + 2


def test_spheres_that_touch_at_hover_are_refused() -> None:
    """With UAV, expected and got."""
    with pytest.raises(
        ScenarioError, match=r"expected less than 0\.500 m .*got 0\.600 m"
    ) as refused:
        setup(*(f"system.uav.{uav}.radius_m=0.3" for uav in (1, 2, 3, 4)))
    assert refused.value.field == "system.uav.2.radius_m"


@pytest.mark.parametrize("vehicle", ["crazyflie", "racing", "x500"])
def test_teams_of_vehicles_have_their_size(vehicle: str) -> None:
    """It is less than half the least distance that the controllers keep."""
    scenario = read_scenario(SCENARIOS / "resilient.toml")
    team = resized(scenario, Team(uavs=4, vehicle=vehicle), "resilient")
    radius_m = team.system.uav[0].radius_m
    assert radius_m is not None
    assert team.controller.separation is not None
    assert 2.0 * radius_m <= team.controller.separation.minimum_m
    assert {uav.radius_m for uav in team.system.uav} == {radius_m}
