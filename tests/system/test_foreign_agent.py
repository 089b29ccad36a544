"""An agent without code of the project controls UAV 3 among real processes.

The protocol page suffices.
"""

import ast
import json
import runpy
import subprocess
import sys
from contextlib import chdir
from pathlib import Path
from queue import SimpleQueue
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec import structs

import transport
from tests.support import runs
from tests.support.commands import forks, free_base, settings
from tests.support.runs import ready
from tests.test_architecture import LAYERS
from transport.model.physics.parameters import table_1
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.wire.codec import VERSION, decode, encode
from transport.protocol.wire.messages import Note, Plan, PlantState

# Height of a UAV as the agent computes it from its measurement, and as the plant has it.
SAME_HEIGHT_M = 1e-12
SAME_THRUST_N = 1e-9

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "foreign_agent.py"


def simulate(folder: Path, *changes: str) -> dict[str, Any]:
    """Run `resilient` with the foreign agent as agent 3 and return the recorder's summary."""
    base = free_base()
    given = [*changes, f"network.base_port={base}"]
    digest = read_scenario(find_scenario("resilient"), given).digest()
    options = ["--run", "mixed-team", "--scenario", "resilient", *settings(*given)]
    roles = [
        ["record", "--out", "recorded", "--no-figures"],
        ["coordinator", "--observer", "recorder"],
        ["plant"],
        *[["agent", "--id", str(agent)] for agent in (1, 2, 4)],
    ]
    foreign = [sys.executable, str(EXAMPLE), "mixed-team", digest, "3", str(base)]
    with forks() as begin, chdir(folder):
        others = begin(*([*role, *options] for role in roles))
        own = subprocess.run(foreign, capture_output=True, text=True, timeout=150, check=False)
        assert own.returncode == 0, own.stderr
        assert [process.wait(timeout=150) for process in others] == [0] * len(others)
    summary: dict[str, Any] = json.loads((folder / "recorded" / "summary.json").read_text())
    assert summary["outcome"] == "completed"
    assert summary["rejections"] == []
    return summary


@pytest.mark.slow
def test_a_foreign_agent_flies_the_maneuver(tmp_path: Path) -> None:
    """In the paper's 25 s the agent knows only the others' plans.

    Payload attitude and separation stay in bounds.
    """
    summary = simulate(tmp_path)
    assert summary["ticks"] == 500
    assert summary["attitude_max_deg"] < 5.0
    assert summary["separation_min_m"] > 0.35


HEIGHTS = """
import numpy as np

class Heights:
    version = "1"
    def start(self, run):
        self.run = run
        run.share(1)
        self.heard = {}
    def step(self, measurement, messages):
        run = self.run
        uav = run.owned[0]
        numbers = {}
        for plan in messages:
            numbers[f"heard{plan.agent}"] = plan.data[0] if plan.data.size else np.pi
        e, theta = run.rod_direction(uav, measurement), run.attitude(uav, measurement)
        turn = 100.0 * theta + 16.0 * run.body_rate(uav, measurement)
        thrust = run.u_hover[4 * uav] + 0.1 * (uav - 1)  # the team tilts: heights differ
        u = np.append(thrust, -run.system.uavs[uav].inertia @ turn)
        return u, [run.position(uav, measurement)[2]], numbers
    def stop(self):
        pass
"""


@pytest.mark.slow
def test_own_data_between_languages(tmp_path: Path) -> None:
    """The data of the foreign agent reach classes of the user bit for bit, and theirs reach it.

    It shares the height of its UAV, which the plant knows, and steers to the mean of all.
    """
    (tmp_path / "heights.py").write_text(HEIGHTS, encoding="utf-8")
    hover = "maneuver.phase=[{name='hover',duration_s=1.5,displacement_m=[0,0,0]}]"
    simulate(tmp_path, hover, "agents.controller=heights:Heights")
    run = transport.load(tmp_path / "recorded")

    shared = {(plan.agent, plan.tick): plan.data for plan in run.log.of(Plan)}
    assert {data.shape for data in shared.values()} == {(1,)}
    heights = run.series["uav_position_m"][:, 2, 2]
    own = [shared[3, tick][0] for tick in range(30)]
    np.testing.assert_allclose(own, heights[:30], rtol=0.0, atol=SAME_HEIGHT_M)

    notes = [note for note in run.log.of(Note) if note.agent == 1 and "heard3" in note.names]
    assert len(notes) == 29
    for note in notes:
        heard = note.values[note.names.index("heard3")]
        assert heard == shared[3, note.tick - 1][0]

    # Its thrust has the part that pulls it to the mean height of all, by data of the tick before.
    plans = {(plan.agent, plan.tick): plan for plan in run.log.of(Plan)}
    x = {state.tick: state.x for state in run.log.of(PlantState)}
    control = runpy.run_path(str(EXAMPLE))["control"]
    for tick in (10, 20):
        before = [plans[agent, tick - 1] for agent in (1, 2, 4)]
        rods = np.mean([plan.uav_states[0] for plan in before], axis=0)
        without_data = control(x[tick][:12], x[tick][36:48], rods)
        apart = own[tick] - np.mean([own[tick], *(plan.data[0] for plan in before)])
        thrust_N = plans[3, tick].inputs[0, 0]
        assert thrust_N == pytest.approx(without_data[0] + 20.0 * apart, abs=SAME_THRUST_N)


