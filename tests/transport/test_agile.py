"""Agile flight along a flat reference: the ready scenario, shortened."""

from typing import Any

import numpy as np
import pytest

import transport
from transport.analysis.series import series_of
from transport.model.flight import flight
from transport.mpc.settings import Tension
from transport.protocol.scenario.errors import RequestError, ScenarioError
from transport.protocol.scenario.feasibility import exceeded, teams_left
from transport.protocol.scenario.maneuver_sections import TargetSection
from transport.protocol.scenario.target_planning import target_fields

QUICK = [
    {"name": "hover", "duration_s": 0.5, "displacement_m": [0.0, 0.0, 0.0]},
    {
        "name": "eight",
        "kind": "eight",
        "size_m": [1.6, 0.8, 0.0],
        "laps": 1.0,
        "speed_mps": 2.5,
        "ramp_s": 3.0,
    },
    {"name": "hover", "duration_s": 0.3, "displacement_m": [0.0, 0.0, 0.0]},
]


# A fourth UAV above the payload, which the others can carry without it.
PLACES = [(0.4, 0.0), (-0.2, 0.35), (-0.2, -0.35), (0.0, 0.0)]
FOUR: dict[str, Any] = {
    "system.uav": [
        {
            "id": i,
            "mass_kg": 0.6,
            "inertia_kgm2": [3e-3, 3e-3, 5e-3],
            "rho_m": [*place, -0.05],
            "rod_length_m": 1.0,
        }
        for i, place in enumerate(PLACES, start=1)
    ],
    "agents.owned": [[1], [2], [3], [4]],
}

# States measured without noise, and motors without lag.
_NOISE = ("position_m", "velocity_mps", "attitude_rad", "rate_rads", "specific_force_mps2")
IDEAL: dict[str, Any] = {
    "plant.sensors": "state",
    "controller.estimator": "measured",
    "plant.motors.lag_s": 0.0,
    **{f"plant.noise.{key}": 0.0 for key in _NOISE},
}
LATE: dict[str, Any] = {"delay_s": 0.2, "loss": 0.3}


def error_m(settings: dict[str, Any] | None = None, **changed: Any) -> float:
    """Return the payload's rms distance from its path."""
    run = transport.fly("eight", settings, progress=False, phases=QUICK, **changed)
    assert run.completed
    series = series_of(run.scenario.setup, run.log)
    assert np.linalg.norm(series.payload_velocity_I, axis=1).max() > 2.0, "fast enough to be judged"
    return float(
        np.sqrt(np.mean(np.sum((series.x[:, :3] - series.payload_reference_I) ** 2, axis=1)))
    )


@pytest.mark.slow
def test_sensors_of_the_vehicles_suffice_on_a_late_network() -> None:
    """The scenario as it is, with noise and unknown lag.

    Within the 4 cm that the long flight keeps with every seed.
    """
    assert error_m(delay_s=0.4, loss=0.6) < 0.04


@pytest.mark.slow
def test_delay_and_loss_cost_little() -> None:
    """All plans are the shared law, so of 30 ms of lag that no agent knows a late network makes hardly more."""
    late, perfect, central = (
        error_m({**IDEAL, "plant.motors.lag_s": 0.03}, **changed)
        for changed in (LATE, {}, {"owned": [[1, 2, 3]]})
    )
    assert max(late, perfect, central) < 0.01
    assert late < 1.3 * perfect
    assert perfect < 1.05 * central


def test_known_drag_costs_nothing() -> None:
    """The reference with the drag of its bodies is a motion of the model: as exact as in vacuum."""
    vacuum = {"plant.drag_factor": 0.0, "controller.knows_drag": False}
    known = error_m(IDEAL, **LATE)
    assert known < 0.002
    assert known < 1.2 * error_m({**IDEAL, **vacuum}, **LATE)


@pytest.mark.slow
def test_unknown_drag_is_found() -> None:
    """Drag that no agent knows costs decimetres, and centimetres once the filter estimates it, (73)."""
    unknown = {"controller.knows_drag": False}
    estimated = {**unknown, "controller.disturbance.estimate": True}
    assert error_m(unknown, **LATE) > 0.10
    assert error_m(estimated, **LATE) < 0.04


@pytest.mark.slow
def test_team_without_an_agent_flies_on() -> None:
    """An agent dies for good at full speed.

    Its UAV keeps to its part of the reference, the others take that in.
    """
    died = {
        **IDEAL,
        "faults.event": [{"at_s": 4.0, "do": "kill", "target": "agent3"}],
        "plant.motors.lag_s": 0.03,
    }
    assert error_m(died, on_agent_loss="continue", **LATE) < 0.05


def released(uav: int) -> dict[str, Any]:
    """Four UAVs, one of which is released at full speed."""
    return {**FOUR, "faults.event": [{"at_s": 4.0, "do": "release", "target": f"uav{uav}"}]}


@pytest.mark.slow
def test_release_changes_the_reference() -> None:
    """The three that are left take over the load within a centimetre, on a late network."""
    assert error_m({**IDEAL, **released(4)}, **LATE) < 0.005


def test_release_that_the_rest_cannot_fly_is_refused() -> None:
    """Without an outer UAV the payload hangs beside the rods."""
    with pytest.raises(
        ScenarioError, match="expected all rods of the UAVs left to carry the payload"
    ):
        transport.Scenario("eight", released(1)).setup  # noqa: B018


