"""Teams drawn by a seed (`protocol.scenario.teams.drawn_team`)."""

import math
import zlib
from functools import cache
from itertools import combinations
from typing import Any

import numpy as np
import pytest

from transport.model.state import INPUTS
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.drawn_team import DRAWN, NOISE, drawn, put_drawn_vehicles
from transport.search.candidate import Base, Candidate
from transport.search.kinds_of_events import DrawnSilence, DrawnTeam

SEEDS = range(20)
# Of these the first draw with a hover has a rod with less than a fifth of the mean tension: it is left out.
SLACK_AT_FIRST = (101, 290)
# Checksums of the drawn scenarios by seed.
CHECKSUMS = {3: 556_048_774, 11: 473_419_120}


def template(name: str = "precise") -> Scenario:
    """Return a ready scenario."""
    return read_scenario(find_scenario(name))


@cache
def team(seed: int) -> Scenario:
    """Return the drawn team of a seed."""
    return drawn(seed, template(), "precise")


@pytest.mark.parametrize("seed", [*SEEDS[::4], *SLACK_AT_FIRST])
def test_a_drawn_team_hovers_with_taut_rods_apart_within_its_limits(seed: int) -> None:
    """Every rod carries a fifth of the mean, UAVs and attachments are apart, and half the thrust at most is in use."""
    setup = Setup.of(team(seed), f"team {seed}")
    assert DRAWN.uavs[0] <= setup.system.N <= DRAWN.uavs[1]
    assert setup.hover.tensions.min() >= 0.2 * setup.hover.tensions.mean()
    assert (
        setup.hover.u[::INPUTS].max() <= setup.settings.limits.thrust_N[1] / DRAWN.thrust[0] * 1.001
    )
    places_m = [uav.rho - [0.0, 0.0, uav.rod_length] for uav in setup.system.uavs]
    apart_m = min(float(np.linalg.norm(a - b)) for a, b in combinations(places_m, 2))
    assert setup.settings.separation is not None
    assert setup.settings.separation.minimum_m == pytest.approx(0.75 * apart_m, abs=1e-3)
    attachments = combinations([uav.rho for uav in setup.system.uavs], 2)
    assert min(float(np.linalg.norm(a - b)) for a, b in attachments) >= 0.4


def test_a_seed_is_one_team_and_seeds_differ() -> None:
    """A seed gives the same scenario every time, and no two seeds the same bodies."""
    again = [team(seed) for seed in SEEDS]
    assert again == [drawn(seed, template(), "precise") for seed in SEEDS]
    assert len({str(scenario.system) for scenario in again}) == len(SEEDS)


@pytest.mark.parametrize("seed", [3, 11])
def test_a_seed_is_the_team_that_it_was(seed: int) -> None:
    """Results name teams by their seeds: a further draw needs a stream of its own."""
    assert zlib.crc32(drawn_numbers(team(seed)).encode()) == CHECKSUMS[seed]


def drawn_numbers(scenario: Scenario) -> str:
    """Return all values that a scenario does not have from its template, numbers with nine digits."""

    def rounded(value: object) -> object:
        if isinstance(value, float):
            return f"{value:.9g}"
        if isinstance(value, dict):
            return {key: rounded(value[key]) for key in sorted(value)}
        return [rounded(one) for one in value] if isinstance(value, list | tuple) else value

    def drawn_only(tree: dict[str, Any], before: dict[str, Any]) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for key, value in tree.items():
            old = before.get(key)
            if isinstance(value, dict) and isinstance(old, dict):
                found[key] = drawn_only(value, old)
            elif value != old:
                found[key] = value
        return found

    return str(rounded(drawn_only(scenario.tree(), template().tree())))


def test_all_kinds_are_drawn() -> None:
    """Among the first teams are all sizes, inputs, actuations and sensors, and several periods."""
    teams = [team(seed) for seed in range(60)]
    assert {len(team.system.uav) for team in teams} == set(range(DRAWN.uavs[0], DRAWN.uavs[1] + 1))
    assert {team.controller.inputs for team in teams} == {"moments", "rates"}
    assert {team.clock.actuation for team in teams} == {"immediate", "next_tick"}
    assert {team.plant.sensors for team in teams} == {"state", "vehicle"}
    assert {team.system.payload.drag_kgps > 0.0 for team in teams} == {False, True}
    assert {team.controller.sampling_period_s for team in teams} == set(DRAWN.periods_s)


def within(value: float, bounds: tuple[float, float]) -> bool:
    """Return whether a value is in bounds, but for its rounding in a file."""
    rounding = 2e-3 * max(abs(bounds[0]), abs(bounds[1]))
    return bounds[0] - rounding <= value <= bounds[1] + rounding