def test_it_imports_nothing_of_the_project() -> None:
    """The example imports only the standard library, msgpack, numpy and zenoh."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(EXAMPLE.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(str(node.module).partition(".")[0])
    assert not names & {*LAYERS, "tests", "scenarios"}
    assert names <= {*sys.stdlib_module_names, "msgpack", "numpy", "zenoh"}


def test_its_numbers_are_those_of_the_scenario() -> None:
    """The literals of the example equal the values of scenario and protocol version."""
    values: dict[str, Any] = {}
    for node in ast.parse(EXAMPLE.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple):
            names = [ast.unparse(target) for target in node.targets[0].elts]
            assert isinstance(node.value, ast.Tuple)
            texts = [ast.unparse(value).removeprefix("np.array") for value in node.value.elts]
            values |= {
                name: ast.literal_eval(text) for name, text in zip(names, texts, strict=True)
            }
    run = ready("resilient")
    uav = table_1().uavs[2]
    assert values["VERSION"] == VERSION
    assert (values["AGENTS"], values["STEPS"]) == (len(run.agents), run.settings.horizon)
    assert values["MASS"] == uav.mass
    assert values["INERTIA"] == pytest.approx(uav.inertia.diagonal())
    assert values["THRUST"] == pytest.approx(run.hover.u[8])
    assert values["RHO"] == pytest.approx(uav.rho[:2])


@pytest.fixture
def example() -> dict[str, Any]:
    """What the file of the agent defines."""
    return runpy.run_path(str(EXAMPLE))


def test_its_plans_and_measurements_are_those_of_the_protocol(example: dict[str, Any]) -> None:
    """A plan that it packs is one of the project; a measurement comes with the others' plans of the tick before."""
    run = ready("resilient")
    x = run.initial_state()
    plans = [runs.plan(run, agent, 4, x=x) for agent in (1, 2, 4)]
    heights = [-3.0, -3.2, -3.1]
    shared = [
        structs.replace(plan, data=np.array([z])) for plan, z in zip(plans, heights, strict=True)
    ]
    measured = runs.measurement(run, 3, 5, x=x)
    inbox: SimpleQueue[Any] = SimpleQueue()
    # The measurement may come before the last plan: it waits.
    for message in (*shared[:2], runs.measurement(run, 2, 5, x=x), measured, shared[2]):
        data = encode(message)
        inbox.put(SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda data=data: data)))
    inbox.put(None)
    ((tick, fields, others, heard),) = example["measurements"](3, inbox)
    assert tick == 5
    np.testing.assert_array_equal(others, [plan.uav_states[0] for plan in plans])
    assert sorted(heard) == sorted(heights)

    answer = example["answer"](3, tick, fields, others, heard)
    plan = decode(example["message"]("plan", "agent3", 0, tick, tick, *answer))
    assert isinstance(plan, Plan)
    assert (plan.agent, plan.start_tick, plan.uavs, plan.shared) == (3, 5, (3,), True)
    np.testing.assert_array_equal(plan.uav_states, measured.uav_states)
    own_z = run.model.outputs_along(x[None])[0, 8]  # z of UAV 3
    np.testing.assert_allclose(plan.data, [own_z], atol=SAME_HEIGHT_M)
    hover_N = run.hover.u[8]
    pulled_N = 20.0 * (own_z - np.mean([own_z, *heights]))
    assert plan.inputs[0, 0] == pytest.approx(hover_N + pulled_N, abs=1e-3)
    np.testing.assert_allclose(plan.inputs[1:], np.tile([hover_N, 0.0, 0.0, 0.0], (19, 1)))


def test_its_loops_work_against_deviations(example: dict[str, Any]) -> None:
    """A low corner of the payload is raised, a tilted UAV is turned back, a turning one is slowed, within limits."""
    run = ready("resilient")
    x = run.initial_state()
    payload = x[:12]
    team = x[36:48]
    control = example["control"]
    hover = control(payload, team, team)
    np.testing.assert_allclose(hover, run.hover.u[8:12], atol=1e-3)

    rolled, pitched = payload.copy(), payload.copy()
    rolled[6] = -0.01  # a roll to the left lowers its corner at the left rear
    pitched[7] = 0.01  # and so does a nose that rises
    assert control(rolled, team, team)[0] - hover[0] == pytest.approx(0.25)
    assert control(pitched, team, team)[0] - hover[0] == pytest.approx(0.25)

    rolling = payload.copy()
    rolling[9] = -0.01  # 0.3 s ahead of the height
    assert control(rolling, team, team)[0] - hover[0] == pytest.approx(0.075)

    behind = team.copy()
    behind[:2] += 0.001  # along its rod the UAV is behind and to the left: nose down, to the right
    moment_Nm = 0.029 * 100.0 * 1.5 / 22.0725 * 40.0 * 0.001
    np.testing.assert_allclose(control(payload, behind, team)[1:3], [moment_Nm, -moment_Nm])

    own = team.copy()
    own[6] += 0.001
    own[10] += 0.01
    roll_Nm, pitch_Nm, yaw_Nm = control(payload, own, team)[1:]
    assert (roll_Nm, pitch_Nm) == (pytest.approx(-0.029 * 0.1), pytest.approx(-0.029 * 0.16))
    assert yaw_Nm == 0.0
    own[6:8] += 9.0
    assert np.abs(control(payload, own, team)[1:3]).tolist() == [0.5, 0.5]
