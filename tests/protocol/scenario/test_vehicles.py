"""Vehicle files: ready ones, errors, and the scenarios made of them."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

import transport
from transport.cli.main import app
from transport.mpc.margins.sampled_loop import margins
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.teams.team_of_any_size import read_vehicle
from transport.report.laws import team_loops

READY = {"crazyflie": 0.02, "x500": 3.0, "racing": None}
# A hover, and a leg in all directions.
SHORT = [
    {"name": "hover", "duration_s": 0.5, "displacement_m": [0.0, 0.0, 0.0]},
    {"name": "leg", "duration_s": 2.0, "displacement_m": [0.5, 0.4, -0.4]},
]
# Largest error of a UAV on the leg, m, and payload attitude, deg.
NEAR_M, LEVEL_DEG = 0.15, 2.0


@pytest.mark.parametrize(
    "vehicle", ["x500", "racing", pytest.param("crazyflie", marks=pytest.mark.slow)]
)
def test_ready_vehicles_fly(vehicle: str) -> None:
    """Each vehicle carries its load on a short leg, with its motors and rotors, within its limits."""
    scenario = transport.Scenario("resilient").resized(3, vehicle=vehicle, load_kg=READY[vehicle])
    run = transport.fly(scenario, phases=SHORT, progress=False)
    assert run.outcome == "completed"
    assert run.summary["uav_tracking"]["max_m"] < NEAR_M
    assert run.summary["attitude_max_deg"] < LEVEL_DEG
    assert scenario.plant.motors.lag_s > 0.0
    # Rotor drag over mass: Faessler, Franchi, Scaramuzza 2018 identified 0.3 to 0.5 1/s.
    across_per_s = scenario.system.uav[0].drag_kgps[0] / scenario.system.uav[0].mass_kg
    assert 0.1 < across_per_s < 0.5
    assert scenario.system.payload.mass_kg == pytest.approx(
        READY[vehicle] or 1.5 * scenario.system.uav[0].mass_kg
    )


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", READY)
def test_motors_are_within_the_margin(vehicle: str) -> None:
    """The hover of each ready vehicle is stable with the motors of its file, known to its controllers or not."""
    scenario = transport.Scenario("resilient").resized(3, vehicle=vehicle, load_kg=READY[vehicle])
    for loop in team_loops(scenario.setup, ()).values():
        lag = margins(loop, ["lag_s"])["lag_s"]
        assert lag.upper is not None
        assert (lag.lower or 0.0) < scenario.plant.motors.lag_s < lag.upper


def test_the_command_writes_a_scenario(tmp_path: Path) -> None:
    """The file that the command writes is the scenario of the Python interface."""
    out = tmp_path / "four.toml"
    arguments = [
        "scenario",
        "new",
        "--uavs",
        "4",
        "--vehicle",
        "x500",
        "--load",
        "3.0",
        "--out",
        str(out),
    ]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    made = transport.Scenario("resilient").resized(4, vehicle="x500", load_kg=3.0)
    assert transport.Scenario(out).digest() == made.digest()
    assert made.validated.name == "resilient-x500-4"


def test_a_vehicle_file_has_its_autopilot(tmp_path: Path) -> None:
    """Thrust at full throttle, time-outs and parameters, such as its gains, come into the scenario."""
    file = tmp_path / "own.toml"
    text = (Path(__file__).resolve().parents[3] / "vehicles" / "x500.toml").read_text()
    own = "[vehicles]\nthrust_N = 34.2\nsetpoint_timeout_s = 0.3\n"
    curve = "parameters = {MOT_BAT_VOLT_MAX = 16.8, MOT_BAT_VOLT_MIN = 13.2, ATC_RAT_RLL_P = 0.1}\n"
    file.write_text(text + own + curve)
    made = transport.Scenario("flight").resized(4, vehicle=str(file), load_kg=3.0)
    vehicles = made.validated.vehicles
    assert (vehicles.thrust_N, vehicles.setpoint_timeout_s) == (34.2, 0.3)
    assert vehicles.parameters["MOT_BAT_VOLT_MIN"] == 13.2
    # In a scenario without vehicles they wait for one that has them.
    assert (
        transport.Scenario("resilient").resized(4, vehicle=str(file)).validated.vehicles == vehicles
    )
    file.write_text(text + "[vehicles]\nthrust = 34.2\n")
    with pytest.raises(ScenarioError, match=r"own\.toml: vehicles\.thrust: unknown key"):
        transport.Scenario("flight").resized(4, vehicle=str(file))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("name = 'a'", "uav: expected a value, got nothing"),
        ("name = 'a'\nuav = {mass = 1.0}", "uav.mass: unknown key; did you mean 'mass_kg'?"),
        ("name =", "not valid TOML"),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, text: str, problem: str) -> None:
    """Errors of a vehicle file name file and field."""
    file = tmp_path / "own.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"own\.toml") as error:
        read_vehicle(str(file))
    assert problem in str(error.value)


def test_wrong_arguments_are_refused() -> None:
    """An unknown vehicle names the ready ones; a load is positive, and one that the UAVs can lift."""
    with pytest.raises(
        ScenarioError, match="expected a vehicle file or the name of a ready one; known: crazyflie"
    ):
        read_vehicle("bumblebee")
    with pytest.raises(
        ScenarioError, match=r"system\.payload\.mass_kg: expected greater than 0, got -1"
    ):
        transport.Scenario("resilient").resized(4, load_kg=-1.0)
    with pytest.raises(ScenarioError, match="hover thrust"):
        transport.Scenario("resilient").resized(4, vehicle="x500", load_kg=9.0)
    assert CliRunner().invoke(app, ["scenario", "new", "--uavs", "4", "--load", "0"]).exit_code == 2


def test_errors_name_the_source_of_the_value(tmp_path: Path) -> None:
    """A value keeps its source when files are merged, and in later changes of the scenario."""
    file = tmp_path / "own.toml"
    uav = "{mass_kg=1.2,inertia_kgm2=[0.01,0.01,0.02],rod_length_m=2.0,spacing_m=%g}"
    keys = "controller.limits.thrust_N=[0.0,30.0]\ncontroller.separation.minimum_m=%g"
    template = transport.Scenario("resilient")

    file.write_text(f"name='own'\nuav={uav % 0.8}\n{keys % 0.9}", encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"own\.toml: controller\.separation\.minimum_m: "):
        template.resized(4, vehicle=file, load_kg=2.0)

    file.write_text(f"name='own'\nuav={uav % 0.8}\n{keys % 0.7}", encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"^load_kg=40: controller\.limits\.thrust_N: .*hover"):
        template.resized(4, vehicle=file, load_kg=40.0)

    made = template.resized(4, vehicle=file, load_kg=2.0)
    changed = (
        r"own\.toml with system\.payload\.mass_kg=40\.0: controller\.limits\.thrust_N: .*hover"
    )
    with pytest.raises(ScenarioError, match=changed):
        made.system.payload.mass_kg = 40.0