@pytest.mark.parametrize("seed", SEEDS)
def test_bodies_are_drawn_in_their_ranges(seed: int) -> None:
    """Each UAV and the payload, relative to mass, ring and number of UAVs."""
    system = team(seed).system
    for uav in system.uav:
        roll, pitch, yaw = (float(moment) for moment in uav.inertia_kgm2)  # type: ignore[arg-type]
        assert within(uav.mass_kg, DRAWN.uav_mass_kg)
        assert within(math.sqrt(roll / uav.mass_kg), DRAWN.uav_gyration_m)
        assert within(pitch / roll, DRAWN.uav_pitch_inertia)
        assert within(yaw / roll, DRAWN.uav_yaw_inertia)
        assert within(uav.rod_length_m, DRAWN.rod_length_m)
        assert within(-uav.rho_m[2], DRAWN.height_m)
        if any(uav.drag_kgps):
            assert within(uav.drag_kgps[0] / uav.mass_kg, DRAWN.uav_drag)
        assert uav.drag_kgps[1] == 0.0
    assert within(system.payload.mass_kg / sum(uav.mass_kg for uav in system.uav), DRAWN.load)
    assert within(system.payload.drag_kgps, DRAWN.load_drag_kgps)


@pytest.mark.parametrize("seed", SEEDS)
def test_flight_and_limits_are_drawn_in_their_ranges(seed: int) -> None:
    """A horizon in seconds, limits by hover and inertia, a leg, and noise of sensors that are there."""
    scenario = team(seed)
    controller, limits = scenario.controller, scenario.controller.limits
    horizon_s = controller.horizon * controller.sampling_period_s
    fewest, most = DRAWN.horizon
    half_s = 0.5 * controller.sampling_period_s
    assert fewest <= controller.horizon <= most
    assert horizon_s <= DRAWN.horizon_s[1] + half_s
    assert horizon_s >= DRAWN.horizon_s[0] - half_s or controller.horizon == most

    # In a second the thrust covers four times its range, the moments ten times theirs.
    assert limits.thrust_rate_N_s == pytest.approx(4.0 * limits.thrust_N[1], rel=1e-3)
    assert limits.moment_rates_Nm_s == pytest.approx(
        [10.0 * moment for moment in limits.moments_Nm], rel=1e-3
    )
    inertia = np.array([uav.inertia_kgm2 for uav in scenario.system.uav]).max(axis=0)
    about_roll, about_pitch, about_yaw = np.array(limits.moments_Nm) / inertia
    assert within(about_roll, DRAWN.angular_acceleration_rads2)
    assert about_pitch == pytest.approx(about_roll, rel=2e-3)
    assert about_yaw == pytest.approx(about_roll / 4.0, rel=2e-3)

    leg_m = np.array(scenario.maneuver.phase[1].displacement_m)
    assert within(float(np.linalg.norm(leg_m)), DRAWN.leg_m)
    assert within(math.asin(leg_m[2] / np.linalg.norm(leg_m)), DRAWN.elevation_rad)
    links = scenario.links
    assert within(links.delay_s, DRAWN.delay_s)
    assert within(links.jitter_s, DRAWN.jitter_s)
    assert within(links.loss, DRAWN.loss)
    assert within(scenario.plant.wind.gust_mps[0], DRAWN.gust_mps)

    noise = scenario.plant.noise
    shares = [getattr(noise, key) / sigma for key, sigma in NOISE.items()]
    if scenario.plant.sensors == "vehicle":
        assert within(shares[0], DRAWN.noise)
        assert shares == pytest.approx(shares[:1] * len(shares), rel=2e-3)
    else:
        assert shares == [0.0] * len(shares)


def test_vehicles_in_a_scenario_are_as_many_and_all_else_stays() -> None:
    """A search draws teams of the scenario's size: agents of its silences and deaths exist."""
    base = Base(scenario=template("windy"), source="windy")
    silent = DrawnSilence(start_s=2.0, duration_s=1.0, who="mute 4")
    scenario = Candidate((DrawnTeam(seed=5), silent)).scenario(base)
    assert len(scenario.system.uav) == len(base.scenario.system.uav)
    assert scenario.system.payload != base.scenario.system.payload
    assert scenario.plant == base.scenario.plant
    assert scenario.maneuver == base.scenario.maneuver
    assert scenario.controller.disturbance == base.scenario.controller.disturbance
    assert scenario.links.change


def test_the_same_seed_and_size_are_the_same_bodies() -> None:
    """The team of a search is that of the campaign, where both have as many UAVs."""
    seed = next(s for s in SEEDS if len(drawn(s, template(), "precise").system.uav) == 4)
    tree = template().tree()
    put_drawn_vehicles(tree, seed)
    whole = drawn(seed, template(), "precise")
    assert Scenario.model_validate(tree).system == whole.system


@pytest.mark.parametrize("unknown", [{}, {"drag_uav_kgps": 0.3}, {"drag_payload_kgps": 0.3}])
def test_unknown_drag_takes_the_place_of_that_of_the_bodies(unknown: dict[str, float]) -> None:
    """A scenario has drag that its controllers know, or drag that they do not know."""
    seed = next(seed for seed in SEEDS if team(seed).system.payload.drag_kgps > 0.0)
    tree = template().tree()
    tree["plant"]["wind"] |= unknown
    put_drawn_vehicles(tree, seed)
    have_drag = [
        "drag_kgps" in body for body in (tree["system"]["payload"], *tree["system"]["uav"])
    ]
    assert set(have_drag) == {not unknown}
