"""Objects of the model as the sections of a scenario describe them: obstacles and known drag."""

from typing import Any

import numpy as np
import pytest

from tests.support import runs
from tests.support.runs import PAPER
from transport.model.physics.parameters import Kind
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.sections.maneuver_sections import ObstacleSection
from transport.protocol.scenario.setup.model_objects import (
    kinds_of,
    maneuver_of,
    obstacle_of,
    system_of,
)

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


def test_margins_and_penalty_are_those_of_the_section() -> None:
    """Each is of one obstacle."""
    given = {"margin_m": 0.3, "load_margin_m": 0.2, "penalty": 7.0}
    section = ObstacleSection(kind="sphere", radius_m=1.0, at_m=CENTRE_M, **given)  # type: ignore[arg-type]
    made = obstacle_of(section)
    assert (made.margin_m, made.load_margin_m, made.penalty) == (0.3, 0.2, 7.0)


def test_an_inner_loop_has_the_reciprocal_of_its_time_constants() -> None:
    """Only where controllers command body rates; gravity is that of the scenario."""
    rates = "controller.inputs=rates", "controller.rate_time_constant_s=[0.04,0.05,0.1]"
    settings = "system.gravity_mps2=3.7", "controller.limits.thrust_N=[0,45]"
    system = system_of(read_scenario(PAPER, [*rates, *settings]), "paper")
    np.testing.assert_allclose(system.rate_gains, [25.0, 20.0, 10.0])  # type: ignore[arg-type]
    assert system.gravity == 3.7
    assert system_of(read_scenario(PAPER), "paper").rate_gains is None


DRAG = "system.payload.drag_kgps=0.5"
ESTIMATES = (
    "controller.disturbance.estimate=true",
    "controller.estimator=kalman",
    "plant.sensors=vehicle",
    "controller.prediction=closed_loop",
)


@pytest.mark.parametrize(
    ("name", "settings", "kinds"),
    [
        ("paper", (), {(False, False)}),
        ("paper", (DRAG,), {(False, True)}),
        ("paper", (DRAG, "controller.knows_drag=false"), {(False, False), (False, True)}),
        ("paper", (DRAG, "plant.drag_factor=0"), {(False, True), (False, False)}),
        ("paper", ("controller.inputs=rates",), {(True, False), (False, False)}),
        ("paper", ESTIMATES, {(False, False)}),
        ("eight", (*ESTIMATES, "controller.knows_drag=false"), {(True, True), (False, True)}),
    ],
)
def test_kinds_of_equations(
    name: str, settings: tuple[str, ...], kinds: set[tuple[bool, bool]]
) -> None:
    """Rates and drag, of controllers and plant; drag is estimated along a reference that moves fast alone."""
    scenario = read_scenario(find_scenario(name), settings)
    N = len(scenario.system.uav)
    assert kinds_of(scenario) == {Kind(N, rates, drag) for rates, drag in kinds}


@pytest.mark.parametrize("profile", ["ramp", "smooth"])
def test_a_table_of_a_smooth_path_is_a_spline(profile: str) -> None:
    """Its rows are corners otherwise; the press on the ground is that of the file."""
    way = "[[0,0,0,0],[2,1,0,0],[4,1,0,0]]"
    phase = f"maneuver.phase=[{{name='t',way={way}}}]"
    settings = phase, f"maneuver.profile={profile}", "maneuver.press_m=0.4"
    maneuver = maneuver_of(read_scenario(PAPER, settings))
    assert maneuver.press_m == 0.4
    x_m = maneuver.path(np.array([1.0, 2.0]))[0][:, 0]
    assert x_m[1] == pytest.approx(1.0, abs=0.01)  # corners are rounded
    assert (x_m[0] == pytest.approx(0.5)) == (profile == "ramp")
