"""Agile flight along a flat reference: the ready scenario, shortened."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import transport
from tests.support.runs import begun, plant_states
from transport.analysis.series import series_of
from transport.model import state
from transport.model.arrays import Array
from transport.model.path.curves import Curve
from transport.model.path.flatness import flight
from transport.mpc.settings_period_horizon_weights import TensionSection
from transport.protocol.scenario.checks.feasibility import exceeded, remaining_teams
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.scenario_errors import RequestError, ScenarioError
from transport.protocol.scenario.targets.target_checks import target_fields
from transport.report.limits_in_words import explained, explained_in_words

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


# Of 190: in the last two seconds the team comes to rest, with the smallest errors.
FLOWN_TICKS = 150

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
LATE: dict[str, Any] = {"links.delay_s": 0.2, "links.loss": 0.3}
LAG: dict[str, Any] = {**IDEAL, "plant.motors.lag_s": 0.03}


def errors_m(settings: dict[str, Any]) -> Array:
    """Return the payload's distances from its path, of a shortened `eight` until half its speed is left."""
    setup = transport.Scenario("eight", {"maneuver.phase": QUICK, **settings}).setup
    x = np.array([one.x for one in plant_states(begun(setup, FLOWN_TICKS))])
    times_s: Array = setup.settings.sampling_period_s * np.arange(len(x), dtype=np.float64)
    assert np.linalg.norm(setup.maneuver.path(times_s)[1], axis=1).max() > 2.0, "fast enough"
    return np.asarray(np.linalg.norm(x[:, state.R0] - setup.maneuver.path(times_s)[0], axis=1))


def rms(errors: Array) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(errors**2)))


@pytest.mark.slow
def test_delay_and_loss_cost_little() -> None:
    """All plans are the shared law, so of 30 ms of lag that no agent knows a late network makes hardly more."""
    late, perfect, central = (
        rms(errors_m({**LAG, **changed})) for changed in (LATE, {}, {"agents.owned": [[1, 2, 3]]})
    )
    assert max(late, perfect, central) < 0.01
    assert late < 1.3 * perfect
    assert perfect < 1.05 * central


def test_known_drag_costs_nothing() -> None:
    """The reference with the drag of its bodies is a motion of the model: as exact as in vacuum, 2 mm."""
    assert rms(errors_m({**IDEAL, **LATE})) < 0.002


@pytest.mark.slow
def test_unknown_drag_is_found_and_serves_a_uav_alone() -> None:
    """Drag that no agent knows costs decimetres, and centimetres once the filter estimates it, (73).

    Without any message at full speed each UAV follows the reference with the drag found before.
    """
    unknown = {**LATE, "controller.knows_drag": False}
    assert errors_m({**IDEAL, **unknown}).max() > 0.15
    silent = {
        "controller.disturbance.estimate": True,
        "links.change": [{"at_s": 3.5, "loss": 1.0}, {"at_s": 6.5, "loss": 0.3}],
    }
    assert rms(errors_m({**unknown, **silent})) < 0.04


@pytest.mark.slow
def test_team_without_an_agent_flies_on() -> None:
    """An agent dies for good at full speed.

    Its UAV keeps to its part of the reference, the others take that in.
    """
    died = {
        "faults.event": [{"at_s": 4.0, "do": "kill", "target": "agent3"}],
        "clock.on_agent_loss": "continue",
    }
    assert rms(errors_m({**LAG, **LATE, **died})) < 0.05


def released(uav: int) -> dict[str, Any]:
    """Four UAVs, one of which is released at full speed."""
    return {**FOUR, "faults.event": [{"at_s": 4.0, "do": "release", "target": f"uav{uav}"}]}


@pytest.mark.slow
def test_release_changes_the_reference() -> None:
    """The three that are left take over the load within a centimetre, on a late network."""
    assert rms(errors_m({**IDEAL, **LATE, **released(4)})) < 0.005


def test_release_that_the_rest_cannot_fly_is_refused() -> None:
    """Without an outer UAV the payload hangs beside the rods."""
    with pytest.raises(
        ScenarioError, match="expected all rods of the remaining UAVs to carry the payload"
    ):
        transport.Scenario("eight", released(1)).setup  # noqa: B018


def test_least_tension_is_that_of_the_uavs_left() -> None:
    """The bob of a released UAV pulls with next to nothing; the rods that carry the payload keep the limit."""
    given = {**released(4), "controller.tension.minimum_N": 3.2}
    setup = transport.Scenario("eight", given).setup

    _, team = remaining_teams(setup.system, setup.hover, setup.faults)
    path = setup.reference.maneuver.jets(setup.reference.times_s)
    assert team.released == {3}
    assert exceeded(path, team, setup.settings) is None

    higher = setup.settings.model_copy(update={"tension": TensionSection(minimum_N=5.0)})
    problem = exceeded(path, team, higher)
    assert problem is not None
    least_N = flight(team.system, team.hover, path, released={3}).tensions[:, :3].min()
    assert f"at least 5 N along the reference, got {least_N:.4g} N of UAV" in problem


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


