"""Wrong scenarios: one line each, with file, field, what was expected and what came."""

import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import hypothesis
import pytest
from hypothesis import given
from pydantic import create_model
from pydantic.fields import FieldInfo

from tests.support import drawn_settings
from tests.support.drawn_settings import KEYS, choices, setting_of
from tests.support.runs import PAPER
from transport.model.section import Section
from transport.protocol.scenario.scenario_file import ScenarioError, find_scenario, read_scenario
from transport.protocol.scenario.sections.scenario_errors import PythonSetting, hint
from transport.protocol.scenario.sections.scenario_keys import (
    ending_of,
    key_of,
    out_of_range,
    section_in,
)
from transport.protocol.scenario.setup.run_setup import Setup

ONE_UAV_ASIDE = (
    "system.uav=[{id=1,mass_kg=1.5,inertia_kgm2=[0.029,0.029,0.055],rho_m=[0.25,0,-0.1],rod_length_m=3}]",
    "agents.owned=[[1]]",
)

# A setting is repeated in the refusal as far as that fits a line.
LONGEST_SHOWN = 80
LONGEST = 500  # of a refusal, letters

ENDS = "expected one of plant, agent1, agent2, agent3, agent4, got "
GROUND = ("plant.engine=mujoco", "plant.ground_m=0.0")
SENSED = (
    "plant.sensors=vehicle",
    "controller.estimator=kalman",
    "controller.prediction=closed_loop",
)
REALTIME = "clock.mode=realtime"
ON_CHANGE = (
    "controller.prediction=closed_loop",
    "controller.received_plans=by_age",
    "controller.share=on_change",
)

