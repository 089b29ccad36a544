"""Objects of the model as the sections of a scenario describe them: obstacles and known drag."""

from typing import Any

import numpy as np
import pytest

from tests.support import runs
from transport.protocol.scenario.sections.maneuver_sections import ObstacleSection
from transport.protocol.scenario.setup.model_objects import obstacle_of, system_of

CENTRE_M = (10.0, -20.0, -5.0)
HEADING_DEG = 30.0
BOX = {"kind": "box", "size_m": (2.0, 4.0, 6.0)}
GAP = {"kind": "gap", "width_m": 3.0, "thickness_m": 0.4}
ROUNDING_M = 1e-9


@pytest.mark.parametrize(
    ("given", "point_m", "distance_m"),
    [
        ({"kind": "sphere", "radius_m": 2.0}, (0.0, -3.0, 4.0), 3.0),
        ({"kind": "cylinder", "radius_m": 2.0}, (0.0, -3.0, 400.0), 1.0),
        (BOX, (1.5, 0.0, 0.0), 0.5),
        (BOX, (0.0, -2.5, 0.0), 0.5),
        (BOX, (0.0, 0.0, 3.5), 0.5),
        (GAP, (0.0, 0.0, 0.0), 1.5),
        (GAP, (0.0, 1.0, 70.0), 0.5),
        (GAP, (0.0, -1.2, -70.0), 0.3),
        (GAP, (0.9, 50.0, 0.0), 0.7),
        (GAP, (-0.1, -50.0, 0.0), -0.1),
    ],
)
def test_an_obstacle_is_where_its_section_says(
    given: dict[str, Any], point_m: tuple[float, float, float], distance_m: float
) -> None:
    """Distances from its surface of points along its heading, across and below; a gap is open for its width."""
    section = ObstacleSection(at_m=CENTRE_M, margin_m=1.0, heading_deg=HEADING_DEG, **given)
    cos, sin = np.cos(np.radians(HEADING_DEG)), np.sin(np.radians(HEADING_DEG))
    along, across, down = point_m
    # From x towards y; seen along z, down.
    point_I = np.add(CENTRE_M, (cos * along - sin * across, sin * along + cos * across, down))
    distances_m = [solid.from_points(point_I)[0] for solid in obstacle_of(section).solids]
    assert min(distances_m) == pytest.approx(distance_m, abs=ROUNDING_M)


@pytest.mark.parametrize(("knows", "share"), [("true", 1.0), ("false", 0.0)])
def test_controllers_know_the_drag_or_assume_none(knows: str, share: float) -> None:
    """With `controller.knows_drag` false the bodies that controllers assume have no drag."""
    drag = ("system.payload.drag_kgps=0.5", "system.uav.1.drag_kgps=[0.3,0.1]")
    scenario = runs.setup(*drag, f"controller.knows_drag={knows}").scenario
    system = system_of(scenario, "paper")
    assert system.payload.drag == share * 0.5
    np.testing.assert_array_equal(system.uavs[0].drag, [share * 0.3, share * 0.1])
