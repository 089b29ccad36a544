"""A controller of the user.

Found, called with what its links have delivered, checked in all it returns.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from msgspec import structs

import transport
from tests.support.logs import log_of
from tests.support.nodes import AgentNode
from tests.support.random_systems import random_state
from tests.support.runs import (
    SHORT,
    VEHICLE,
    end,
    measurement,
    plant_states,
    ready,
    recorded,
    reproducible,
    roster,
    setup,
)
from tests.support.runs import plan as plan_of
from transport.agent.received import Received
from transport.agent.user_class.returned_values import Step
from transport.agent.user_class.run_for_user import Run, run_of
from transport.agent.user_class.user_controllers import checked_controller
from transport.agent.user_class.user_planner import OwnPlanner, OwnStep
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.summary_assembly import summarise
from transport.flight.memory import simulate
from transport.flight.roles import plant_run
from transport.model.arrays import Array
from transport.model.state import IS_KNOWN, REPORTED, REPORTS, SENSED_VALUES
from transport.plant.engines import checked_engine
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import (
    MAX_DATA,
    STAGES,
    Measurement,
    Message,
    Note,
    Plan,
    StepReport,
)
from transport.protocol.wire.outbox import Outbox

EXAMPLES = Path(__file__).resolve().parents[3] / "docs" / "examples"

# The payload's largest attitude with the examples, deg: half of what a diverging flight passes
# within a second.
LEVEL_DEG = 8.0

MS = 10**6

# What a step returns, and why that is a failure.
IMPORT = "its import from {folder} or the installed packages raised "
FINITE = "step: expected finite inputs, data and numbers for the log, got "
NUMBERS = "step: expected arrays of real numbers, got "
WRONG = {
    "raise ZeroDivisionError('no air')": "step raised ZeroDivisionError: no air (my_own.py:6)",
    "import sys; sys.exit(3)": "step raised SystemExit: 3 (my_own.py:6)",
    "return self.u[:3]": "step: expected shape (4,) or (1 to 20, 4), got (3,)",
    "return np.tile(self.u, (21, 1))": "step: expected shape (4,) or (1 to 20, 4), got (21, 4)",
    "return np.zeros((0, 4))": "step: expected shape (4,) or (1 to 20, 4), got (0, 4)",
    "return self.u * np.nan": FINITE + "input [0, 0] = nan",
    "return self.u + 0j": NUMBERS
    + "ndarray (TypeError: Cannot cast array data from dtype('complex128')",
    "return 'up'": NUMBERS + "str (TypeError: Cannot cast scalar from dtype('<U2')",
    "return None": NUMBERS + "NoneType (TypeError: Cannot cast scalar from dtype('O')",
    "return self.u, {'e': float('inf')}": FINITE + "e = inf",
    "raise type('Mute', (Exception,), {'__str__': lambda _: 1 / 0})()": (
        "step raised Mute, whose text cannot be made (my_own.py:6)"
    ),
    "raise ValueError('\\udc80')": "step raised ValueError: ? (my_own.py:6)",
    "return self.u, {'\\udc80': 1.0}": (
        "step: expected names of printable characters for the log, got '\\udc80'"
    ),
    "return type('Exits', (), {'__array__': lambda *_, **__: sys.exit(0)})()": NUMBERS
    + "Exits (SystemExit: 0) (my_own.py:6)",
    "return self.u, {'e': 'x'}": NUMBERS
    + "tuple (ValueError: could not convert string to float: 'x')",
}


def own(
    folder: Path, monkeypatch: pytest.MonkeyPatch, step: str, start: str = "pass", *changes: str
) -> Setup:
    """Return a short run of a controller whose step and start are given as text.

    `self.k` counts the steps.
    """
    lines = ["import sys; import numpy as np; ended = []", "class Mine:"]
    lines += [
        f"    def start(self, run): self.run, self.u, self.k = run, run.u_hover[:4], -1; {start}"
    ]
    lines += [
        "    def step(self, measurement, messages):",
        "        self.k += 1",
        f"        {step}",
    ]
    lines += ["    def stop(self): ended.append(self.run.agent)"]
    (folder / "my_own.py").write_text("\n".join(lines) + "\n", encoding="utf-8")
    monkeypatch.chdir(folder)
    sys.modules.pop("my_own", None)  # of an earlier call of this test
    return setup(SHORT, "agents.controller=my_own:Mine", *changes)


def test_a_class_cannot_write_into_the_arrays_of_its_run() -> None:
    """They are shared with the project's own parts."""
    run = run_of(setup().run, 2)
    values = {one.name: getattr(run, one.name) for one in fields(run)}
    writeable = {
        name: one.flags.writeable for name, one in values.items() if isinstance(one, np.ndarray)
    }
    assert writeable == dict.fromkeys(("x_hover", "u_hover", "lower", "upper"), False)