# Settings, and the text that must follow: the field first where it is not the key of the first
# setting. What every key refuses is below: types, bounds, choices, milliseconds.
WRONG: list[tuple[str | tuple[str, ...], str]] = [
    # Milliseconds for seconds.
    ("links.delay_s=50", "expected seconds, at most 10, got 50: did you mean 0.05?"),
    ("links.delay_s=20000", "expected a magnitude of at most 10, got 20000"),
    (
        "links.override=[{from='agent1',reorder_s=120}]",
        "links.override.1.reorder_s: expected seconds, at most 10, got 120: did you mean 0.12?",
    ),
    (
        "links.trace=[[0,50],[1,20]]",
        "row 1: expected seconds, at most 10, got 50: did you mean 0.05?",
    ),
    (
        "controller.rate_time_constant_s=[40,40,40]",
        "controller.rate_time_constant_s.1: expected seconds, at most 2, got 40: did you mean 0.04?",
    ),
    (
        "radio={computation_mean_s=5}",
        "radio.computation_mean_s: expected seconds, at most 2, got 5: did you mean 0.005?",
    ),
    # Keys.
    ("links.samples=[0.1]", "unknown key; it is now 'samples_s'"),
    ("controller.horizn=20", "unknown key; did you mean 'horizon'?"),
    ("system.uav.2.mas_kg=1", "unknown key; did you mean 'mass_kg'?"),
    ("sytem.payload.mass_kg=1", "sytem: unknown key; did you mean 'system'?"),
    ("shema=1", "unknown key; did you mean 'schema'?"),
    ("zzz=1", "unknown key; known: schema, name, seed, system, "),
    (
        "controller.separation={minimum=1}",
        "controller.separation.minimum: unknown key; did you mean",
    ),
    # Short names of Python, which are those of the whole scenario.
    ("wind_mps=[1,0,0]", "unknown key; did you mean 'plant.wind.speed_mps'?"),
    ("plant.wind_mps=[1,0,0]", "unknown key; did you mean 'wind'?"),
    (
        "maneuver.phase=[{name='hover',duration_s=1}]",
        "maneuver.phase.1.displacement_m: expected a value, got nothing",
    ),
    (
        "controller.separation={penalty=1}",
        "controller.separation.minimum_m: expected a value, got nothing",
    ),
    # Types.
    ("controller.horizon=2.5", "expected a valid integer, got 2.5"),
    ("controller.horizon=true", "expected a valid integer, got True"),
    ("controller.sampling_period_s=0.05s", "expected a number in s, got '0.05s'"),
    ("controller.sampling_period_s=[1]", "expected a number in s, got [1]"),
    ("links.loss='x'", "expected a number, got 'x'"),
    ("name=3", "expected text, got 3"),
    ("plant=3", "expected a section with keys, got 3"),
    ("plant.uav.id=1", "plant.uav: expected a valid list, got {'id': 1}"),
    ("maneuver.start_m=[0,inf,0]", "maneuver.start_m.2: expected a finite number, got inf"),
    (
        "controller.constraint=[{expression='r0[2]<=1',soft=1}]",
        "controller.constraint.1.soft: expected a valid boolean, got 1",
    ),
    # Shapes.
    ("maneuver.start_m=[0,0]", "expected 3 numbers, got [0, 0]"),
    ("controller.weights.moments=1", "expected a list, got 1"),
    ("controller.limits.thrust_N=[1]", "expected a list of at least 2, got [1]"),
    ("controller.limits.thrust_N=[1,2,3]", "expected a list of at most 2, got [1, 2, 3]"),
    ("maneuver.phase=[]", "expected a list of at least 1, got []"),
    (
        "system.payload.inertia_kgm2=[1,1]",
        "expected 3 principal moments or 3 rows of 3 numbers, got [1.0, 1.0]",
    ),
    ("system.payload.inertia_kgm2=[[1,0,0],[0,1]]", "expected 3 principal moments or 3 rows"),
    ("system.payload.inertia_kgm2=x", "expected a valid list, got 'x'"),
    # Ranges.
    ("controller.horizon=0", "expected greater than or equal to 1, got 0"),
    # Per cent for a share; a relaxation is none.
    ("links.loss=2", "expected a share, at most 1, got 2: did you mean 0.02?"),
    ("links.loss=1.9", "expected less than or equal to 1, got 1.9"),
    ("links.loss=100", "expected a share, at most 1, got 100: did you mean 1?"),
    ("links.loss=101", "expected less than or equal to 1, got 101"),
    ("controller.relaxation=2", "expected less than or equal to 1, got 2"),
    (
        "plant.uav=[{id=1,thrust_factor=20}]",
        "plant.uav.1.thrust_factor: expected less than or equal to 10, got 20",
    ),
    (
        "controller.weights.moments=[1,1,-1]",
        "controller.weights.moments.3: expected greater than 0, got -1",
    ),
    ("plant.max_attitude_deg=90", "expected less than 90, got 90"),
    # Choices.
    ("maneuver.profile=zigzag", "expected 'ramp', 'min_jerk', 'step' or 'smooth', got 'zigzag'"),
    ("name='a b'", "should match pattern '^[A-Za-z0-9_-]{1,40}$', got 'a b'"),
    # Relations.
    (
        "agents.owned=[[1],[1],[2,3],[4]]",
        "expected each UAV of [1, 2, 3, 4] once, got [1, 1, 2, 3, 4]",
    ),
    ("agents.owned=[[1,2],[3]]", "expected each UAV of [1, 2, 3, 4] once, got [1, 2, 3]"),
    ("agents.owned=[[1,5],[2,3,4]]", "expected each UAV of [1, 2, 3, 4] once, got [1, 2, 3, 4, 5]"),
    (
        "agents.owned=[[1,2,3,4],[]]",
        "agents.owned.2: expected a list of at least 1, got []",
    ),
    ("system.uav.1.id=2", "system.uav.id: expected 1, 2, ... 4 in order, got [2, 2, 3, 4]"),
    ("controller.limits.thrust_N=[5,1]", "expected smallest < largest, got [5, 1]"),
    # Links.
    ("links.delay=0.1", "unknown key; did you mean 'delay_s'?"),
    (
        "links.distribution=empirical",
        "links: samples_s: expected measured delays beside empirical, got nothing",
    ),
    ("links.actuation.from=plant", "unknown key; known: delay_s"),
    (
        "links.gilbert_elliott={enter=0.1}",
        "links.gilbert_elliott.leave: expected a value, got nothing",
    ),
    ("links.override=[{to='agent5'}]", f"links.override.1.to: {ENDS}'agent5'"),
    (
        "links.override=[{distribution='empirical'}]",
        "links.override.1: samples_s: expected measured delays",
    ),
    (
        "links.partition=[{between=['agent1'],start_s=2,end_s=2}]",
        "links.partition.1.end_s: start_s 2.0, got 2.0",
    ),
    (
        "links.partition=[{between=['x'],start_s=1,end_s=2}]",
        f"links.partition.1.between: {ENDS}'x'",
    ),
    (
        "links.partition=[{between=['agent4','agent2','agent1','agent3'],start_s=1,end_s=2}]",
        "links.partition.1.between: expected some of the agents (no message at all: ",
    ),
    ("links.change=[{loss=0.1}]", "links.change.1.at_s: expected a value, got nothing"),
    ("links.change=[{at_s=1,from='agent0'}]", f"links.change.1.from: {ENDS}'agent0'"),
    # Clock.
    (("clock.speed=0", REALTIME), "expected a number > 0 with mode realtime, such as 1, got 0"),
    (
        ("clock.actuation=immediate", REALTIME, "clock.speed=1"),
        "expected 'next_tick' with mode realtime, where a step takes time, got 'immediate'",
    ),
    (
        ("controller.negotiation_iterations=2", REALTIME, "clock.speed=1"),
        "expected 1 with clock.mode = 'realtime', got 2",
    ),
    # Sharing.
    (
        ("controller.share=on_change",),
        "controller.prediction: expected 'closed_loop' with controller.share = 'on_change', got 'open_loop'",
    ),
    (
        ("controller.prediction=closed_loop", "controller.share=on_change"),
        "controller.received_plans: expected 'by_age' with controller.share = 'on_change', got 'by_one'",
    ),
    (
        ("controller.received_states=as_received", *ON_CHANGE),
        "expected 'predicted' with controller.share = 'on_change', got 'as_received'",
    ),
    (
        ("controller.negotiation_iterations=2", *ON_CHANGE),
        "expected 1 with controller.share = 'on_change', got 2",
    ),
    # Sensors of the vehicles.
    (
        "plant.sensors=vehicle",
        "plant.sensors: expected 'state' with controller.estimator = 'measured', got 'vehicle'",
    ),
    (
        ("controller.estimator=kalman", "plant.sensors=vehicle"),
        "controller.prediction: expected 'closed_loop' with controller.estimator = 'kalman', got 'open_loop'",
    ),
    # Controllers of agents.
    (
        'agents.controller=["mpc","mpc"]',
        "expected one for each of 4 agents, or one name for all, got a list of 2",
    ),
    (
        'agents.controller=["mpc","mpc","mpc","nope"]',
        "expected 'mpc', 'alone' or 'package.module:Class', got 'nope'",
    ),
    (
        ("controller.negotiation_iterations=2", 'agents.controller=["mpc","mpc","mpc","alone"]'),
        "controller.negotiation_iterations: expected 1 with agents.controller",
    ),
    # Faults.
    ("faults.event=[{at_s=1,do='kill'}]", "faults.event.1.target: expected a value, got nothing"),
    (
        "faults.event=[{at_s=1,do='stab',target='plant'}]",
        "faults.event.1.do: 'sensors_off' or 'load', got 'stab'",
    ),
    (
        "faults.event=[{at_s=1,do='kill',target='agent5'}]",
        "faults.event.1.target: expected one of coordinator, plant, agent1, agent2, agent3, agent4, got 'agent5'",
    ),
    (
        "faults.event=[{at_s=1,do='restart',target='plant'}]",
        "faults.event.1.target: expected one of agent1, agent2, agent3, agent4, got 'plant'",
    ),
    (
        "faults.event=[{at_s=1,do='continue',target='agent1'}]",
        "faults.event.1.do: expected an action possible for agent1 after its start, got 'continue'",
    ),
    (
        "faults.event=[{at_s=2,do='continue',target='agent1'},{at_s=1,do='kill',target='agent1'}]",
        "faults.event.1.do: expected an action possible for agent1 after its kill, got 'continue'",
    ),
    (
        "faults.event=[{at_s=1,do='kill',target='agent1'},{at_s=2,do='stop',target='agent1'}]",
        "faults.event.2.do: expected an action possible for agent1 after its kill, got 'stop'",
    ),
    (
        "faults.event=[{at_s=1,do='motor_off',target='agent3'}]",
        "faults.event.1.target: expected one of uav1, uav2, uav3, uav4, got 'agent3'",
    ),
    (
        "faults.event=[{at_s=1,do='kill',target='uav3'}]",
        "faults.event.1.target: expected one of coordinator, ",
    ),
    (
        "faults.event=[{at_s=1,do='release',target='uav3'},{at_s=2,do='motor_off',target='uav3'}]",
        "faults.event.2.do: expected an action possible for uav3 after its release, got 'motor_off'",
    ),
    (
        "faults.event=[{at_s=1,do='release',target='uav1'},{at_s=1,do='release',target='uav2'},"
        "{at_s=1,do='release',target='uav3'},{at_s=1,do='motor_off',target='uav4'}]",
        "expected at least one UAV that keeps its motors, got motor_off or release for all 4",
    ),
    # On the ground.
    ("maneuver.phase.1.kind=land", "expected plant.ground_m with it, got 'land' without a ground"),
    (
        "maneuver.phase.2.points_m=[[1.0,0.0,0.0]]",
        "expected it only with kind 'spline', got kind 'move'",
    ),
    ("maneuver.phase.2.times_s=[1.0]", "expected it only with kind 'spline', got kind 'move'"),
    (
        ("maneuver.phase.1.kind=land", *GROUND),
        "maneuver.phase.1.displacement_m: straight down, positive z, got [0.0, 0.0, 0.0]",
    ),
    (
        ("maneuver.phase.2.kind=take_off", *GROUND),
        "maneuver.phase.2: expected a take-off from z = -0.125 m, where the payload stands on the ground, got -10",
    ),
    (
        ("maneuver.phase.4.kind=land", *GROUND),
        "maneuver.phase.4: expected a landing at z = -0.125 m, where the payload stands on the ground, got -10",
    ),
    (
        ("plant.engine=mujoco", "plant.ground_m=-12.0"),
        "maneuver.start_m: expected a start above z = -12.125 m, where the payload stands on the ground, got -10",
    ),
    (
        ("maneuver.phase.4.displacement_m=[0.0,0.0,20.0]", *GROUND),
        "maneuver.phase.4: expected a path above z = -0.125 m, where the payload stands on the ground, got 7.5",
    ),
    # Motors.
    (
        "faults.event=[{at_s=1,do='degrade',target='uav3'}]",
        "faults.event.1.efficiency: expected an efficiency with 'degrade', got nothing",
    ),
    (
        "faults.event=[{at_s=1,do='motor_off',target='uav3',efficiency=0.5}]",
        "faults.event.1.efficiency: expected no efficiency without 'degrade', got 0.5",
    ),
    (
        ("faults.event=[{at_s=1,do='sensors_off',target='uav3'}]", *SENSED),
        "faults.event.1.sensors: expected sensors with 'sensors_off', got nothing",
    ),
    (
        "faults.event=[{at_s=1,do='sensors_off',target='uav3',sensors=['position']}]",
        "faults.event.1.do: expected plant.sensors = 'vehicle' with 'sensors_off', got 'state'",
    ),
    (
        "faults.event=[{at_s=1,do='sensors_off',target='uav3',sensors=['height']}]",
        "'attitude', 'rate' or 'specific_force', got 'height'",
    ),
    (
        "faults.event=[{at_s=1,do='kill',target='agent3',duration_s=2}]",
        "faults.event.1.duration_s: expected no value without 'sensors_off' or 'load', got 2.0",
    ),
    (
        "faults.event=[{at_s=1,do='load',target='uav1',mass_kg=2}]",
        "faults.event.1.target: expected one of payload, got 'uav1'",
    ),
    (
        "faults.event=[{at_s=1,do='load',target='payload'}]",
        "faults.event.1.do: expected mass_kg, inertia_kgm2, centre_m or some of them with 'load', got none",
    ),
    (
        "faults.event=[{at_s=1,do='kill',target='agent1',centre_m=[0,0,0]}]",
        "faults.event.1.centre_m: expected no centre_m without 'load', got (0.0, 0.0, 0.0)",
    ),
    (
        "faults.event=[{at_s=1,do='load',target='payload',inertia_kgm2=[1,1,3]}]",
        "faults.event.1.inertia_kgm2: expected the inertia of a body, got payload inertia: no body has",
    ),
    ("plant.uav=[{id=7}]", "plant.uav.1.id: expected each at most once of [1, 2, 3, 4], got 7"),
    (
        "plant.uav=[{id=2},{id=2}]",
        "plant.uav.2.id: expected each at most once of [1, 2, 3, 4], got 2",
    ),
    ("controller.tension.minimum_N=8", "expected less than 7.36 N (rod of UAV1 at hover), got 8"),
    (
        ("controller.motor_lag_s=0.05", "controller.tension.minimum_N=2"),
        "expected 0.0 with [controller.tension], got 0.05",
    ),
    (
        "plant.motors.falling_lag_s=0.02",
        "expected lag_s > 0 and rotors with it, got lag_s 0, no rotors",
    ),
    (
        "plant.motors.lag_s=1e-4",
        "expected 0 or at least a hundredth of the sampling period, 0.0005, got 0.0001",
    ),
    (
        "controller.motor_lag_s=1e-4",
        "expected 0 or at least a hundredth of the sampling period, 0.0005, got 0.0001",
    ),
    (
        "plant.motors.rotors={arm_m=0.2,drag_to_thrust_m=0.02,thrust_N=[5.0,5.0]}",
        "plant.motors.rotors.thrust_N: expected smallest < largest, got [5.0, 5.0]",
    ),
    (
        "plant.motors.rotors={arm_m=0.2,drag_to_thrust_m=0.02,thrust_N=[0.0,5.0]}",
        "plant.motors.rotors.thrust_N: expected a range that contains a quarter of the hover thrust "
        "5.52 N of UAV1, got [0.0, 5.0]",
    ),
    # The truth, and what is to be estimated of it.
    (
        ("plant.wind.drag_uav_kgps=31", "plant.wind.gust_mps=[1,1,1]"),
        "expected at most mass over sampling period 30, got 31",
    ),
    (
        ("plant.wind.drag_payload_kgps=61", "plant.wind.gust_mps=[1,1,1]"),
        "expected at most mass over sampling period 60",
    ),
    (
        ("plant.wind.drag_uav_kgps=0.3", "system.payload.drag_kgps=0.5"),
        "plant.wind.drag_uav_kgps: expected no value with drag_kgps of payload or UAVs in [system]; "
        "plant.drag_factor and controller.knows_drag change it, got 0.3",
    ),
    ("system.uav.1.drag_kgps=[0.3]", "expected a list of at least 2, got [0.3]"),
    # Physics.
    (
        "controller.limits.thrust_N=[0,20]",
        "expected a range that contains the hover thrust 22.07 N of UAV1, got [0.0, 20.0]",
    ),
    (
        "controller.separation.minimum_m=0.501",
        "expected at most 0.500 m (UAV1 and UAV2 at hover), got 0.501",
    ),
    (
        "system.payload.inertia_kgm2=[1,1,3]",
        "system.payload: no body has principal moments [1.0, 1.0, 3.0] kg m^2: the largest exceeds the sum",
    ),
    (
        "system.uav.2.inertia_kgm2=[1,1,-1]",
        "system.uav.2: expected positive principal moments, got [-1.0, 1.0, 1.0]",
    ),
    (
        "system.payload.inertia_kgm2=[[1,0,0],[1,1,0],[0,0,1]]",
        "system.payload: expected a symmetric matrix, got [[1.0, ",
    ),
    (ONE_UAV_ASIDE, "system.uav: no hover equilibrium: rods at [[0.25, 0.0, -0.1]] m"),
    # Constraints.
    ("controller.constraint=[{expression='r9[2] <= 1'}]", "unknown name 'r9'; known: Omega1"),
    ("controller.constraint=[{expression='r0[2] <='}]", "constraint 'r0[2] <=': cannot be read"),
    ("controller.constraint=[{expression='r0 <= 1'}]", "expected a scalar, got shape (3, 1)"),
    (
        "controller.constraint=[{expression='thrust1 <= r0[0]'}]",
        "expected states or inputs, got both",
    ),
    ("controller.constraint=[{expression='__import__(1) <= 1'}]", "unknown function '__import__'"),
    # Terms of the cost.
    ("controller.cost=[{expression='v9',weight=1}]", "cost 'v9': unknown name 'v9'; known: Omega1"),
    ("controller.cost=[{expression='v0[0] -',weight=1}]", "cost 'v0[0] -': cannot be read"),
    ("controller.cost=[{expression='v0',weight=1}]", "expected a scalar, got shape (3, 1)"),
    ("controller.cost=[{expression='r0[2] <= 1',weight=1}]", "'r0[2] <= 1' is not allowed"),
    ("controller.cost=[{expression='thrust1',weight=1}]", "expected states alone"),
    ("controller.cost=[{expression='2 * pi',weight=1}]", "expected states alone"),
    (
        "controller.cost=[{expression='1 / v0[0]',weight=1}]",
        "cost '1 / v0[0]': expected a finite value and slope at hover, got the value inf",
    ),
]