def test_least_tension_is_that_of_the_uavs_left() -> None:
    """The bob of a released UAV pulls with next to nothing; the rods that carry the payload keep the limit."""
    given = {**released(4), "controller.tension.minimum_N": 3.2}
    setup = transport.Scenario("eight", given).setup

    _, team = teams_left(setup.system, setup.hover, setup.faults)
    path = setup.reference.maneuver.jets(setup.reference.times_s)
    assert team.released == {3}
    assert exceeded(path, team, setup.settings) is None

    higher = setup.settings.model_copy(update={"tension": Tension(minimum_N=5.0)})
    problem = exceeded(path, team, higher)
    assert problem is not None
    least_N = flight(team.system, team.hover, path, released={3}).tensions[:, :3].min()
    assert problem.endswith(f"at least 5 N along the reference, got {least_N:.4g} N")


def test_targets_are_checked_for_the_uavs_left() -> None:
    """A way that only the released UAV could not fly is accepted once it is gone."""
    setup = transport.Scenario("eight", released(4)).setup
    rest_I = setup.maneuver.path(np.array([setup.maneuver.duration_s]))[0][0]
    beyond_I = rest_I + np.array([2.0, 0.0, 0.0])
    points_m = [rest_I.tolist(), beyond_I.tolist()]
    section = TargetSection.model_validate({"points_m": points_m, "times_s": [0.0, 2.5]})

    ticks_per_s = round(1.0 / setup.settings.sampling_period_s)
    with pytest.raises(RequestError, match="expected a commanded rate about axis 2 of at most"):
        target_fields(setup, section, 3 * ticks_per_s)
    assert target_fields(setup, section, 5 * ticks_per_s)["way_s"] == 2.5


@pytest.mark.slow
def test_gap_is_passed_with_the_margins_kept() -> None:
    """By the vehicles' sensors, with late plans and unknown lag, UAVs, rods and payload keep off the walls."""
    shorter = {"maneuver.phase.2.points_m": [[6.0, 0.0, 0.0]], "obstacle.1.at_m": [3.0, 0.0, -10.0]}
    shorter |= {f"maneuver.phase.{phase}.duration_s": 0.3 for phase in (1, 3)}
    run = transport.fly("gap", shorter, progress=False)
    least_m = run.series["clearance_m"].min(axis=0)
    assert run.completed
    assert (least_m >= [0.2, 0.05, 0.05]).all()
    assert run.summary["clearance_min_m"] == dict(
        zip(("uav", "rod", "payload"), least_m, strict=True)
    )
    series = series_of(run.scenario.setup, run.log)
    inside = np.abs(series.x[:, 0] - 3.0) < 0.2
    assert series.payload_velocity_I[inside, 0].min() > 1.45


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        (
            {"obstacle.1.width_m": 0.89},
            r"expected 0.05 m between (payload|rod \d) and the gap along the reference, got 0.045 m at",
        ),
        (
            {"obstacle.1.margin_m": 0.27},
            r"expected 0.27 m between UAV\d and the gap .*; slowing does not help",
        ),
        (
            {"obstacle.1.kind": "sphere"},
            "obstacle.1.radius_m: expected a size with kind 'sphere', got nothing",
        ),
        ({"obstacle.1.size_m": [1.0, 1.0, 1.0]}, "expected no such size with kind 'gap', got"),
    ],
)
def test_reference_keeps_clear_of_obstacles(settings: dict[str, Any], reason: str) -> None:
    """A reference too near to an obstacle is refused with body, distance and instant."""
    with pytest.raises(ScenarioError, match=reason):
        transport.Scenario("gap", settings).setup  # noqa: B018


def test_infeasible_reference_is_refused_with_the_least_slowing() -> None:
    """Twice the speed takes more than the UAVs have.

    The factor in the text makes the reference feasible.
    """
    with pytest.raises(
        ScenarioError,
        match=r"expected a .* along the reference, got .* feasible if all phases take",
    ):
        transport.Scenario("eight", {"maneuver.phase.2.speed_mps": 9.0}).setup  # noqa: B018


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("controller.preview", False, "expected True with maneuver.reference = 'flat'"),
        ("maneuver.profile", "ramp", "expected a smooth path"),
        ("maneuver.phase.2.ramp_s", 50.0, "at most half the duration"),
        (
            "maneuver.phase.2.formation",
            [[0.5, 1.0, 0.6]],
            "expected 1, 1 at the end of the maneuver, got",
        ),
        (
            "maneuver.phase.2.formation",
            [[0.5, 9.0, 1.0], [0.9, 1.0, 1.0]],
            "less than a rod's length off their",
        ),
        (
            "maneuver.phase.2.formation",
            [[0.5, 1.0, 0.1], [0.9, 1.0, 1.0]],
            "expected a distance of UAVs of at least",
        ),
    ],
)
def test_flat_reference_needs_its_settings(key: str, value: object, reason: str) -> None:
    """Settings that a flat reference cannot have are refused by name."""
    settings = {key: value}
    if key == "maneuver.profile":
        settings["maneuver.phase.1.displacement_m"] = [1.0, 0.0, 0.0]
    with pytest.raises(ScenarioError, match=reason):
        transport.Scenario("eight", settings).setup  # noqa: B018