def test_a_class_knows_its_run() -> None:
    """Length, delay and seed of the run; the reference, held at its end, in an array of its own."""
    team = setup(SHORT, "clock.actuation=next_tick", "seed=5")
    run = run_of(team.run, 2)
    assert (run.ticks, run.delay, run.seed) == (team.ticks, 1, 5)
    last = len(team.X_ref) - 1
    for tick, row in ((3, 3), (last + 7, last)):
        found = run.reference(tick)
        np.testing.assert_array_equal(found, team.X_ref[row])
        found[:] = 0.0
        assert team.X_ref[row].any()


def test_a_class_declares_data_and_asks_for_the_estimate_in_start() -> None:
    """As many numbers as fit, one estimate however often it is asked for; neither after the start."""
    run = run_of(setup(SHORT, "controller.prediction=closed_loop").run, 2)
    with pytest.raises(ValueError, match="expected a shape of 1 to"):
        run.share((MAX_DATA + 1,))
    run.share(MAX_DATA)
    assert run.data_shape == (MAX_DATA,)
    estimate = run.estimator()
    assert run.estimator() is estimate
    run.started()
    with pytest.raises(ValueError, match=r"run\.share: expected a call in start"):
        run.share(1)
    with pytest.raises(ValueError, match=r"run\.estimator: expected a call in start"):
        run.estimator()


def test_a_class_is_told_who_takes_part() -> None:
    """Agents on the roster and UAVs without motors, released or not, in order."""
    run = run_of(setup().run, 2)
    received: Any = SimpleNamespace(
        tick=7,
        agents={8, 1},
        off=frozenset({8, 1}),
        released=frozenset({8}),
        plans=[],
        measurements=[],
    )
    run.begin(received, must_send=False)
    assert (run.tick, run.agents, run.failed, run.must_send) == (7, (1, 8), (1, 8), False)


def test_velocities_by_name() -> None:
    """`run.velocity` is r_i' of docs/equations.md (39), and that of the sensors where they measure it."""
    team = setup()
    run = run_of(team.run, 2)
    x = random_state(np.random.default_rng(3), team.system.N)
    expected = team.model.velocities(x)[1:]
    found = [run.velocity(uav, x) for uav in range(team.system.N)]
    np.testing.assert_allclose(found, expected, atol=1e-12)

    states = measurement(team, 2, 1, x=x)
    np.testing.assert_allclose(run.velocity(1, states), expected[1], atol=1e-12)
    with pytest.raises(LookupError, match="own UAVs"):
        run.velocity(0, states)

    sensed = np.arange(15.0)
    sensors = structs.replace(states, payload=np.zeros(0), uav_states=sensed[None])
    np.testing.assert_array_equal(run.velocity(1, sensors), sensed[3:6])