EMPTY = "''"
WRONG_SETTINGS = [
    ("nope", "expected key=value"),
    ("=3", "expected key=value"),
    ("", "expected key=value"),
    ("maneuver.phase.9.duration_s=1", "expected an entry from 1 to 5, got '9'"),
    ("maneuver.phase.0.duration_s=1", "expected an entry from 1 to 5, got '0'"),
    ("maneuver.phase.-1.duration_s=1", "expected an entry from 1 to 5, got '-1'"),
    ("maneuver.phase.first.duration_s=1", "expected an entry from 1 to 5, got 'first'"),
    ("agents.owned.5=[1]", "expected an entry from 1 to 4, got '5'"),
    ("name.x=1", "expected 'name' to be a section, got the value 'paper'"),
    (
        "plant.wind.gust_mps.3=1.0",
        "expected a list that the file gives, got 'gust_mps' left out: set the whole list",
    ),
    ("controller.horizon.x.y=1", "expected 'horizon' to be a section, got the value 20"),
]


def refusal(path: Path, *settings: str) -> str:
    """Error text of a scenario, on reading or on building."""
    with pytest.raises(ScenarioError) as caught:
        Setup.of(read_scenario(path, settings), str(path))
    text = str(caught.value.blaming(settings))
    assert "\n" not in text
    return text


