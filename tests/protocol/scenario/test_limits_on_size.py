"""Sizes of runs agree with those of controllers, and limits hold."""

import pytest

from transport.mpc.program.constraints import constraints_of
from transport.mpc.program.constraints.stack import Stack
from transport.mpc.program.decision import Decision
from transport.protocol.scenario.scenario_file import ScenarioError, find_scenario, read_scenario
from transport.protocol.scenario.sections.limits_on_size import most_workers, size_of
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.team_of_any_size import Team, resized

SHORT = "maneuver.phase=[{name='climb',duration_s=2.0,displacement_m=[0.0,0.0,-1.0]}]"

TEAMS = [
    ("paper", 4, 1),
    ("resilient", 4, 1),
    ("resilient", 6, 2),
    ("resilient", 4, 4),
    ("collision", 4, 1),
    ("windy", 3, 3),
]


def scenario_of(name: str, uavs: int, group: int, *settings: str) -> Scenario:
    """A ready scenario for a team of any size."""
    path = find_scenario(name)
    ready = read_scenario(path, [SHORT, *settings], allow_large=True)
    return ready if uavs == 4 and group == 1 else resized(ready, Team(uavs=uavs, group=group), name)


@pytest.mark.parametrize(("name", "uavs", "group"), TEAMS)
def test_size_of_the_program(name: str, uavs: int, group: int) -> None:
    """Variables and rows are those of the largest agent's QP.

    The user's constraints count as one row per step each.
    """
    scenario = scenario_of(name, uavs, group, "controller.horizon=7")
    setup = Setup.of(scenario, name)
    largest = max(setup.owned, key=len)
    decision = Decision(setup.system, setup.settings, largest)
    stack = Stack(decision, constraints_of(decision))
    found = size_of(scenario)
    assert found.ticks == setup.ticks
    constraints = len(scenario.controller.constraint)
    actual = decision.size + len(stack.penalties)
    assert actual <= found.variables <= actual + constraints
    actual_rows = len(stack.empty().A)
    assert actual_rows <= found.rows <= actual_rows + 7 * constraints


def test_workers_share_one_limit() -> None:
    """As many runs at a time as together are as large as one may be; one run at least."""
    path = find_scenario("resilient")
    small = read_scenario(path)
    large = read_scenario(path, ["maneuver.phase.1.duration_s=6000.0"])
    larger = read_scenario(path, ["maneuver.phase.1.duration_s=2e4"], allow_large=True)
    assert most_workers([small]) > 64
    assert [most_workers(runs) for runs in ([large, small], [larger], [])] == [2, 1, 1]


BEYOND = [
    (
        "maneuver.phase.1.duration_s=5e8",
        "maneuver.phase",
        "expected at most 1,000,000 steps of all agents, got 40,",
    ),
    (
        "plant.step_s=1e-8",
        "plant.step_s",
        "expected at most 10,000 integration steps per sampling period, got 5,000,0",
    ),
    (
        "controller.horizon=3000",
        "controller.horizon",
        "expected at most 100,000,000 entries in the constraint matrices of all agents, got 1,",
    ),
    (
        "maneuver.phase.1.duration_s=2e4",
        "maneuver.phase",
        "expected at most 1,000,000 steps of all agents, got 1,6",
    ),
]


@pytest.mark.parametrize(("setting", "field", "text"), BEYOND)
def test_large_runs_are_refused_unless_allowed(setting: str, field: str, text: str) -> None:
    """A run beyond a limit is refused by the setting, the limit and the size.

    It is read with `allow_large`.
    """
    path = find_scenario("resilient")
    with pytest.raises(ScenarioError, match=text) as caught:
        read_scenario(path, [setting])
    assert str(caught.value).startswith(f"--set {setting}: ")
    assert caught.value.field in (field, "")
    assert "--allow-large admits more" in str(caught.value)
    assert read_scenario(path, [setting], allow_large=True).name == "resilient"


def test_the_step_of_mujoco_counts() -> None:
    """Steps of MuJoCo are its own, and a refusal names their key."""
    path, settings = find_scenario("paper"), ["plant.engine=mujoco", "plant.mujoco.step_s=1e-9"]
    with pytest.raises(
        ScenarioError, match="integration steps per sampling period, got 50,000,000"
    ) as caught:
        read_scenario(path, settings)
    assert str(caught.value).startswith("--set plant.mujoco.step_s=1e-9: ")
    assert size_of(read_scenario(path, settings[:1])).plant_steps == 10
    assert size_of(read_scenario(path)).plant_steps == 5


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        ("plant.noise.position_m=1e308", "expected a magnitude of at most 10000, got 1e+308"),
        (
            "links.override=[{delay_s=1e300}]",
            "links.override.1.delay_s: expected a magnitude of at most 10",
        ),
        ("plant.step_s=1e-11", "expected a magnitude of at least 1e-09, got 1e-11"),
        (
            "controller.weights.moments=[1e-2,1e-300,1e-2]",
            "weights.moments.2: expected a magnitude of at least 1e-12",
        ),
        (
            "system.payload.inertia_kgm2=[[1e99,0,0],[0,1,0],[0,0,1]]",
            "inertia_kgm2.1.1: expected a magnitude",
        ),
        ("controller.sampling_period_s=1e-7", "expected a magnitude of at least 1e-05"),
    ],
)
def test_magnitudes_that_no_float_survives_are_refused_by_name(setting: str, text: str) -> None:
    """A number far beyond anything physical is refused by its field, with `allow_large` too."""
    with pytest.raises(ScenarioError) as caught:
        read_scenario(find_scenario("resilient"), [setting], allow_large=True)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)