def stepped(run: Setup, count: int) -> list[Message]:
    """Return the messages of agent 1 over some ticks without the others."""
    node = AgentNode(run, 1)
    messages = list(node.receive(roster(), 0))
    for k in range(count):
        messages += node.receive(measurement(run, 1, k, shared=()), 0)
    return [*messages, *node.receive(end(count), 0)]


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("pid:PID", ("clock.actuation=next_tick",)),
        ("predicting:Predicting", ("links.delay_s=0.4", "links.loss=0.3")),
    ],
)
def test_the_examples_fly(
    name: str, changes: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each completes the paper's maneuver, on an impaired network, without a failed step.

    Twice with the same bits.
    """
    monkeypatch.chdir(EXAMPLES)
    messages = recorded(setup(f"agents.controller={name}", *changes))
    x = np.array([message.x for message in plant_states(messages)])
    assert len(x) == 500
    assert np.degrees(np.abs(x[:, 6:8])).max() < LEVEL_DEG
    assert {report.status for report in messages if isinstance(report, StepReport)} == {"solved"}
    short = setup(SHORT, f"agents.controller={name}", *changes)
    once, again = ([reproducible(message) for message in recorded(short)] for _ in range(2))
    assert str(once) == str(again)
    assert plant_states(once)[-1].x.tobytes() == plant_states(again)[-1].x.tobytes()


def test_a_class_knows_the_targets_of_its_own_agent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Followers of a leader are behind by the age of its reference; by targets in plans they lead ahead.

    Agent 3 knows the target of agent 1 a delay later, and none before.
    """
    monkeypatch.chdir(EXAMPLES)
    hover = "maneuver.phase=[{name='hover',duration_s=8.0,displacement_m=[0,0,0]}]"
    target = "maneuver.target=[{at_s=1.0,points_m=[[1.0,0.0,-10.0]]%s}]"
    late = "links.delay_s=0.1"

    def flown(name: str, to: str) -> list[Message]:
        return recorded(setup(hover, target % to, f"agents.controller={name}", late))

    rule, leader = flown("predicting:Predicting", ",to=[1]"), flown("leader:Leader", ",to=[1]")
    all_told = np.array([one.x[:3] for one in plant_states(flown("predicting:Predicting", ""))])
    away_m = [
        np.sqrt(
            ((np.array([one.x[:3] for one in plant_states(run)]) - all_told) ** 2).sum(1).mean()
        )
        for run in (rule, leader)
    ]
    assert away_m[1] > 2.0 * away_m[0] > 0.0
    known = [
        (note.tick, note.values[0])
        for note in leader
        if isinstance(note, Note) and note.agent == 3 and note.names == ("targets",)
    ]
    first = min(tick for tick, number in known if number)
    assert first == 20 + 2
    assert {number for tick, number in known if tick < first} == {0.0}


def test_a_class_knows_what_its_own_uavs_see(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the tick of the measurement that says so on, and for good."""
    code = "return np.outer([len(self.run.seen) * 0.1 + 1.0], self.u)"
    run = own(
        tmp_path,
        monkeypatch,
        code,
        "pass",
        "obstacle=[{kind='box',at_m=[5,0,-10],size_m=[1,1,8],margin_m=0.4,seen_within_m=3.0}]",
    )
    node = AgentNode(run, 1)
    messages = list(node.receive(roster(), 0))
    row = [1.0, 5.0, 0.0, -10.0, 0.0, 0.5, 0.5, 4.0, 0.0, 0.4, 0.0]
    for k in range(4):
        seen = np.array([row]) if k == 2 else np.zeros((0, len(row)))
        messages += node.receive(structs.replace(measurement(run, 1, k, shared=()), seen=seen), 0)
    thrusts = [message.inputs[0, 0] for message in messages if isinstance(message, Plan)]
    np.testing.assert_allclose(np.array(thrusts) / thrusts[0], [1.0, 1.0, 1.1, 1.1])


@pytest.mark.parametrize("step", WRONG)
def test_a_wrong_step_is_a_failure(
    step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is named, and counted in the report.

    The plan is the previous one: here the rows of the first.
    """
    run = own(
        tmp_path,
        monkeypatch,
        f"if self.k == 0: return np.outer([1.0, 1.1, 1.2], self.u)\n        {step}",
    )
    messages = stepped(run, 4)
    plans = [message for message in messages if isinstance(message, Plan)]
    notes = [message for message in messages if isinstance(message, Note)]
    assert [plan.status for plan in plans] == ["solved", "numerical", "numerical", "numerical"]
    assert [message.status for message in messages if isinstance(message, StepReport)] == [
        p.status for p in plans
    ]
    assert [plan.stale for plan in plans] == [0, 1, 2, 3]
    shares = [[1.0, 1.1, 1.2], [1.1, 1.2, 1.2], [1.2, 1.2, 1.2], [1.2, 1.2, 1.2]]
    for plan, share in zip(plans, shares, strict=True):
        np.testing.assert_allclose(plan.inputs, np.outer(share, run.hover.u[:4]), rtol=1e-15)
    text = WRONG[step].replace("my_own.py:6", "my_own.py:7")
    assert [note.tick for note in notes] == [1, 2, 3]
    for note in notes:
        assert note.problem.startswith(f"controller my_own:Mine: {text}")
    end_of_run = simulate(run)
    assert end_of_run.outcome == "failed"
    assert "agent1, agent2, agent3, agent4 failed" in end_of_run.reason


@pytest.mark.parametrize(
    "step",
    [
        "raise ValueError(f'at {self.k} for {measurement.uav_states[0, 0]}')",
        "raise ValueError(object())",
        "return self.u[:3], {'e': float(self.k)}",
        "return self.u * np.nan, {'k': float(self.k)}",
    ],
)
def test_failures_of_a_kind_are_one_event(
    step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A text that differs at each step, or for each agent, is told once, with the number of others."""
    run = own(tmp_path, monkeypatch, step)
    messages: list[Message] = []
    simulate(run, messages.append)
    events = summarise(AnalysedRun.of(run, log_of(messages)))["faults"]
    notices = [event["what"] for event in events if event["kind"] == "notice"]
    texts = {note.problem for note in messages if isinstance(note, Note)}
    assert len(notices) == 1
    assert notices[0].startswith("agent1, agent2, agent3, agent4: controller my_own:Mine: step")
    others = len(texts) - 1
    assert notices[0].endswith(f" (and {others} like it)") == (others > 0)


def test_failures_at_two_lines_are_two_events(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another line that raises, or another exception, is another kind."""
    step = "if self.k < 3: raise ValueError(self.k)\n        raise ValueError(self.k)"
    run = own(tmp_path, monkeypatch, step)
    messages: list[Message] = []
    simulate(run, messages.append)
    events = summarise(AnalysedRun.of(run, log_of(messages)))["faults"]
    assert sum(event["kind"] == "notice" for event in events) == 2


def test_inputs_are_clipped_and_numbers_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Inputs beyond the limits would be refused by the others.

    The agent clips them. Numbers go to the record.
    """
    messages = stepped(own(tmp_path, monkeypatch, "return 1e9 * np.ones(4), {'k': self.k}"), 3)
    plan = next(message for message in messages if isinstance(message, Plan))
    np.testing.assert_array_equal(plan.inputs, setup().settings.upper(1)[None])
    logged = [(m.names, m.values.tolist(), m.problem) for m in messages if isinstance(m, Note)]
    assert logged == [(("k",), [float(k)], "") for k in range(3)]


class Hover:
    """A controller that is given as a class."""

    version = "3"

    def start(self, run: Run) -> None:
        """Keep the inputs of hover."""
        self.u = run.u_hover.reshape(-1, 4)[list(run.owned)].ravel()

    def step(self, measurement: Measurement, messages: Sequence[Plan]) -> Array:
        """Return them."""
        return self.u

    def stop(self) -> None:
        """Nothing is open."""


def test_a_class_in_python() -> None:
    """`fly` takes the class itself."""
    phases = [{"name": "hover", "duration_s": 0.5, "displacement_m": [0.0, 0.0, 0.0]}]
    run = transport.fly(
        "resilient", controller=Hover, phases=phases, owned=[[1, 2], [3, 4]], progress=False
    )
    assert run.summary["controller"]["name"] == f"{__name__}:Hover 3"
    assert run.completed


def test_it_knows_what_its_links_have_delivered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Measurements and plans come as late as their links say, plans once.

    The present tick is that of the run.
    """
    late = "now - min([p.tick for p in messages] or [0])"
    data = f"{{'age': now - measurement.tick, 'plans': len(messages), 'late': {late}}}"
    run = own(
        tmp_path,
        monkeypatch,
        f"now = self.run.tick; return self.u, {data}",
        "pass",
        "links.measurement.delay_s=0.1",
        "links.delay_s=0.15",
    )
    notes = [m for m in recorded(run) if isinstance(m, Note) and m.agent == 1]
    assert [note.tick for note in notes] == list(range(2, 30))  # hover before the first measurement
    assert {tuple(note.values) for note in notes if note.tick >= 3} == {(2.0, 3.0, 3.0)}


def test_its_measurement_is_the_newest_that_has_come(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A link with jitter delivers some measurements after newer ones."""
    data = "{'measured': measurement.tick}"
    jitter = "links.override=[{from='plant',to='agent1',jitter_s=0.3}]"
    run = own(tmp_path, monkeypatch, f"return self.u, {data}", "pass", jitter)
    notes = [m for m in recorded(run) if isinstance(m, Note) and m.agent == 1]
    ticks = [note.values[0] for note in notes]
    assert ticks == sorted(ticks)
    assert any(note.values[0] < note.tick for note in notes)


def test_start_and_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every agent starts and ends its object once.

    An agent that comes back has a new one, with the present roster.
    """
    stop = "{at_s=0.3,do='stop',target='agent2'}"
    resume = "{at_s=0.6,do='continue',target='agent2'}"
    faults = f"faults.event=[{stop},{resume}]"
    data = "{'k': self.k, 'agents': len(self.run.agents)}"
    run = own(
        tmp_path,
        monkeypatch,
        f"return self.u, {data}",
        "pass",
        faults,
        "clock.on_agent_loss=continue",
    )
    notes = [m for m in recorded(run) if isinstance(m, Note)]
    steps = [int(note.values[0]) for note in notes if note.agent == 2]
    assert steps == [*range(6), *range(len(steps) - 6)]
    assert {int(note.values[1]) for note in notes} == {3, 4}
    assert sorted(sys.modules["my_own"].ended) == [1, 2, 3, 4]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("none:Mine", IMPORT + "ModuleNotFoundError: No module named 'none'"),
        ("my_own:Yours", IMPORT + "AttributeError: module 'my_own' has no attribute 'Yours'"),
        ("my_own:Mine", "start raised RuntimeError: no gains (my_own.py:3)"),
        ("numpy:ndarray", "the constructor raised TypeError: "),
        ("pathlib:Path", "expected the methods start, step, stop, got no start"),
    ],
)
def test_what_cannot_fly_is_refused(
    name: str, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before anything starts, and with the same words where an agent is built."""
    own(tmp_path, monkeypatch, "return self.u", "raise RuntimeError('no gains')")
    run = setup(SHORT, f"agents.controller={name}")
    for build in (lambda: checked_controller(run.run), lambda: AgentNode(run, 2)):
        with pytest.raises(ScenarioError) as refused:
            build()
        assert refused.value.field == "agents.controller"
        assert refused.value.problem.startswith(text.format(folder=tmp_path))


@pytest.mark.parametrize("kind", ["controller", "engine"])
@pytest.mark.parametrize(
    ("version", "told"),
    [
        ("'1\\udc80'", "1?"),
        ("'1\\n2'", "1 2"),
        ("type('V', (), {'__str__': lambda _: 1 / 0})()", None),
        ("type('V', (), {'__str__': lambda _: sys.exit(0)})()", None),
    ],
)
def test_a_version_is_text_that_a_log_can_hold(
    version: str, told: str | None, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is printable and encodable; one that cannot be made is refused before anything starts."""
    key = "agents.controller" if kind == "controller" else "plant.engine"
    own(tmp_path, monkeypatch, "return self.u")
    text = (tmp_path / "my_own.py").read_text(encoding="utf-8")
    engine = "from transport.plant.engines import Rods\nclass Steel(Rods): version = Mine.version\n"
    (tmp_path / "my_own.py").write_text(
        f"{text}    version = {version}\n{engine}", encoding="utf-8"
    )
    name = "my_own:Mine" if kind == "controller" else "my_own:Steel"
    run = setup(SHORT, f"{key}={name}")

    def version_told() -> str:
        """Return the class with its version, as the record of a run has it."""
        if kind == "controller":
            return checked_controller(run.run)
        return checked_engine(plant_run(run))

    if told is not None:
        assert version_told() == f"{name} {told}"
        return
    with pytest.raises(ScenarioError, match="its version raised ") as refused:
        version_told()
    assert refused.value.field == key


def test_the_class_decides_what_it_sends() -> None:
    """The project's rule for sharing needs corrections, which a class has not: it is refused."""
    closed = ("controller.prediction=closed_loop", "controller.received_plans=by_age")
    with pytest.raises(ScenarioError, match=r"with agents\.controller = "):
        setup("agents.controller=pid:PID", *closed, "controller.share=on_change")


def test_each_agent_has_the_controller_of_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A list has one controller for each agent: here the third has a class that drops its UAV's thrust.

    The others' plans are those of the project, and the version names each controller once.
    """
    own(tmp_path, monkeypatch, "return (0.9, 0.8)[self.k % 2] * self.u")
    run = ready("resilient", SHORT, 'agents.controller=["mpc","alone","my_own:Mine","mpc"]')
    messages = recorded(run)
    plans = [message for message in messages if isinstance(message, Plan)]
    rows = {plan.agent: len(plan.inputs) for plan in plans}
    assert rows == {1: 20, 2: 4, 3: 1, 4: 20}
    solvers = {report.agent: report.solver for report in messages if isinstance(report, StepReport)}
    assert solvers == {1: "active_set", 2: "alone", 3: "my_own:Mine", 4: "active_set"}
    thrust = run.hover.u[0]
    given = {plan.inputs[0, 0] for plan in plans if plan.agent == 3}
    assert given == {0.9 * thrust, 0.8 * thrust}

    name, version = checked_controller(run.run).rsplit(" ", 1)
    assert name == "mpc, alone, my_own:Mine"
    assert version == checked_controller(setup("agents.controller=my_own:Mine").run).split()[1]
    assert {
        message.agent for message in messages if isinstance(message, Note) and message.problem
    } == set()


def test_a_mixed_team_flies() -> None:
    """`precise` with two UAVs that fly alone and two agents of the project keeps to its path, 1.7 cm rms as without.

    With the sensors of the vehicles too: UAVs alone tell theirs to the filters of the others, which would
    drift without.
    """
    mixed = 'agents.controller=["alone","mpc","alone","mpc"]'
    climb = "maneuver.phase=[{name='climb',duration_s=5.0,displacement_m=[0,0,-2.5]}]"
    for sensors in ((), VEHICLE):
        run = ready("precise", climb, mixed, *sensors)
        messages = recorded(run)
        x = np.array([message.x for message in plant_states(messages)])
        whole = plant_states(recorded(ready("precise", climb, *sensors)))
        difference_m = np.linalg.norm(x[:, :3] - np.array([one.x for one in whole])[:, :3], axis=1)
        assert difference_m.max() < 0.05
        assert np.degrees(np.abs(x[:, 6:9])).max() < 2.5


class Scripted:
    """A controller whose answers a test gives, by tick and exchange; it declares data of a shape."""

    shape: ClassVar[tuple[int, ...] | None] = None
    stopped: ClassVar[list["Scripted"]] = []

    def start(self, run: Run) -> None:
        """Declare the data."""
        self.run = run
        if self.shape is not None:
            run.share(self.shape)

    def step(self, measurement: Measurement, messages: Sequence[Plan]) -> object:
        """Return the answer of the test."""
        return self.answer(self.run.tick, 0)

    def negotiate(self, iteration: int, messages: Sequence[Plan]) -> object:
        """Return the answer of the test."""
        return self.answer(self.run.tick, iteration)

    def answer(self, tick: int, iteration: int) -> object:
        """Return inputs that differ from tick to tick."""
        return (1.0 + 0.01 * tick) * np.ones(4)

    def stop(self) -> None:
        """Be remembered as stopped."""
        self.stopped.append(self)


SCRIPTED = f"agents.controller={__name__}:Scripted"


class Steps:
    """The planner of agent 3 with a scripted class, a step at a time."""

    def __init__(self, *settings: str, stopwatch: Callable[[], int] = lambda: 0) -> None:
        self.run = setup(SHORT, SCRIPTED, *settings)
        # Each input of the team's hover is another one.
        hover = replace(self.run.run.hover, u=np.arange(16.0))
        team = replace(self.run.run.team, hover=hover)
        self.planner = OwnPlanner(replace(self.run.run, team=team), 3, stopwatch)
        self.out = Outbox("agent3", 1)

    def begin(
        self,
        tick: int,
        *,
        measured: Sequence[int] | None = None,
        plans: Sequence[Plan] = (),
        version: int = 1,
        started_ns: int = 0,
    ) -> OwnStep:
        """Begin a tick with measurements of some ticks, by default its own, each at another place."""
        own = measurement(self.run, 3, tick, version=version)
        at_0 = np.zeros((1, 15)) if self.run.run.sensors.vehicle else own.uav_states
        ticks = [tick] if measured is None else measured
        came = [structs.replace(own, tick=k, uav_states=at_0 + k) for k in ticks]
        return self.planner.begin(
            Received(
                measurement=own,
                measurements=came,
                plans=plans,
                lost=0,
                measurements_lost=0,
                agents={1, 2, 3, 4},
                off=frozenset(),
                released=frozenset(),
                failed_since=0,
                ticks_since_start=tick,
                started_ns=started_ns,
            )
        )

    def plan(self, step: OwnStep) -> tuple[Plan, StepReport | None, list[str]]:
        """Return the plan of a call, and of the last one the report after it, and the notes' problems before."""
        messages = self.planner.plan(step, self.out, 7 * MS)
        *notes, plan, report = [*messages, None] if step.negotiation else messages
        assert isinstance(plan, Plan)
        assert report is None or isinstance(report, StepReport)
        problems = [note.problem for note in notes if isinstance(note, Note)]
        assert len(problems) == len(notes)
        return plan, report, problems

    def tick(self, tick: int, **arrivals: Any) -> tuple[Plan, StepReport, list[str]]:
        """Return plan, report and problems of a tick without negotiation."""
        plan, report, problems = self.plan(self.begin(tick, **arrivals))
        assert report is not None
        return plan, report, problems


def test_times_of_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """All calls of a tick are its solve; the time between two steps is waiting, that of publishing is told."""
    clock = SimpleNamespace(ns=0)

    def stopwatch() -> int:
        clock.ns += MS
        return int(clock.ns)

    def answer(_self: Scripted, _tick: int, iteration: int) -> Array:
        clock.ns += (50 if iteration == 0 else 20) * MS
        return np.ones(4)

    monkeypatch.setattr(Scripted, "answer", answer)
    steps = Steps("controller.negotiation_iterations=2", stopwatch=stopwatch)
    for tick in range(2):
        idle_ns = clock.ns
        clock.ns += 30 * MS
        step = steps.begin(tick, started_ns=clock.ns)
        started_ns = clock.ns - 2 * MS
        steps.plan(step)
        clock.ns += 100 * MS  # the others' proposals come
        steps.planner.adopt(step, ())
        _, report, _ = steps.plan(step)
        assert report is not None
        times_ms = dict(zip(STAGES, report.times_ms, strict=True))
        assert times_ms["estimate"] == 1.0
        assert times_ms["solve"] == (50 + 1) + (20 + 1)
        assert times_ms["publish"] == 7.0
        idle_since_ns = idle_ns if tick else MS
        assert times_ms["wait"] == (started_ns - idle_since_ns) / MS
        # To the report, after which the stopwatch is read once more.
        assert times_ms["total"] == (clock.ns - MS - started_ns) / MS


def test_ages_are_those_of_the_newest() -> None:
    """Of plan and state of each agent, and of the measurement; -1 before any; older ones that are late are not used."""
    steps = Steps()

    def of_agent_2(tick: int, stale: int = 0) -> Plan:
        return structs.replace(plan_of(steps.run, 2, tick), stale=stale)

    rows = [
        ([], [], -1, -1, -1),
        ([4, 3], [of_agent_2(4, stale=3)], 6 - 4, 6 - (4 - 3), 6 - 4),
        ([5, 2], [of_agent_2(5), of_agent_2(2)], 7 - 5, 7 - 5, 7 - 5),
    ]
    for tick, (measured, plans, state_age, plan_age, age) in enumerate(rows, start=5):
        sent, report, problems = steps.tick(tick, measured=measured, plans=plans)
        assert (report.peers, problems) == ((1, 2, 4), [])
        assert report.state_ages == (-1, state_age, -1)
        assert report.plan_ages == (-1, plan_age, -1)
        assert report.measurement_age == age
        if age < 0:  # hover of its own UAV, the third of the team, before it is called
            np.testing.assert_array_equal(sent.inputs, [[8.0, 9.0, 10.0, 11.0]])
        else:
            shift = sent.uav_states - measurement(steps.run, 3, 0).uav_states
            np.testing.assert_allclose(shift, tick - age)


def test_sensors_are_told_as_often_as_a_plan_repeats_them() -> None:
    """A plan has those of its tick and of the ticks before, the newest first, whenever they come."""
    steps = Steps(*VEHICLE)
    for tick in range(2 * REPORTS):
        # Every second one comes with the next.
        sent, _, _ = steps.tick(tick, measured=[tick - 1, tick] if tick % 2 else [])
    rows = sent.uav_states.reshape(REPORTS, REPORTED)
    assert (rows[:, IS_KNOWN] == 1.0).all()
    newest, *earlier = rows[:, SENSED_VALUES]
    for age, values in enumerate(earlier, start=1):
        np.testing.assert_allclose(values, newest - age)


def test_what_must_be_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first plan under a roster, the first after a target, and all proposals, whatever the class wants."""
    monkeypatch.setattr(Scripted, "answer", lambda *_: Step(inputs=np.ones(4), send=False))
    steps = Steps("controller.negotiation_iterations=2")

    def shared(tick: int, version: int = 1) -> tuple[bool, bool]:
        step = steps.begin(tick, version=version)
        proposal, _, _ = steps.plan(step)
        steps.planner.adopt(step, ())
        return proposal.shared, steps.plan(step)[0].shared

    found = [shared(0), shared(1)]
    steps.planner.follow(steps.run.run)
    found += [shared(2), shared(3), shared(4, version=2), shared(5, version=2)]
    assert found == [(True, True), (True, False)] * 3


def test_calls_in_a_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Exchanges are counted from 1; after a failure the class is not called again at that tick."""
    calls: list[tuple[int, int]] = []

    def answer(_self: Scripted, tick: int, iteration: int) -> Array:
        calls.append((tick, iteration))
        if tick == 1:
            raise RuntimeError("no air")
        return np.ones(4)

    monkeypatch.setattr(Scripted, "answer", answer)
    steps = Steps("controller.negotiation_iterations=3")
    for tick in range(2):
        step = steps.begin(tick)
        for _ in range(2):
            steps.plan(step)
            steps.planner.adopt(step, ())
        _, report, problems = steps.plan(step)
        assert report is not None
        assert (report.status, len(problems)) == [("solved", 0), ("numerical", 1)][tick]
    assert calls == [(0, 0), (0, 1), (0, 2), (1, 0)]


@pytest.mark.parametrize(
    ("shape", "expected"), [(None, "no data"), ((2, 3), "data of shape (2, 3)")]
)
def test_refused_data_are_told_once(
    shape: tuple[int, ...] | None, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At whichever exchange they come; a plan without data is used as it is, and one with as many as declared."""

    def answer(*_: object) -> Step:
        return Step(inputs=np.ones(4), data=None if shape is None else np.zeros(shape))

    monkeypatch.setattr(Scripted, "shape", shape)
    monkeypatch.setattr(Scripted, "answer", answer)
    steps = Steps("controller.negotiation_iterations=3")
    numbers = 0 if shape is None else 6
    assert steps.planner.data_numbers == numbers

    def of(agent: int, count: int) -> Plan:
        return structs.replace(plan_of(steps.run, agent, 0), data=np.arange(float(count)))

    step = steps.begin(1, plans=[of(1, 0), of(2, numbers), of(4, 4)])
    for _ in range(2):
        steps.plan(step)
        steps.planner.adopt(step, [of(1, 0), of(2, numbers), of(4, 5)])
        assert [one.data.shape for one in step.plans] == [(0,), shape or (0,), (0,)]
    _, _, problems = steps.plan(step)
    name = f"controller {__name__}:Scripted"
    assert problems == [
        f"{name}: plan of agent4: expected {expected}, got {count} numbers" for count in (4, 5)
    ]


def test_repeated_inputs_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """In plan, report and note, 0.4 s after the first of them, since when the plan is not fresh."""
    monkeypatch.setattr(Scripted, "answer", lambda *_: np.ones(4))
    steps = Steps()
    first, suspicious = 2, 2 + round(0.4 / 0.05) + 1
    for tick in range(first, suspicious + 2):
        sent, report, problems = steps.tick(tick)
        is_told = tick >= suspicious
        assert sent.status == report.status == ("unchanged" if is_told else "solved")
        assert sent.stale == (tick - first if is_told else 0)
        assert [": the inputs have been the same for" in one for one in problems] == [
            True
        ] * is_told


def test_a_failure_shifts_the_plan_by_the_ticks_since(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ticks that the agent has missed pass too."""
    rows = np.outer([1.0, 1.1, 1.2, 1.3], [20.0, 0.0, 0.0, 0.0])

    def answer(_self: Scripted, tick: int, _iteration: int) -> Array:
        if tick > 4:
            raise RuntimeError("no air")
        return rows

    monkeypatch.setattr(Scripted, "answer", answer)
    steps = Steps("clock.actuation=next_tick")
    steps.tick(4)
    sent, _, _ = steps.tick(6)
    assert (sent.start_tick, sent.stale) == (7, 2)
    np.testing.assert_array_equal(sent.inputs, rows[[2, 3, 3, 3]])


def test_an_object_ends_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The old one when an agent starts anew, the other at the end of the run, where a failure is told."""
    monkeypatch.setattr(Scripted, "stopped", [])
    steps = Steps()
    steps.planner.restart()
    assert len(Scripted.stopped) == 1
    assert steps.planner.end(9, steps.out) == steps.planner.end(9, steps.out) == []
    assert len({*map(id, Scripted.stopped)}) == len(Scripted.stopped) == 2

    def stop(_: Scripted) -> None:
        raise RuntimeError("still open")

    monkeypatch.setattr(Scripted, "stop", stop)
    steps.planner.restart()
    (note,) = steps.planner.end(9, steps.out)
    assert isinstance(note, Note)
    assert note.problem.startswith(
        f"controller {__name__}:Scripted: stop raised RuntimeError: still"
    )
    assert steps.planner.end(9, steps.out) == []