@pytest.mark.parametrize(("settings", "problem"), WRONG, ids=lambda value: str(value)[:50])
def test_wrong_scenario(settings: str | tuple[str, ...], problem: str) -> None:
    """An invalid value is refused before anything starts, in one line.

    It has setting or file, field, expected and got.
    """
    given = [settings] if isinstance(settings, str) else list(settings)
    text = refusal(PAPER, *given)
    key, shown = given[0].partition("=")[0], given[0]
    named = re.match(r"([\w.]+): ", problem)
    field, problem = (named[1], problem.removeprefix(named[0])) if named else (key, problem)
    if f"{key}.".startswith(f"{field}.") or f"{field}.".startswith(f"{key}."):
        # The setting says which field it is for, so that is repeated only when something else is
        # wrong.
        shown = shown if len(shown) <= LONGEST_SHOWN else f"{shown[: LONGEST_SHOWN - 3]}..."
        begin = f"--set {shown}: " + (f"{field}: " if key != field else "")
    else:
        begin = f"{PAPER}: {field}: "  # it does not go with what the file says, or does not
    assert text.startswith(begin)
    assert problem in text.removeprefix(begin)


@pytest.mark.parametrize(
    ("line", "wrong", "problem"),
    [
        (
            "horizon = 20",
            "horizon = 0",
            "controller.horizon: expected greater than or equal to 1, got 0",
        ),
        ("horizon = 20", "horizn = 20", "controller.horizn: unknown key; did you mean 'horizon'?"),
        ("mass_kg = 3.0", "", "system.payload.mass_kg: expected a value, got nothing"),
        (
            "[0.0, 45.0]",
            "[0.0, 20.0]",
            "controller.limits.thrust_N: expected a range that contains the hover thrust",
        ),
        # Only settings that ask for real time have its speed by themselves.
        (
            'mode = "lockstep"',
            'mode = "realtime"',
            "clock.speed: expected a number > 0 with mode realtime",
        ),
    ],
)
def test_wrong_file(line: str, wrong: str, problem: str, tmp_path: Path) -> None:
    """An error in the file names the file, with or without settings of other keys."""
    path = tmp_path / "wrong.toml"
    path.write_text(PAPER.read_text(encoding="utf-8").replace(line, wrong, 1), encoding="utf-8")
    for settings in ((), ("controller.solver=clarabel",)):
        assert refusal(path, *settings).startswith(f"{path}: {problem}")


