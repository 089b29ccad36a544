"""A team that comes down when it is told to, and rests (docs/engines.md, "On the ground")."""

import numpy as np
import pytest

from tests.support.runs import completed, plant_states, ready, setup
from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.parameters import resting_height
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.scenario_errors import (
    RequestError,
    ScenarioError,
    requested,
)
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.targets.target_checks import target_fields

GROUND = ("plant.engine=mujoco", "plant.ground_m=0.0")
LOW = ("maneuver.start_m=[0.0,0.0,-1.0]",)
HOVER = "maneuver.phase=[{name='hover',duration_s=14,displacement_m=[0,0,0]}]"


def landed(run: Setup) -> tuple[Array, Array]:
    """Return the last state of a completed run, and the last thrusts, (N,), N."""
    last = plant_states(completed(run))[-1]
    return last.x, last.u[:: state.INPUTS]


def test_down_where_it_is_or_at_a_place() -> None:
    """At most 0.5 m/s, to where the payload would rest; a place is reached at the present height first."""
    run = setup(*LOW, HOVER)
    resting_m = resting_height(run.system, 0.0)
    here = target_fields(run, requested(TargetSection, {"land": True}), 20)
    assert here["points"].tolist() == [[0.0, 0.0, resting_m]]
    assert here["lands"]
    # The speed in cruise is the way over its time less one ramp.
    assert (1.0 + resting_m) / (here["approach_s"] - here["approach_ramp_s"]) <= 0.5

    place = {"land": True, "land_at_m": [0.4, -0.2]}
    there = target_fields(run, requested(TargetSection, place), 20)
    assert there["points"].tolist() == [[0.4, -0.2, -1.0], [0.4, -0.2, resting_m]]


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({}, "expected at least one point, or land = true"),
        ({"points_m": [[0, 0, -9]], "land_at_m": [0, 0]}, "expected none without land = true"),
        ({"land": True, "points_m": [[0, 0, -9]], "times_s": [0.0]}, "expected speed_mps"),
        ({"land": True, "land_at_m": [1.0]}, "land_at_m"),
    ],
)
def test_what_is_no_landing(given: dict[str, object], problem: str) -> None:
    """Keys that contradict each other are refused."""
    with pytest.raises(RequestError, match=problem):
        requested(TargetSection, given)


def test_a_landing_after_the_end_is_refused() -> None:
    """A landing from 10 m takes more than 20 s."""
    with pytest.raises(ScenarioError, match="before the end of the run"):
        setup("maneuver.target=[{at_s=10.0,land=true}]")


@pytest.mark.slow
def test_the_team_comes_down_and_rests() -> None:
    """With a ground it carries the load, with a part of its weight, and the UAVs stand still above it.

    Forces that the agents estimate are those of before: of the ground's force they would make an error
    of the mass, and take the thrust away until the UAVs fall over.
    """
    target = "maneuver.target=[{at_s=1.0,land=true,land_at_m=[0.3,0.0]}]"
    run = ready("precise", *LOW, HOVER, *GROUND, "controller.disturbance.estimate=true", target)
    x, thrusts_N = landed(run)
    np.testing.assert_allclose(x[:3], [0.3, 0.0, resting_height(run.system, 0.0)], atol=0.02)
    assert np.abs(x[state.V0]).max() < 0.01
    weights_N = run.system.gravity * np.array([uav.mass for uav in run.system.uavs])
    assert (thrusts_N > weights_N).all()
    assert thrusts_N.sum() < 0.95 * run.hover.u[:: state.INPUTS].sum()
    assert np.degrees(np.abs(state.StateView(x).Theta[:, :2])).max() < 1.0


@pytest.mark.slow
def test_without_a_ground_the_team_hovers_there() -> None:
    """The engine rods has no ground: the payload hovers at the height of rest."""
    run = ready("precise", *LOW, HOVER, "maneuver.target=[{at_s=1.0,land=true}]")
    x, thrusts_N = landed(run)
    np.testing.assert_allclose(x[:3], [0.0, 0.0, resting_height(run.system, 0.0)], atol=0.01)
    np.testing.assert_allclose(thrusts_N, run.hover.u[:: state.INPUTS], rtol=0.01)
