"""Teams of any size: the ring is an equilibrium of equals, UAVs and all other keys are the template's."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.runs import PAPER, SCENARIOS
from transport.model.arrays import Array
from transport.protocol.scenario.scenario_file import ScenarioError, read_scenario
from transport.protocol.scenario.sections.schema import Scenario, SystemSection
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.team_of_any_size import (
    FEWEST,
    MOST,
    AirframeSection,
    Team,
    airframe_of,
    find_vehicle,
    given_values,
    resized,
    ring,
)

SIZES = [*range(FEWEST, 17), 24]
NEIGHBOURS_M, GRAVITY = 0.5, 9.81

# Lengths and inertias are rounded to the sixth decimal, half a unit of it at most; a distance is
# made of two points in a plane. Thrusts share what the rounding of the points does to their
# balance, relative to 0.25 m.
ROUNDING, DISTANCE_ROUNDING, SHARE_ROUNDING = 0.5e-6, 2e-6, 1e-5


def system_of(uavs: int) -> SystemSection:
    """Section `system` of a ring."""
    return SystemSection.model_validate(ring(uavs, GRAVITY, papers_airframe()))


def papers_airframe() -> AirframeSection:
    """The UAV of paper.toml."""
    return airframe_of(read_scenario(PAPER), "paper.toml")


def scenario_of(
    uavs: int, template: Path = PAPER, group: int | None = None, name: str | None = None
) -> Scenario:
    """A team with the settings of a scenario."""
    return resized(read_scenario(template), Team(uavs=uavs, group=group, name=name), "--from paper")


def points(uavs: int) -> Array:
    """Attachment points of a ring, (N, 3), payload frame, m."""
    return np.array([uav.rho_m for uav in system_of(uavs).uav])


def test_four_are_the_papers() -> None:
    """A ring of four is the system of paper.toml, number by number and in the same order."""
    assert system_of(4) == read_scenario(PAPER).system
    assert scenario_of(4, name="paper").digest() == read_scenario(PAPER).digest()


@pytest.mark.parametrize("uavs", SIZES)
def test_neighbours_are_as_far_apart_as_the_papers(uavs: int) -> None:
    """Around the ring every UAV is 0.5 m from the next, at the same height, and no two are closer."""
    rho = points(uavs)
    distances = np.linalg.norm(rho[:, None] - rho[None], axis=2)
    np.testing.assert_allclose(
        [distances[i, (i + 1) % uavs] for i in range(uavs)], NEIGHBOURS_M, atol=DISTANCE_ROUNDING
    )
    assert distances[~np.eye(uavs, dtype=bool)].min() > NEIGHBOURS_M - DISTANCE_ROUNDING
    assert len(set(rho[:, 2])) == 1
    assert not np.signbit(rho[rho == 0.0]).any()  # a file has no -0.0


@pytest.mark.parametrize("uavs", SIZES)
def test_the_payload_keeps_its_shape(uavs: int) -> None:
    """A payload has 0.75 kg for each UAV, and the shape of the paper's.

    Inertia over mass grows with the square of the lengths, heights included.
    """
    paper, system = system_of(4), system_of(uavs)
    scale = NEIGHBOURS_M / (2.0 * math.sin(math.pi / uavs)) / math.hypot(0.25, 0.25)
    assert system.payload.mass_kg == 0.75 * uavs
    inertia = np.array(paper.payload.inertia_kgm2) * (uavs / 4 * scale**2)
    np.testing.assert_allclose(system.payload.inertia_kgm2, inertia, atol=ROUNDING * 1.01)
    np.testing.assert_allclose(points(uavs)[:, 2], -0.125 * scale, atol=ROUNDING * 1.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("uavs", "template"),
    [(FEWEST, "resilient"), (16, "resilient"), (3, "paper"), (6, "centralized")],
)
def test_sizes_are_valid(uavs: int, template: str) -> None:
    """Small and large teams build, also from other scenarios.

    The start is an equilibrium with the same thrust for all.
    """
    scenario = scenario_of(uavs, SCENARIOS / f"{template}.toml")
    # Refuses a hover outside the thrust limits or closer than the separation.
    run = Setup.of(scenario, "team")
    assert len(run.hover.tensions) == uavs
    # (1.5 + 0.75) kg for each: 22.07 N of the 45 N there are.
    np.testing.assert_allclose(run.hover.u[::4], 2.25 * GRAVITY, rtol=SHARE_ROUNDING)
    # Accelerations of an equilibrium are rounding: a few ulp of g.
    np.testing.assert_allclose(
        run.model.derivative(run.initial_state(), run.hover.u), 0.0, atol=1e-12
    )


@pytest.mark.parametrize("template", ["paper", "centralized", "resilient"])
def test_the_rest_is_the_templates(template: str) -> None:
    """Everything but name, system and ownership is the template's, and no default is added."""
    path = SCENARIOS / f"{template}.toml"
    own = ("name", "system", "agents")

    def rest(tree: dict[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in tree.items() if key not in own}

    scenario, ready = scenario_of(6, path), read_scenario(path)
    assert rest(scenario.tree()) == rest(ready.tree())
    assert rest(given_values(scenario)) == rest(given_values(ready))
    assert scenario.name == f"{template}-6"


def test_agents_are_the_templates_but_for_what_they_own() -> None:
    """Controller and share of failed steps are not those of the defaults."""
    template = read_scenario(PAPER, ["agents.controller=own:Law", "agents.failed_share=0.5"])
    agents = resized(template, Team(uavs=3, group=1), "team").agents
    assert agents.controller == "own:Law"
    assert agents.failed_share == 0.5
    assert agents.owned == [[1], [2], [3]]


@pytest.mark.parametrize(
    ("template", "uavs", "group", "owned"),
    [
        ("paper", 3, None, [[1], [2], [3]]),
        ("paper", 5, 2, [[1, 2], [3, 4], [5]]),
        ("paper", 3, 3, [[1, 2, 3]]),
        ("centralized", 6, None, [[1, 2, 3, 4, 5, 6]]),
        ("centralized", 3, 1, [[1], [2], [3]]),
    ],
)
def test_ownership(template: str, uavs: int, group: int | None, owned: list[list[int]]) -> None:
    """Agents own neighbours, as many as asked for or as in the template.

    One that owns all still does.
    """
    scenario = scenario_of(uavs, SCENARIOS / f"{template}.toml", group)
    assert [list(ids) for ids in scenario.owned] == owned


@pytest.mark.parametrize("vehicle", [None, "crazyflie", "racing", "x500"])
@pytest.mark.parametrize("uavs", [2, 3, 5, 7, 24])
def test_a_team_of_another_size_keeps_its_uavs(vehicle: str | None, uavs: int) -> None:
    """Resized twice, a team is that of the vehicle at once: UAVs, distances, payload, controller.

    Distances do not drift with the rounding of the points.
    """
    ready = read_scenario(SCENARIOS / "resilient.toml")
    first = resized(ready, Team(uavs=uavs, vehicle=vehicle), "")
    again = resized(first, Team(uavs=6), "")
    at_once = resized(ready, Team(uavs=6, vehicle=vehicle), "")
    assert again.system == at_once.system
    assert again.controller == at_once.controller


def test_a_team_keeps_the_distance_of_its_template() -> None:
    """The UAVs of `eight`, of 0.6 kg and 0.5197 m apart, at the least, are as far apart in a larger ring."""
    larger = scenario_of(6, SCENARIOS / "eight.toml").system
    first, second = (np.array(uav.rho_m) for uav in larger.uav[:2])
    assert float(np.linalg.norm(first - second)) == pytest.approx(0.51971, abs=DISTANCE_ROUNDING)
    assert {uav.mass_kg for uav in larger.uav} == {0.6}
    assert {uav.drag_kgps for uav in larger.uav} == {(0.24, 0.34)}
    assert larger.payload.drag_kgps == 0.0
    assert larger.payload.mass_kg == pytest.approx(6 * 0.3)


@pytest.mark.parametrize(
    ("key", "value", "got"),
    [
        ("mass_kg", "1.6", "expected 1.5, as of UAV1, or a vehicle for the new team, got 1.6"),
        ("inertia_kgm2", "[0.03,0.03,0.06]", "expected [0.029, 0.029, 0.055], as of UAV1, or a"),
        ("rod_length_m", "3.3", "expected 3.2, as of UAV1, or a vehicle for the new team, got 3.3"),
        ("drag_kgps", "[0.1,0.2]", "expected (0.0, 0.0), as of UAV1, or a vehicle for the new"),
        ("radius_m", "0.2", "expected None, as of UAV1, or a vehicle for the new team, got 0.2"),
    ],
)
def test_uavs_that_differ_need_a_vehicle(key: str, value: str, got: str) -> None:
    """A template whose UAVs differ is refused with the first difference; a vehicle replaces them."""
    template = read_scenario(PAPER, [f"system.uav.3.{key}={value}"])
    with pytest.raises(ScenarioError) as caught:
        resized(template, Team(uavs=6), "paper.toml")
    assert str(caught.value).startswith(f"paper.toml: system.uav.3.{key}: {got}")

    made = resized(template, Team(uavs=6, vehicle="x500"), "paper.toml")
    assert {uav.mass_kg for uav in made.system.uav} == {2.0}


def test_uavs_keep_their_radius() -> None:
    """Contacts are told in the new team as well."""
    radii = [f"system.uav.{uav}.radius_m=0.2" for uav in (1, 2, 3, 4)]
    made = resized(read_scenario(PAPER, radii), Team(uavs=5), "paper.toml")
    assert [uav.radius_m for uav in made.system.uav] == [0.2] * 5


def test_a_single_uav_has_no_distance() -> None:
    """A template of one UAV is refused: a ring needs the distance of neighbours."""
    uav = "{id=1,mass_kg=1.5,inertia_kgm2=[1,1,1],rho_m=[0,0,-0.1],rod_length_m=3.0}"
    template = read_scenario(PAPER, [f"system.uav=[{uav}]", "agents.owned=[[1]]"])
    with pytest.raises(ScenarioError, match=r"^one\.toml: system\.uav: expected UAVs apart"):
        resized(template, Team(uavs=3), "one.toml")


def test_sizes_out_of_range_are_refused() -> None:
    """A team has 2 to 256 UAVs and agents of one or more; a ring of one has no finite radius."""
    for uavs in (FEWEST - 1, MOST + 1):
        with pytest.raises(ValueError, match=f"uavs: expected 2 to 256, got {uavs}"):
            Team(uavs=uavs)
    with pytest.raises(ValueError, match="group: expected at least 1 UAV per agent, got 0"):
        Team(uavs=4, group=0)
    with pytest.raises(ValueError, match="N: expected at least 2 UAVs, got 1"):
        ring(1, GRAVITY, papers_airframe())


def test_sources_of_values() -> None:
    """A replaced value has its new source: vehicles replace vehicles, and payload and name are made anew."""
    given = Team(uavs=4, vehicle="x500", load_kg=3.0, name="four").origins()
    vehicle = Team(uavs=4, vehicle="x500").origins()
    assert [one.source for one in given if one.key == "name"] == ["name='four'"]
    assert Team(uavs=6).origins(given) == vehicle

    lighter = Team(uavs=6, load_kg=2.0).origins(given)
    assert [one.source for one in lighter if one.key == "system.payload"] == ["load_kg=2"]

    racing = Team(uavs=6, vehicle="racing").origins(vehicle)
    of_x500 = [one.key for one in racing if one.source == str(find_vehicle("x500"))]
    assert of_x500 == ["plant.motors.falling_lag_s"]  # which racing.toml does not set


def test_what_names_agents_that_are_gone_is_refused(tmp_path: Path) -> None:
    """A template whose links name agent 4 makes no team of three.

    The text names template, field and agents.
    """
    path = tmp_path / "links.toml"
    path.write_text(PAPER.read_text() + '\n[[links.override]]\nto = "agent4"\nloss = 0.1\n')
    assert scenario_of(4, path).links.override[0].to == "agent4"
    with pytest.raises(
        ScenarioError,
        match=r"^--from paper: links\.override\.1\.to: expected one of .*, got 'agent4'",
    ):
        scenario_of(3, path)