def test_all_settings_of_a_field_are_blamed() -> None:
    """The error names all settings that gave its field or part of it."""
    thrusts = ["controller.limits.thrust_N.1=50", "controller.limits.thrust_N.2=40"]
    both = " ".join(f"--set {setting}" for setting in thrusts)
    assert refusal(PAPER, *thrusts).startswith(
        f"{both}: controller.limits.thrust_N: expected smallest < largest"
    )
    whole = ["agents.owned=[[1],[2],[3,4]]", "seed=1", "agents.owned.3=[4]"]
    last = f"--set {whole[0]} --set {whole[2]}: agents.owned: expected each UAV of [1, 2, 3, 4] once, got [1, 2, 4]"
    assert refusal(PAPER, *whole) == last
    two = "clock.mode=realtime", "clock=3"
    both = f"--set {two[0]} --set {two[1]}: clock: expected a section with keys, got 3"
    assert refusal(PAPER, *two) == both
    # A key that only begins with the same letters is another one.
    share = "controller.share=on_change", "controller.share_threshold=0.02"
    text = refusal(PAPER, *share, "agents.controller=own:Law", *ON_CHANGE[:2])
    assert text.startswith(f"--set {share[0]}: expected 'always'")


@pytest.mark.parametrize(
    ("name", "known", "text"),
    [
        ("ab", ["zz", "ac"], "did you mean 'ac'?"),  # half of the letters
        ("abc", ["axy", "zz"], "known: axy, zz"),  # a third
        ("samples", ["other", "samples_s"], "it is now 'samples_s'"),
        ("links.samples", ["links.samples_s"], "it is now 'links.samples_s'"),
        ("samples", ["zz"], "known: zz"),
        ("a", [], "known: none"),
    ],
)
def test_an_unknown_name_has_its_new_or_a_similar_one_else_all(
    name: str, known: list[str], text: str
) -> None:
    """A renamed key is told as such where the new one is known; what is less than half alike is not offered."""
    assert hint(name, known) == text


def test_a_value_of_python_is_named_without_an_option() -> None:
    """The error has the setting as it is written there, and tuples as lists of a file."""
    setting = PythonSetting("maneuver.start_m=(0, 0)")
    setting.value = (0, 0)
    assert refusal(PAPER, setting) == f"{setting}: expected 3 numbers, got [0, 0]"


def test_a_value_of_several_lines_makes_no_second_line() -> None:
    """The error is one line, whatever the setting has."""
    assert refusal(PAPER, "name=a\nb").startswith("--set name=a b: string should match pattern")


@pytest.mark.parametrize(("letters", "end"), [(75, "xxx: "), (76, "...: ")])
def test_a_long_setting_is_cut(letters: int, end: str) -> None:
    """Its first 80 characters are repeated, of a longer one 77 and three dots."""
    problem = "string should match pattern"
    repeated, _, _ = refusal(PAPER, "name=" + letters * "x").partition(problem)
    assert repeated == f"--set name={72 * 'x'}{end}"


def test_a_limit_that_hover_exceeds_blames_the_bodies() -> None:
    """Settings of masses are named beside the file of the limit; a setting of the limit alone."""
    heavy, limit = "system.payload.mass_kg=20", "controller.limits.thrust_N=[0,45]"
    problem = "expected a range that contains the hover thrust 63.76 N of UAV1, got [0.0, 45.0]"
    of_bodies = f"{PAPER} with --set {heavy}: controller.limits.thrust_N: {problem}"
    assert refusal(PAPER, heavy) == refusal(PAPER, "seed=3", heavy) == of_bodies
    assert refusal(PAPER, heavy, limit) == f"--set {limit}: {problem}"
    # A file that contradicts itself is named alone, whatever else is set.
    with pytest.raises(ScenarioError) as caught:
        Setup.of(read_scenario(PAPER, [heavy]), str(PAPER))
    assert caught.value.blaming(["seed=3"]) is caught.value


def test_costs_are_finite_along_the_reference() -> None:
    """A cost that has no value at a speed of a flat reference is refused before the run."""
    setting = "controller.cost=[{expression='sqrt(v0[0] + 3)',weight=1.0}]"
    expected = "expected a finite value and slope on the reference, got the value nan"
    problem = f"--set {setting}: cost 'sqrt(v0[0] + 3)': {expected}"
    assert refusal(find_scenario("eight"), setting) == problem
    Setup.of(read_scenario(PAPER, [setting]), str(PAPER))  # its law is about hover alone


def test_settings_that_contradict_the_cost_to_go() -> None:
    """The cost-to-go weighs deviations from hover.

    A preview without control law and cost-to-go has no effect.
    """
    penalised_input = refusal(
        PAPER, "controller.terminal=riccati", "controller.weights.penalised_input=absolute"
    )
    expected = "expected 'deviation' with controller.terminal = 'riccati', got 'absolute'"
    assert penalised_input == f"--set controller.weights.penalised_input=absolute: {expected}"
    alone = refusal(PAPER, "controller.preview=true")
    assert alone.startswith(
        "--set controller.preview=true: expected controller.prediction = 'closed_loop' or "
    )


OF_VEHICLES = "with plant.kind = 'vehicles' or plant.autopilot"
OUTSIDE = "plant.kind=vehicles"
GUSTS = "plant.wind.gust_mps=[1,1,1]"
RELEASE = "faults.event=[{at_s=1,do='release',target='uav1'}]"
ROTORS = "plant.motors.rotors={arm_m=0.2,drag_to_thrust_m=0.02,thrust_N"


