"""Extreme scenarios: refused with the reason and the numbers, or simulated to a defined outcome."""

import pytest

from tests.support.runs import SCENARIOS, SHORT, SINGLE_UAV, ready, ticks
from transport.flight.memory import simulate
from transport.protocol.scenario.scenario_file import ScenarioError, read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.team_of_any_size import Team, resized
from transport.protocol.wire.messages import Control

LIGHT = "system.payload={{mass_kg={0},inertia_kgm2=[{1},{1},{1}]}}"


def flown(name: str, *given: str) -> Control:
    """Return the outcome of a ready scenario with some settings, simulated in memory."""
    return simulate(ready(name, *given))


def refusal(name: str, *given: str) -> str:
    """Return the one-line error for a ready scenario with some settings."""
    with pytest.raises(ScenarioError) as caught:
        ready(name, *given)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def phase(duration_s: float, x: float, z: float = 0.0) -> str:
    """Setting: one straight way."""
    return (
        f"maneuver.phase=[{{name='dash',duration_s={duration_s},displacement_m=[{x!r},0.0,{z!r}]}}]"
    )


def test_one_uav() -> None:
    """N = 1 runs with open-loop prediction only.

    No control law can turn a payload about its single rod.
    """
    assert flown("paper", SHORT, *SINGLE_UAV).outcome == "completed"
    text = refusal("resilient", SHORT, *SINGLE_UAV)
    assert (
        "controller.prediction: expected a team that linear feedback can stabilise about hover, got a Riccati"
        in text
    )


@pytest.mark.slow
def test_sixteen_uavs() -> None:
    """N = 16, each its own agent, made as `transport scenario new` makes it."""
    path = SCENARIOS / "resilient.toml"
    scenario = resized(read_scenario(path, [ticks(10)]), Team(uavs=16), path.name)
    run = Setup.of(scenario, path.name)
    assert (run.system.N, len(run.agents)) == (16, 16)
    assert simulate(run).outcome == "completed"


@pytest.mark.parametrize("name", ["paper", "resilient"])
def test_a_payload_far_lighter_than_the_uavs(name: str) -> None:
    """A payload of 100 g below four UAVs of 1.5 kg each completes like any other."""
    assert flown(name, SHORT, LIGHT.format(0.1, 0.02)).outcome == "completed"


@pytest.mark.parametrize(
    "given", [("controller.horizon=60",), ("maneuver.phase.1.duration_s=0.05",)]
)
def test_horizon_longer_than_the_maneuver(given: tuple[str, ...]) -> None:
    """Horizons two and forty times longer than the maneuver complete.

    The reference holds the end of the path.
    """
    assert flown("resilient", SHORT, *given).outcome == "completed"


UNREACHABLE = [(200.0, 0.0), (0.0, -200.0), (0.0, 200.0), (9e4, 0.0)]


@pytest.mark.parametrize(("x", "z"), UNREACHABLE)
def test_way_points_no_vehicle_reaches(x: float, z: float) -> None:
    """Runs along paths of 100 m/s and more diverge at the error bound, with the numbers."""
    end = simulate(ready("resilient", phase(2.0, x, z)))
    assert (end.outcome, end.exit_code) == ("diverged", 6)
    assert "payload position error of" in end.reason
    assert "m exceeds 20 m at t = " in end.reason


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (
            phase(1.0, 9e5),
            "phase.1.displacement_m.1: expected a magnitude of at most 100000, got 900000",
        ),
        (
            phase(1.0, 1e300),
            "phase.1.displacement_m.1: expected a magnitude of at most 100000, got 1e+300",
        ),
        (
            "maneuver.start_m=[0,2e6,0]",
            "maneuver.start_m.2: expected a magnitude of at most 1e+06, got 2e+06",
        ),
    ],
)
def test_paths_out_of_this_world(given: str, text: str) -> None:
    """Positions outside the range of measurements are refused before any process starts."""
    assert text in refusal("paper", given)


def test_uavs_too_close_at_the_start() -> None:
    """A start that violates the smallest distance is refused with both distances and the pair."""
    text = refusal(
        "paper", "system.uav.2.rho_m=[0.25,-0.1,-0.125]", "system.uav.1.rho_m=[0.25,0.1,-0.125]"
    )
    assert (
        "separation.minimum_m: expected at most 0.200 m (UAV1 and UAV2 at hover), got 0.4" in text
    )