def test_a_refused_reference_names_uav_phase_and_time_and_the_phase_to_change() -> None:
    """The text says who exceeds the limit, when, and how much longer this one phase has to be.

    With the factor of the text the reference is feasible, with a hundredth less it is not.
    """
    fast = {"maneuver.phase.2.speed_mps": 9.0}
    with pytest.raises(ScenarioError) as refused:
        transport.Scenario("eight", fast).setup  # noqa: B018
    text = str(refused.value)
    told = re.search(r"got (.*) N of UAV(\d) at (.*) s in phase 2 \(eight\); ", text)
    assert told is not None
    factor = re.search(r"or phase 2 \(eight\) alone (.*) times: ", text)
    assert factor is not None

    longer = float(factor[1])
    ramp_s = 5.0  # of the scenario
    for share, is_kept in ((1.0, True), (0.99, False)):
        slower = {
            "maneuver.phase.2.speed_mps": 9.0 / (share * longer),
            "maneuver.phase.2.ramp_s": share * longer * ramp_s,
        }
        if is_kept:
            assert transport.Scenario("eight", slower).setup.reference.is_flat
            continue
        with pytest.raises(ScenarioError, match=r"along the reference, got .* of UAV\d at"):
            transport.Scenario("eight", slower).setup  # noqa: B018

    # UAV and time are those of the largest thrust along the reference, within its maneuver.
    thrust_N, uav, at_s = (float(number) for number in told.groups())
    # The same phase on the path of the ready scenario, whose speed is 5 m/s: T - t_r is the way / speed.
    setup = transport.Scenario("eight").setup
    phases = list(setup.maneuver.phases)
    curve = phases[1].way
    assert isinstance(curve, Curve)
    duration_s = (curve.duration_s - ramp_s) * 5.0 / 9.0 + ramp_s
    phases[1] = replace(phases[1], duration_s=duration_s, way=replace(curve, duration_s=duration_s))
    maneuver = replace(setup.maneuver, phases=tuple(phases))

    path = maneuver.jets(np.array([at_s]))
    thrusts_N = flight(setup.system, setup.hover, path).u.reshape(-1, 4)[:, 0]
    assert thrusts_N.max() == pytest.approx(thrust_N, rel=1e-2)
    assert thrusts_N.argmax() + 1 == uav


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


def test_the_nearest_limit_is_explained() -> None:
    """The closest pair and the limit of a UAV with the least room, with UAV and time, are those of the track."""
    setup = transport.Scenario("eight").setup
    told = explained(setup)
    assert setup.track is not None
    uavs_I = setup.reference.outputs(setup.reference.times_s)[:, :9].reshape(-1, 3, 3)
    apart_m = np.linalg.norm(uavs_I[:, [0, 0, 1]] - uavs_I[:, [1, 2, 2]], axis=2)
    closest = told["closest_pair"]
    assert closest["distance_m"] == pytest.approx(apart_m.min(), abs=1e-3)
    assert closest["uavs"] == [[1, 2], [1, 3], [2, 3]][int(apart_m.min(axis=0).argmin())]

    # The track has the same at its instants, between which the check looks as well.
    inputs = np.abs(setup.track.U.reshape(-1, 3, 4))
    shares = inputs.max(axis=(0, 1)) / np.abs(setup.settings.upper(1))
    nearest = told["nearest_limit"]
    assert nearest["room"] <= 1.0 - shares.max() + 1e-3
    entry = {"thrust": 0, "axis 1": 1, "axis 2": 2, "axis 3": 3}
    (column,) = [column for name, column in entry.items() if name in nearest["limit"]]
    row = int(np.abs(setup.reference.times_s - nearest["at_s"]).argmin())
    assert inputs[row, nearest["uavs"][0] - 1, column] == pytest.approx(nearest["value"], rel=0.05)
    closest_line, nearest_line, remedy = explained_in_words(setup)
    assert closest_line.startswith(f"closest pair: UAV{closest['uavs'][0]} and UAV")
    assert (
        f"of UAV{nearest['uavs'][0]} at {nearest['at_s']:.2f} s in phase 2 (eight)" in nearest_line
    )
    assert "maneuver.phase.2 (eight)" in remedy


def test_the_nearest_limit_of_a_hover_is_that_of_its_thrust() -> None:
    """A reference of hover has no accelerations: hover thrust over the largest one."""
    setup = transport.Scenario("resilient").setup
    nearest = explained(setup)["nearest_limit"]
    assert (nearest["at_s"], nearest["limit"]) == (None, "a thrust of at most")
    assert nearest["value"] == pytest.approx(float(setup.hover.u[0]))
    assert nearest["room"] == pytest.approx(1.0 - float(setup.hover.u[0]) / 45.0)