@pytest.mark.parametrize(
    ("name", "settings", "expected"),
    [
        ("flight", "clock.mode=lockstep", f"'realtime' {OF_VEHICLES}, got 'lockstep'"),
        ("flight", "clock.on_overrun=hold", f"'continue' {OF_VEHICLES}, got 'hold'"),
        ("flight", "controller.inputs=moments", f"'rates' {OF_VEHICLES}, got 'moments'"),
        ("flight", "controller.fail_safe=level", f"'follow' {OF_VEHICLES}, got 'level'"),
        ("flight", "controller.silence=stop", f"'alone' or 'law' {OF_VEHICLES}, got 'stop'"),
        ("flight", "agents.owned=[[1,2],[3],[4]]", f"one UAV for each agent {OF_VEHICLES}, got"),
        ("flight", "agents.owned=[[2],[1],[3],[4]]", f"UAV i for agent i {OF_VEHICLES}, got"),
        (
            "flight",
            f"clock.on_agent_loss=abort {OUTSIDE}",
            "'continue' with plant.kind = 'vehicles'",
        ),
        ("flight", f"clock.on_coordinator_loss=end {OUTSIDE}", "'continue' with plant.kind ="),
        ("paper", "clock.on_coordinator_loss=continue", "'end' without plant.kind = 'vehicles' or"),
        ("paper", "plant.ground_m=0.0", "no value with plant.engine = 'rods', got 0.0"),
        (
            "paper",
            "plant.inner_loop=betaflight controller.inputs=rates clock.mode=realtime",
            "'model' with clock.mode = 'realtime', got 'betaflight'",
        ),
        (
            "paper",
            "plant.autopilot=stand_in plant.inner_loop=betaflight controller.inputs=rates",
            "no value with plant.inner_loop = 'betaflight', got 'stand_in'",
        ),
        (
            "paper",
            " ".join(["controller.share=on_change", "agents.controller=own:Law", *ON_CHANGE[:2]]),
            "'always' with agents.controller = 'own:Law', got 'on_change'",
        ),
        (
            "paper",
            f"controller.received_states=as_received {' '.join(SENSED)}",
            "'predicted' with controller.estimator = 'kalman', got 'as_received'",
        ),
        (
            "paper",
            " ".join(["controller.share=on_change", *SENSED, ON_CHANGE[1]]),
            "'always' with controller.estimator = 'kalman', got 'on_change'",
        ),
        (
            "paper",
            "plant.sensors=state controller.estimator=kalman",
            "'vehicle' with controller.estimator = 'kalman', got 'state'",
        ),
        ("flight", "plant.sensors=state controller.estimator=measured", f"'vehicle' {OF_VEHICLES}"),
        (
            "paper",
            "controller.inputs=moments plant.inner_loop=betaflight",
            "'rates' with plant.inner_loop = 'betaflight', got 'moments'",
        ),
        (
            "paper",
            "plant.mujoco.rod_mass_kg=0.01",
            "no value with plant.engine = 'rods', got M",
        ),
        (
            "paper",
            f"plant.mujoco.suspension=cables plant.engine=mujoco {RELEASE}",
            "'rods' with a fault 'release', got 'cables'",
        ),
        (
            "eight",
            "controller.prediction=open_loop controller.estimator=measured plant.sensors=state",
            "'closed_loop' with maneuver.reference = 'flat'",
        ),
        ("eight", "controller.linearisation=present", "'along' with maneuver.reference = 'flat'"),
        ("eight", "controller.terminal=multiple", "'riccati' with maneuver.reference = 'flat'"),
        ("eight", "controller.preview=false", "True with maneuver.reference = 'flat', got False"),
        ("eight", "controller.motor_lag_s=0.05", "0.0 with maneuver.reference = 'flat', got 0.05"),
        (
            "eight",
            "controller.constraint=[{expression='r0[2]<=1'}]",
            "no value with maneuver.reference = 'flat', got ",
        ),
        # Clocks of the agents, from that of the plant.
        (
            "paper",
            f"clock.offsets_s=[0,0,0,0.01] {REALTIME} clock.speed=1",
            "no value with clock.mode = 'realtime', got ",
        ),
        ("paper", "clock.offsets_s=[0,0]", "one for each of 4 agents, got 2"),
        (
            "paper",
            "clock.offsets_s=[0.05,0.05,0.05,0.05]",
            "clocks less than a sampling period (0.05 s)",
        ),
        (
            "paper",
            "clock.offsets_s=[-0.02,0,0,0.03]",
            "clocks less than a sampling period (0.05 s)",
        ),
        # Bodies that are lighter than the controllers assume are braked more by unknown drag.
        (
            "paper",
            f"plant.wind.drag_uav_kgps=15.1 {GUSTS} plant.uav=[{{id=2,mass_factor=0.5}}]",
            "at most mass over sampling period 15, got 15.1",
        ),
        (
            "paper",
            f"plant.wind.drag_uav_kgps=15.1 {GUSTS} plant.uav_mass_factor=0.5",
            "at most mass over sampling period 15, got 15.1",
        ),
        (
            "paper",
            f"plant.wind.drag_payload_kgps=30.1 {GUSTS} plant.payload_mass_factor=0.5",
            "at most mass over sampling period 30, got 30.1",
        ),
        (
            "paper",
            "plant.wind.drag_uav_kgps=0.3 system.uav.3.drag_kgps=[0.1,0]",
            "no value with drag_kgps of payload or UAVs in [system]",
        ),
        (
            "paper",
            f"plant.motors.falling_lag_s=1e-4 plant.motors.lag_s=0.01 {ROTORS}=[0,20]}}",
            "0 or at least a hundredth of the sampling period, 0.0005, got 0.0001",
        ),
        # Hover below a range.
        (
            "paper",
            "controller.limits.thrust_N=[25,45]",
            "a range that contains the hover thrust 22.07",
        ),
        (
            "paper",
            f"{ROTORS}=[5.6,20]}}",
            "a range that contains a quarter of the hover thrust 5.52",
        ),
    ],
)
def test_a_value_that_does_not_go_with_another_key(name: str, settings: str, expected: str) -> None:
    """The first setting is refused for the value of another key, which the refusal names."""
    given = settings.split()
    text = refusal(find_scenario(name), *given)
    assert text.startswith(f"--set {given[0]}: ")
    assert f": expected {expected}" in text


@pytest.mark.parametrize(
    "settings",
    [
        "clock.offsets_s=[-0.01,0,0,0.039]",
        f"plant.wind.drag_uav_kgps=30 {GUSTS}",
        "plant.motors.lag_s=0.0005",
        "controller.preview=true controller.terminal=riccati",
        "controller.preview=true controller.prediction=closed_loop",
        "plant.wind.drag_uav_kgps=0.3",
    ],
)
def test_a_value_that_just_goes_with_the_others_is_taken(settings: str) -> None:
    """The last ones before those that are refused above."""
    assert read_scenario(PAPER, settings.split()) != read_scenario(PAPER)


@pytest.mark.parametrize(("setting", "problem"), WRONG_SETTINGS)
def test_wrong_setting(setting: str, problem: str) -> None:
    """A setting that names no place in the scenario is refused on one line that repeats it."""
    assert refusal(PAPER, setting) == f"--set {setting or EMPTY}: {problem}"


@pytest.mark.parametrize(
    ("key", "problem"),
    [
        ("plant.motors.1.lag_s", "plant.motors.1: unknown key; known: lag_s, "),
        ("plant.foo.1.bar", "plant.foo: unknown key; known: kind, "),
        ("foo.1.bar", "foo: unknown key; known: schema, "),
        ("system.uav.1.foo.2.bar", "system.uav.1.foo: unknown key; known: id, "),
    ],
)
def test_a_number_below_what_is_no_list_is_an_unknown_key(key: str, problem: str) -> None:
    """Only a list may lack an entry; a section, and a key that does not exist, have other words."""
    assert refusal(PAPER, f"{key}=1").startswith(f"--set {key}=1: {problem}")


def test_a_number_of_thousands_of_digits_is_no_entry() -> None:
    """Python refuses to read it; it is refused like any other number of an entry."""
    text = refusal(PAPER, f"maneuver.phase.{'9' * 5000}.duration_s=1")
    assert text.endswith("expected an entry from 1 to 5, got '999999999'")


@pytest.mark.parametrize(
    "key", ["agents[1]", "float", "int", "str", "controller.weights.float", "agents.owned[1]"]
)
def test_unknown_key_of_any_name(key: str) -> None:
    """A key is unknown by any name, also one that looks like a type or an index."""
    assert refusal(PAPER, f"{key}=1").startswith(f"--set {key}=1: unknown key; ")


def test_a_scenario_is_found_by_its_path_or_as_a_ready_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A name is that of a file that is there, of one that should be by its form, or of a ready scenario."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own").touch()
    for path in ("own", "missing.toml", "folder/missing"):
        assert find_scenario(path) == Path(path)
    assert find_scenario("paper").samefile(PAPER)
    expected = "expected a scenario file or the name of a ready one"
    for name, text in (("papr", "did you mean 'paper'?"), ("zzz", "known: alone, centralized, ")):
        with pytest.raises(ScenarioError, match=f"^{name}: {expected}; {re.escape(text)}"):
            find_scenario(name)
    with pytest.raises(ScenarioError, match=expected):
        find_scenario("\0")


def test_missing_file(tmp_path: Path) -> None:
    """A file that is not there is named."""
    path = tmp_path / "none.toml"
    assert refusal(path) == f"{path}: no such file"


def test_unreadable_file(tmp_path: Path) -> None:
    """A folder in the file's place, or bytes that are no text, are refused with the reason."""
    assert refusal(tmp_path).startswith(f"{tmp_path}: cannot be read (")
    path = tmp_path / "binary.toml"
    path.write_bytes(b"\xff\xfe\x00name")
    assert refusal(path).startswith(f"{path}: not valid TOML: 'utf-8' codec")


@pytest.mark.parametrize(
    "content", ["name = ", "name = 'a'\nname = 'b'", "[system\n", "\0", "a" * 200]
)
def test_invalid_toml(content: str, tmp_path: Path) -> None:
    """A file that is no TOML is refused with the place in the file."""
    path = tmp_path / "bad.toml"
    path.write_text(content, encoding="utf-8")
    text = refusal(path)
    assert text.startswith(f"{path}: not valid TOML: ")
    assert "line 1" in text or "line 2" in text or "end of document" in text


@pytest.mark.parametrize("text", ["a = " + "[" * 5000, "a = " + "{b=" * 5000, "a = 1" + "0" * 5000])
def test_toml_that_the_parser_gives_up_on(text: str, tmp_path: Path) -> None:
    """Deep nesting and integers of thousands of digits are refused as invalid TOML, in files and settings."""
    path = tmp_path / "deep.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ScenarioError, match="not valid TOML"):
        read_scenario(path)
    with pytest.raises(ScenarioError):
        read_scenario(PAPER, [f"seed{text[1:]}"])


# Value and text of a refusal, for a key with the field of the schema; None where the kind does not apply.
Wrong = Callable[[str, FieldInfo], tuple[str, str] | None]


def _of_another_type(_: str, field: FieldInfo) -> tuple[str, str]:
    """A section for a value, a number for a section, a list of sections or a table."""
    has_keys = section_in(field.annotation) is not None or "dict" in str(field.annotation)
    return ("3" if has_keys else "{zzz=1}"), "expected "


def _unknown_key(_: str, field: FieldInfo) -> tuple[str, str] | None:
    section = section_in(field.annotation)
    if section is None:
        return None
    entries = "list" in str(field.annotation) or "tuple" in str(field.annotation)
    return ("[{zzz=1}]" if entries else "{zzz=1}"), "zzz: unknown key; known: "


def _no_choice(_: str, field: FieldInfo) -> tuple[str, str] | None:
    words = [word for word in choices(field.annotation) if isinstance(word, str)]
    return (
        ("'zzz'", f"'{words[-1]}', got 'zzz'")
        if get_origin(field.annotation) is Literal and words
        else None
    )


def _not_finite(_: str, field: FieldInfo) -> tuple[str, str] | None:
    return ("nan", "expected a finite number, got nan") if field.annotation is float else None


def _out_of_bounds(_: str, field: FieldInfo) -> tuple[str, str] | None:
    """Beyond the first bound of a number, which may be left out."""
    bounds, kind = list(field.metadata), field.annotation
    for inner in get_args(kind):
        if get_origin(inner) is Annotated and type(None) in get_args(field.annotation):
            kind, *more = get_args(inner)
            bounds += more
    if kind not in (int, float):
        return None
    limits = {
        sign: getattr(bound, sign)
        for bound in bounds
        for sign in ("gt", "ge", "lt", "le")
        if getattr(bound, sign, None) is not None
    }
    if not limits:
        return None
    sign, limit = next(iter(limits.items()))
    beyond = min(limit, 0) - 1 if sign in ("gt", "ge") else 2 * limit + 1
    return f"{beyond:g}", f"got {beyond:g}"


def _milliseconds(key: str, field: FieldInfo) -> tuple[str, str] | None:
    """A time above its range, which its key or its type has."""
    within = key_of(field).within
    bounds = [bound.le for bound in field.metadata if getattr(bound, "le", None) is not None]
    most = within[1] if within else min(bounds, default=math.inf)
    if ending_of(key) != "_s" or most > 60.0 or field.annotation is not float:
        return None
    return (
        f"{1e3 * most:g}",
        f"expected seconds, at most {most:g}, got {1e3 * most:g}: did you mean {most:g}?",
    )


KINDS: Mapping[
    str, tuple[Wrong, int]
] = {  # with the number of keys that have the kind: a bound that is lost is missed
    "type": (_of_another_type, 348),
    "unknown key": (_unknown_key, 44),
    "choice": (_no_choice, 39),
    "not finite": (_not_finite, 150),
    "bounds": (_out_of_bounds, 189),
    "milliseconds": (_milliseconds, 29),
}


@pytest.mark.parametrize(
    ("value", "within", "place", "problem"),
    [
        (0.0, (1.0, 2.0), "", ""),
        (1.0, (1.0, 2.0), "", ""),
        (-2.0, (1.0, 2.0), "", ""),
        (2.1, (1.0, 2.0), "", "expected seconds, at most 2, got 2.1: did you mean 0.0021?"),
        (-2.1, (1.0, 2.0), "", "expected a magnitude of at most 2, got -2.1"),
        (-0.9, (1.0, 2.0), "", "expected a magnitude of at least 1, got -0.9"),
        ([1.0, [1.5, 0.5]], (1.0, 2.0), ".2.2", "expected a magnitude of at least 1, got 0.5"),
        (10_000.0, (0.0, 10.0), "", "expected seconds, at most 10, got 10000: did you mean 10?"),
        (10_001.0, (0.0, 10.0), "", "expected a magnitude of at most 10, got 10001"),
        (61.0, (0.0, 60.0), "", "expected seconds, at most 60, got 61: did you mean 0.061?"),
        (62.0, (0.0, 61.0), "", "expected a magnitude of at most 61, got 62"),
        (
            [1.0, 20.0],
            (0.0, 10.0),
            ".2",
            "expected seconds, at most 10, got 20: did you mean 0.02?",
        ),
    ],
)
def test_a_number_has_a_magnitude_within_a_range(
    value: object, within: tuple[float, float], place: str, problem: str
) -> None:
    """Zero, and the ends, are within; times up to a minute that milliseconds explain have those words."""
    found = [(f"x_s{place}", problem)] if problem else []
    assert list(out_of_range(value, "x_s", within)) == found


@pytest.mark.parametrize(
    ("endings", "least", "most"),
    [
        ("_s _hz", 1e-9, 1e9),
        ("_m", 1e-12, 1e6),
        ("_mps _rad _rads", 1e-12, 1e4),
        ("_mps2", 1e-6, 1e4),
        ("_rads2", 1e-12, 1e6),
        ("_kg", 1e-9, 1e6),
        ("_kgm2", 1e-12, 1e9),
        ("_share _deg _kgps _N _N_s _Nm _Nm_s", 1e-12, 1e12),
    ],
)
def test_a_number_has_a_magnitude_within_that_of_its_unit(
    endings: str, least: float, most: float
) -> None:
    """Both ends are within, a hundredth beyond is not; the ending of the key tells the unit."""
    for ending in endings.split():
        field: Any = {f"x{ending}": (float, ...)}
        kind = create_model("Kind", __base__=Section, **field)
        found = {
            value: [text for _, text in out_of_range(kind.model_validate({f"x{ending}": value}))]
            for value in (least, most, 0.99 * least, -1.01 * most)
        }
        small = f"expected a magnitude of at least {least:g}, got {0.99 * least:g}"
        large = f"expected a magnitude of at most {most:g}, got {-1.01 * most:g}"
        assert found == {least: [], most: [], 0.99 * least: [small], -1.01 * most: [large]}


@pytest.mark.parametrize("kind", KINDS)
def test_each_key_refuses_what_is_wrong(kind: str) -> None:
    """A refusal names the key and what was expected of it, or another of its section that has to be there."""
    wrong, fewest = KINDS[kind]
    found = 0
    for key, field in KEYS.items():
        given = wrong(key, field)
        if given is None:
            continue
        found += 1
        value, problem = given
        text = re.sub(r"\.\d+(?=[.:])", "", refusal(PAPER, setting_of(key, value)))
        if text.endswith("expected a value, got nothing"):
            assert f"{key.rpartition('.')[0]}." in text
        else:
            assert key in text.partition(problem)[0], text
            assert problem in text, text
    assert found >= fewest, "as many keys had it"


# A busy machine draws slowly.
@hypothesis.settings(
    max_examples=300, derandomize=True, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
@given(drawn_settings.settings())
def test_any_value_anywhere(setting: str) -> None:
    """Any value at any key of the schema is accepted, or refused with a `ScenarioError` on one short line."""
    text = ""
    try:
        read_scenario(PAPER, [setting])
    except ScenarioError as error:
        text = str(error)
    assert "\n" not in text
    assert len(text) <= LONGEST
