"""The arena: its combinations, entries of the user, tables, and resumption."""

import hashlib
from dataclasses import replace
from importlib import import_module
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import orjson
import pytest
from matplotlib.image import imread

import transport
from tests.support import runs
from tests.support.logs import log_of
from tests.support.results import here
from transport.agent.user_class.run_for_user import Run
from transport.experiments.arena.arena_algorithms import (
    BUILT_IN,
    REFERENCE,
    Algorithm,
    Entry,
    entered,
)
from transport.experiments.arena.arena_measures import judged
from transport.experiments.arena.arena_report import ArenaResult
from transport.experiments.arena.arena_runs import FROM_GOAL, VIOLATION, _point, arena, axes
from transport.experiments.arena.arena_tasks_and_networks import (
    NETWORK_TEXTS,
    NETWORKS,
    PERFECT,
    SCENARIO,
    TASKS,
    VERSION,
    Task,
)
from transport.experiments.cases import Case, ExperimentError, Point
from transport.experiments.simulation import Result
from transport.experiments.statistics import Estimate, PointStatistics
from transport.interface.setting_arguments import ArgumentError
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.scenario_errors import requested
from transport.protocol.scenario.sections.schema import ControllerSection, Scenario
from transport.protocol.scenario.targets.target_checks import target_fields
from transport.protocol.wire.messages import MAX_DATA, Target
from transport.protocol.wire.outbox import Outbox

# 0.6 s, long enough for costs that differ.
SHORT = (
    "maneuver.phase=[{name='hover',duration_s=0.3,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=0.3,displacement_m=[0,0,-0.2]}]"
)


# Keys of [controller] that an entry may set: they do not change the task.
ALGORITHM_KEYS = {
    # the model it predicts with
    *("horizon", "discretisation", "linearisation", "motor_lag_s", "knows_drag"),
    # the others, and UAVs alone
    *("prediction", "received_plans", "received_states", "fail_safe"),
    *("silence", "alone", "targets"),
    *("estimator", "disturbance"),
    *("terminal", "preview", "relaxation", "solver"),  # the program
    *("negotiation_iterations", "share", "share_threshold", "share_heartbeat_s"),  # the exchange
}


class Steady:
    """An entry: always the inputs of hover."""

    version = "7"
    arena = {  # noqa: RUF012  # as in the documentation
        "tuned": "nothing",
        "settings": ["controller.received_plans=by_age"],
    }

    def start(self, run: Run) -> None:
        """Keep the inputs of hover."""
        self.u = run.u_hover[state.input_indices(run.owned)]

    def step(self, measurement: object, messages: object) -> Array:
        """Return the inputs of hover."""
        return self.u

    def stop(self) -> None:
        """Nothing is open."""


class Large(Steady):
    """An entry with data that fit into a message for four UAVs, but not for three.

    It declares data and returns none, so each of its steps fails.
    """

    def start(self, run: Run) -> None:
        """Declare data, the more the fewer UAVs."""
        super().start(run)
        run.share((4 * MAX_DATA // run.system.N,))


class Falling(Steady):
    """An entry without thrust: the team falls out of the allowed distance from the reference."""

    def start(self, run: Run) -> None:
        """Switch the motors off."""
        super().start(run)
        self.u = np.zeros_like(self.u)


STEADY = f"{__name__}:Steady"
LARGE = f"{__name__}:Large"


@pytest.fixture
def short_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the tasks by two short ones."""
    import_module("transport.experiments.information_experiment")  # reads the tasks
    tasks = {
        "short": Task(text="0.6 s", settings=(SHORT,)),
        "three UAVs": Task(text="0.6 s of three", settings=(SHORT,), uavs=3),
    }
    import_module("transport.experiments.information_experiment")  # whose task is not a short one
    for module in (
        "arena_report",
        "arena_runs",
        "arena_tasks_and_networks",
    ):  # each has imported the name
        monkeypatch.setattr(import_module(f"transport.experiments.arena.{module}"), "TASKS", tasks)


def distributed_case(task: str, network: str) -> Case:
    """Return the first run of a task on a network with an agent for each UAV."""
    made = arena(tasks=[task], networks=[network], algorithms=["paper"])
    labels = {"task": task, "network": network, "algorithm": "paper"}
    return next(case for case in made.cases if made.experiment.points[case.point].labels == labels)


def test_every_combination_is_there() -> None:
    """Every algorithm is on every task and network, one agent for all on the perfect one only."""
    made = arena(algorithms=["paper"])
    labels = [tuple(point.labels.values()) for point in made.experiment.points]
    expected = {(task, net, "paper") for task in TASKS for net in NETWORKS}
    expected |= {(task, PERFECT, REFERENCE) for task in TASKS}
    assert len(labels) == len(set(labels))
    assert set(labels) == expected
    texts = [", ".join(map(str, own)) for own in labels]
    assert [point.text for point in made.experiment.points] == texts
    assert made.refused == {}
    assert set(NETWORK_TEXTS) == set(NETWORKS)


def test_algorithms_differ_in_their_controller_only() -> None:
    """Tasks fix system, maneuver, weights, limits and plant for every algorithm.

    Failures are the same for all but the centralized algorithms, which are spared them.
    """
    made = arena(tasks=["death", "shared"], networks=[PERFECT])
    points = made.experiment.points
    assert {one.labels["algorithm"] for one in points if one.baseline} == {REFERENCE}
    for task in ("death", "shared"):
        fixed_parts = set()
        for case in made.cases:
            labels = made.experiment.points[case.point].labels
            if labels["task"] != task:
                continue
            tree = case.scenario.tree()
            controller = tree["controller"]
            of_task = [
                controller.get(key)
                for key in ControllerSection.model_fields
                if key not in ALGORITHM_KEYS
            ]
            fixed_parts.add(str([tree["system"], tree["maneuver"], tree["plant"], of_task]))

            is_spared = str(labels["algorithm"]).startswith("centralized")
            assert bool(tree["faults"]["event"]) == (task == "death" and not is_spared)
        assert len(fixed_parts) == 1


def test_a_task_has_the_last_word(monkeypatch: pytest.MonkeyPatch) -> None:
    """A setting of the algorithm gives way to the network's, that to the task's, and that to the failures'."""
    keys = ("links.loss", "links.duplicate", "links.delay_s", "links.jitter_s")
    sets = [tuple(f"{key}={value}" for key in keys[value:]) for value in range(4)]
    algorithm = Algorithm(name="own", settings=sets[0], tuned="nothing")
    task = Task(text="", settings=sets[2], failures=sets[3], uavs=3)
    monkeypatch.setattr("transport.experiments.arena.arena_runs.TASKS", {"task": task})
    monkeypatch.setattr("transport.experiments.arena.arena_runs.NETWORKS", {"network": sets[1]})
    scenario = _point("task", "network", algorithm).read()
    assert scenario.owned == ((1,), (2,), (3,))
    links = scenario.links
    assert [links.loss, links.duplicate, links.delay_s, links.jitter_s] == [0, 1, 2, 3]


def test_a_perfect_network_delivers_every_plan() -> None:
    """Every plan arrives at once, as the text says: no impairment is set, and there is no radio."""
    scenario = distributed_case("maneuver", PERFECT).scenario
    assert NETWORK_TEXTS[PERFECT] == "every plan arrives at once"
    assert scenario.links.model_dump(exclude_defaults=True) == {}
    assert scenario.radio is None


def test_a_late_network_has_the_delay_and_the_loss_of_its_text() -> None:
    """Links have the delay and the loss that the text says, and no other impairment."""
    impairments = distributed_case("maneuver", "late").scenario.links.model_dump(
        exclude_defaults=True
    )
    assert impairments.keys() == {"delay_s", "loss"}
    delay_ms, loss_percent = 1e3 * impairments["delay_s"], 100.0 * impairments["loss"]
    assert NETWORK_TEXTS["late"] == f"{delay_ms:g} ms delay, {loss_percent:g} % packet loss"


def test_a_bursty_network_has_the_loss_and_the_bursts_of_its_text() -> None:
    """Share of lost plans and mean length of a burst of the Gilbert-Elliott model are those of the text."""
    scenario = distributed_case("maneuver", "bursts").scenario
    assert scenario.links.model_dump(exclude_defaults=True).keys() == {"gilbert_elliott"}
    bursts = scenario.links.gilbert_elliott
    assert bursts is not None

    # Stationary distribution of the two states; the time in one of them is geometric.
    share_in_bursts = bursts.enter / (bursts.enter + bursts.leave)
    lost_percent = 100.0 * bursts.loss * share_in_bursts
    mean_burst_s = scenario.controller.sampling_period_s / bursts.leave
    text = f"{lost_percent:g} % of the plans lost, in bursts of {mean_burst_s:g} s on average"
    assert NETWORK_TEXTS["bursts"] == text


def test_the_radio_is_that_of_its_text() -> None:
    """Standard, rate, access and traffic of others are those of the text; links add no impairment."""
    scenario = distributed_case("maneuver", "radio").scenario
    assert scenario.links.model_dump(exclude_defaults=True) == {}
    radio = scenario.radio
    assert radio is not None

    assert radio.offsets == "slots"
    channel = f"one {radio.standard} channel at {radio.rate_mbps:g} Mb/s with a slot for each agent"
    assert (
        NETWORK_TEXTS["radio"] == f"{channel} and {100.0 * radio.background:g} % traffic of others"
    )


def test_the_silence_cuts_all_agents_apart() -> None:
    """From 3 to 8 s no message passes between any two agents: three of four are alone on their side of a cut."""
    cuts = distributed_case("silence", PERFECT).scenario.links.partition
    assert [cut.between for cut in cuts] == [["agent1"], ["agent2"], ["agent3"]]
    assert {f"from {cut.start_s:g} to {cut.end_s:g} s" for cut in cuts} == {"from 3 to 8 s"}
    assert TASKS["silence"].text.endswith("no message from 3 to 8 s")


@pytest.mark.parametrize(
    ("attribute", "expected"),
    [
        ({"tuned": 3}, "arena: tuned: expected"),
        ({"tune": "x"}, "arena: tune: unknown key; did you mean 'tuned'?"),
        ({"settings": ["controller.weights.attitude=50"]}, "that are not the task's"),
        ({"settings": ["plant.payload_mass_factor=0.5"]}, "that are not the task's"),
        ({"settings": ["agents.failed_share=1"]}, "that are not the task's"),
    ],
)
def test_an_entry_is_refused_in_one_line(
    attribute: dict[str, object], expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wrong attribute, or a key outside its part of [controller], is refused in a line that names the class."""
    monkeypatch.setattr(Steady, "arena", attribute)
    with pytest.raises(ExperimentError, match=f"--controller {STEADY}: ") as refused:
        entered(STEADY)
    assert expected in str(refused.value)
    assert "\n" not in str(refused.value)


def is_accepted(key: str, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Return whether an entry may set a key of [controller]."""
    monkeypatch.setattr(Steady, "arena", {"settings": [f"controller.{key}=1"]})
    try:
        entered(STEADY)
    except ExperimentError:
        return False
    return True


def test_an_entry_may_set_the_keys_of_an_algorithm_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every key of [controller] is the algorithm's or the task's; an entry may set the former alone."""
    keys = ControllerSection.model_fields
    assert {key for key in keys if is_accepted(key, monkeypatch)} == ALGORITHM_KEYS


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--task", "manoeuvre"), "--task: expected one of maneuver, eight, "),
        (("--network", "no"), "--network: expected one of perfect, late, bursts, radio, none, got"),
        (("--algorithm", "mine"), "--algorithm: expected one of centralized, "),
        (("--controller", "none:Mine"), "--controller none:Mine: its import from "),
        (("--dask", "nowhere"), "--dask: expected an address"),
    ],
)
def test_unknown_names_are_refused(options: tuple[str, ...], expected: str) -> None:
    """An option with an unknown name is refused in one line before any run, with the names to choose from."""
    done = here("arena", *options)
    assert done.exit_code in (2, 3)
    assert done.stderr.startswith(f"transport: {expected}")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.usefixtures("short_tasks")
def test_the_whole_command(tmp_path: Path) -> None:
    """A table for each measure, one file with results and versions, and a figure; it is resumed."""
    command = (
        *("arena", "--controller", STEADY, "--controller", LARGE, "--algorithm", "alone"),
        *("--network", "late", "--seeds", "2", "--jobs", "1", "--out", tmp_path),
    )
    done = here(*command)
    assert done.exit_code == 0, done.stderr
    assert "Completed runs" in done.stdout
    assert f"{STEADY} (version 7): tuned: nothing" in done.stdout
    refused = f"no: {LARGE}: start raised ValueError: run.share: expected a shape of 1 to"
    assert refused in done.stdout

    content = orjson.loads((tmp_path / "arena.json").read_bytes())
    assert content["arena"] == VERSION
    assert content["algorithms"][STEADY]["version"] == "7"
    assert content["tasks"]["short"]["version"] == 1
    assert content["seeds"] == 2
    assert content["networks"] == {name: [*settings] for name, settings in NETWORKS.items()}
    points = {(row["task"], row["network"], row["algorithm"]): row for row in content["points"]}
    assert points["short", PERFECT, REFERENCE]["cost_ratio"] == 1.0
    assert points["short", "late", "alone"]["completed"] == 2
    assert points["short", "late", "alone"]["cost_ratio_ci95"] is not None
    assert points["three UAVs", "late", LARGE]["refused"]
    assert points["three UAVs", "late", STEADY]["completed"] == 2
    pixels = imread(tmp_path / "figure.png")
    assert pixels.min() < pixels.max()  # something is drawn
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "| algorithm | network | short | three UAVs |" in report

    # Runs of `Large` with four UAVs: each of its steps fails. The first of two is kept.
    files = sorted((tmp_path / "ended").iterdir())
    assert [read_scenario(file).seed for file in files] == [0, 0]
    assert all(f" {file}\n" in done.stdout for file in (*files, tmp_path / "arena.json"))
    ended = [file.name for file in files]
    assert [name.partition("-tests-")[0] for name in ended] == ["short-late", "short-perfect"]
    assert all(name.endswith("test-arena-Large.toml") for name in ended)

    again = here(*command)
    runs = sum(row["flights"] for row in content["points"])
    assert f"{runs} of {runs} runs are done already" in again.stderr


def _counted(task: str, network: str, algorithm: str, ended: int, errors: int) -> PointStatistics:
    """Return a point with three runs, of which some end early and others cannot be simulated."""
    return PointStatistics(
        point=Point({"task": task, "network": network, "algorithm": algorithm}, "", ()),
        runs=3 - errors,
        completed=3 - errors - ended,
        errors=errors,
        diverged_s=(1.0,) * ended,
        numbers={"cost_mean": None},
        cost_ratio=None,
    )


@pytest.mark.parametrize("seed", range(30))
def test_tasks_that_all_complete_on_all_networks_are_one_row(seed: int) -> None:
    """A run that ends early, that fails or that is refused, anywhere, gives its task a column."""
    rng = np.random.default_rng(seed)
    tasks, networks, algorithms = ("a", "b", "c", "d"), ("perfect", "late"), ("one", "other")
    is_other = {task: rng.random() < 0.5 for task in tasks}
    measured: list[PointStatistics] = []
    refused: dict[int, str] = {}
    for task in tasks:
        points = list(product(networks, algorithms))
        odd, kind = int(rng.integers(len(points))), int(rng.integers(3))
        for index, (network, algorithm) in enumerate(points):
            is_odd = is_other[task] and index == odd
            if is_odd and kind == 2:
                refused[len(measured)] = "a reason"
            ended, errors = int(is_odd and kind == 0), int(is_odd and kind == 1)
            measured.append(_counted(task, network, algorithm, ended, errors))
    arena_runs: Any = SimpleNamespace(algorithms=dict.fromkeys(algorithms), refused=refused)
    swept: Any = SimpleNamespace(measured=measured)

    table = ArenaResult(arena_runs, swept).tables()[0]
    headings = [column.header for column in table.columns]
    expected = [task for task in tasks if is_other[task]] or list(tasks)
    assert headings == ["algorithm", "network", *expected]
    rest = [task for task in tasks if task not in expected]
    summary = [f"every one, on {', '.join(rest)}"] if rest else []
    assert [*table.columns[0].cells] == [*algorithms, *summary]


def test_each_measure_has_its_number_in_its_unit() -> None:
    """Costs over the reference's, errors in cm, distances in m, plans in kB/s, airtime in %, steps in ms.

    A cell tells how many runs complete, when the first of the others ends, and how many raised an error.
    """
    numbers = {
        "cost_mean": 0.004,
        "payload_rms_m": 0.0123,
        "separation_min_m": 0.41234,
        VIOLATION: 0.345,
        "plan_bytes_per_s": 2340.0,
        "airtime_share": 0.256,
        "cpu_step_p50_ms": 1.234,
    }
    estimates = {name: Estimate(one, None, 1, one, one) for name, one in numbers.items()}
    labels = {"task": "a", "network": "late", "algorithm": "one"}
    point = PointStatistics(
        point=Point(labels, ""),
        runs=4,
        completed=2,
        errors=1,
        diverged_s=(1.25, 3.0),
        numbers=estimates,
        cost_ratio=1.5,
    )
    refused = replace(point, point=Point({**labels, "task": "b"}, ""))
    arena_runs: Any = SimpleNamespace(algorithms={"one": None}, refused={1: "why"})
    swept: Any = SimpleNamespace(measured=[point, refused])

    rows = [
        next(iter(column.cells))
        for table in ArenaResult(arena_runs, swept).tables()
        for column in table.columns[2:]
    ]
    assert rows[::2] == ["2/4 1.2 s 1!", "1.50", "1.2", "0.412", "0.34", "2.3", "25.6", "1.23"]
    assert set(rows[1::2]) == {"no"}


def test_a_measure_of_which_some_points_have_a_number_has_a_table(tmp_path: Path) -> None:
    """The others have none in their cells, and a measure of none has no table; it is drawn in its unit."""
    some = {"payload_rms_m": 0.02, VIOLATION: None}
    measured = []
    for task, numbers in (("a", some), ("b", {})):
        estimates = {
            name: None if one is None else Estimate(one, None, 1, one, one)
            for name, one in numbers.items()
        }
        point = _counted(task, "late", "one", 0, 0)
        measured.append(replace(point, numbers={"cost_mean": None, **estimates}))
    arena_runs: Any = SimpleNamespace(algorithms={"one": None}, refused={})
    result = ArenaResult(arena_runs, SimpleNamespace(measured=measured))  # type: ignore[arg-type]
    _, error = result.tables()
    assert [next(iter(column.cells)) for column in error.columns] == ["one", "late", "2.0", "-"]

    files = result.draw("error", tmp_path)
    assert [file.name for file in files] == ["figure-error.png", "figure-error.svg"]
    drawn = files[1].read_text(encoding="utf-8")
    assert "payload error, cm rms" in drawn
    assert ">2</" in drawn or "<!-- 2 -->" in drawn  # at the scale of colours


def test_numbers_of_the_arena_alone() -> None:
    """Largest violation of own constraints, share of failed steps, and, where one agent is told, the way to the goal.

    The payload stands still 3 m and, in the last 4 s, 0.5 m off the place that agent 1 is told.
    """
    run = runs.setup(runs.ticks(200))
    fields = target_fields(run, requested(TargetSection, {"points_m": [[1.0, 0.0, -10.0]]}), 1)
    told = Outbox("coordinator", 0).stamp(Target, number=1, **{**fields, "to": (1,)})
    states = [runs.plant_state(run, k) for k in range(200)]
    for one in states:
        one.x[state.R0] = [1.0, 0.0 if one.tick < 120 else 2.5, -7.0 if one.tick < 120 else -10.0]
    for one in states[120:]:
        one.x[1] = 0.3 if one.tick % 2 else 0.7
    summary = {
        "own_constraints": [
            {"violation_max": 0.5},
            {"violation_max": None},
            {"violation_max": 2.0},
        ],
        "solver": {"failures": 40},
    }
    assert axes(run, summary, log_of([told, *states])) == {
        VIOLATION: 2.0,
        "failed_steps_share": 0.05,
        FROM_GOAL: pytest.approx(0.5),
    }
    unknown = {**summary, "own_constraints": [{"violation_max": None}]}
    assert axes(run, unknown, log_of([told, *states]))[VIOLATION] is None
    assert VIOLATION not in axes(run, {**summary, "own_constraints": []}, log_of([told, *states]))
    to_all = Outbox("coordinator", 0).stamp(Target, number=1, **fields)
    assert FROM_GOAL not in axes(run, summary, log_of([to_all, *states]))


@pytest.mark.parametrize(
    ("outcome", "from_goal_m", "expected"),
    [
        ("completed", 0.5, "completed"),
        ("completed", 0.51, "missed"),
        ("completed", None, "completed"),
        ("diverged", 9.0, "diverged"),
    ],
)
def test_a_payload_half_a_meter_from_its_goal_has_arrived(
    outcome: str, from_goal_m: float | None, expected: str
) -> None:
    """A completed run whose payload ends further away has missed; others keep their outcome."""
    result = Result(key="k", outcome=outcome, reason="", numbers={FROM_GOAL: from_goal_m})
    assert judged(result).outcome == expected


@pytest.mark.usefixtures("short_tasks")
def test_from_python() -> None:
    """A class itself enters, and its results are rows; a cost ratio is that of the mean costs."""
    result = transport.arena(
        Steady, tasks=["short"], networks=["late"], algorithms=["alone"], seeds=2, workers=1,
        progress=False,
    )  # fmt: skip
    rows = {(row["network"], row["algorithm"]): row for row in result.rows()}
    assert set(rows) == {
        (PERFECT, REFERENCE), (PERFECT, "alone"), ("late", "alone"), (PERFECT, STEADY),
        ("late", STEADY),
    }  # fmt: skip
    alone, reference = rows["late", "alone"], rows[PERFECT, REFERENCE]
    assert alone["cost_ratio"] == pytest.approx(alone["cost_mean"] / reference["cost_mean"])
    assert np.isfinite([row["plan_bytes_per_s"] for row in result.rows()]).all()
    assert result.content["points"][0]["algorithm"] == REFERENCE
    assert "Mean cost over that of" in str(result)
    assert result.notes[-1] == f"{STEADY} (version 7): tuned: nothing"
    flown = [row for row in result.rows() if row["flights"]]
    (matrix,) = result.plot().axes
    marks = [line for line in matrix.lines if line.get_marker() not in ("None", None)]
    assert [mark.get_fillstyle() for mark in marks] == ["full"] * len(flown)
    places = {str((mark.get_xdata(), mark.get_ydata())) for mark in marks}
    assert len(places) == len(flown)

    tiles = result.plot("error").axes[0].patches
    assert len(tiles) == len(flown)
    assert len({tile.get_facecolor() for tile in tiles}) == len(
        {row["payload_rms_m"] for row in flown}
    )
    with pytest.raises(
        ArgumentError, match=r"measure: expected one of cost, error, .* got 'speed'"
    ):
        result.plot("speed")


@pytest.mark.parametrize(
    "task",
    ["told", *(pytest.param(name, marks=pytest.mark.slow) for name in ("follow", "blocked"))],
)
def test_without_messages_the_payload_does_not_arrive(task: str) -> None:
    """An algorithm completes a task of which one agent knows the goal or the way, and misses it without messages."""
    result = transport.arena(
        tasks=[task], networks=["none"], algorithms=["alone"], seeds=1, workers=1, progress=False
    )
    runs = {(row["network"], row["algorithm"]): row for row in result.rows("runs")}
    outcomes = {place: row["outcome"] for place, row in runs.items()}
    assert outcomes == {
        (PERFECT, REFERENCE): "completed",
        (PERFECT, "alone"): "completed",
        ("none", "alone"): "missed",
    }
    missed = runs["none", "alone"]
    assert missed["reason"] == f"the payload ends {missed['from_goal_m']:.2f} m from its goal"
    assert runs[PERFECT, "alone"]["from_goal_m"] < 0.1


def test_the_project_says_what_was_tuned() -> None:
    """Every algorithm of the project states for which task and network it was tuned."""
    unstated = Entry().tuned
    for algorithm in BUILT_IN.values():
        assert algorithm.tuned != unstated
        assert len(algorithm.tuned) > len(unstated)


def test_a_run_that_ends_early_can_be_flown_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The scenario of a run that ended early is in the folder, and ends again in the same way at the same time."""
    result = transport.arena(
        Falling, tasks=["gusts"], networks=[PERFECT], algorithms=[REFERENCE], seeds=1, workers=1,
        folder=tmp_path, progress=False,
    )  # fmt: skip
    (row,) = (row for row in result.rows("runs") if row["outcome"] != "completed")
    (file,) = (tmp_path / "ended").iterdir()
    again = transport.fly(file, progress=False)
    assert again.outcome == row["outcome"] == "diverged"
    assert again.summary["reason"] == row["reason"]
    assert f"0/1 {row['lost_s']:.1f} s" in str(result)


@pytest.mark.usefixtures("short_tasks")
def test_a_resumed_run_that_completes_has_not_ended(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The scenario of a run that failed goes, with its folder, once the run has completed.

    The run is resumed after its result has been lost and its class mended.
    """

    def fly() -> None:
        transport.arena(
            Large, tasks=["short"], networks=[PERFECT], algorithms=[REFERENCE], seeds=1, workers=1,
            folder=tmp_path, progress=False,
        )  # fmt: skip

    fly()
    assert len(list((tmp_path / "ended").iterdir())) == 1
    (tmp_path / "results.jsonl").unlink()
    monkeypatch.setattr(Large, "start", Steady.start)  # declares no data
    fly()
    assert not (tmp_path / "ended").exists()


def digest(*content: object) -> str:
    """Return a fingerprint of settings."""
    return hashlib.sha256(repr(content).encode()).hexdigest()[:8]


# Versions with fingerprints of what they set. Results of different versions are not comparable: a change of
# settings comes with a new version of the task, and of the arena, `VERSION`.
ARENA_VERSION = (2, "b530fa09")
TASK_VERSIONS = {
    "maneuver": (1, "e1ce927f"),
    "eight": (1, "05914ef1"),
    "gusts": (1, "2d2174b2"),
    "heavier": (1, "8658b520"),
    "death": (1, "eaf2a2c9"),
    "silence": (1, "52d32a9c"),
    "shared": (1, "0f0febbf"),
    "eight UAVs": (1, "5b4a4e4e"),
    "told": (1, "7687842c"),
    "follow": (1, "c0859c1e"),
    "blocked": (1, "97873f89"),
}


def test_settings_that_change_are_a_new_version() -> None:
    """A task has the version of its settings, failures and size; scenario and networks have that of the arena."""
    found = {
        name: (task.version, digest(task.settings, task.failures, task.uavs))
        for name, task in TASKS.items()
    }
    assert found == TASK_VERSIONS
    assert (VERSION, digest(SCENARIO, list(NETWORKS.items()))) == ARENA_VERSION


def flown_in(task: str) -> Scenario:
    """Return the scenario of a task of four UAVs with its failures."""
    chosen = TASKS[task]
    return read_scenario(find_scenario(SCENARIO), [*chosen.settings, *chosen.failures])


def test_the_text_of_a_task_has_the_numbers_of_its_settings() -> None:
    """Durations, distances, speeds, weather, deaths and limits of each task are those that its text names."""
    of = {name: flown_in(name) for name, task in TASKS.items() if task.uavs == 4}
    texts = {name: task.text for name, task in TASKS.items()}
    lasting_s = {
        name: sum(phase.duration_s for phase in one.maneuver.phase) for name, one in of.items()
    }
    assert texts["maneuver"] == f"the paper's maneuver, {lasting_s['maneuver']:g} s"

    eight = of["eight"].maneuver.phase[1]
    assert eight.size_m is not None
    along_m, across_m, _ = eight.size_m
    assert texts["eight"].startswith(
        f"an eight of {along_m:g} m x {across_m:g} m at {eight.speed_mps:g} m/s"
    )

    gusts_mps = set(of["gusts"].plant.wind.gust_mps)
    assert (
        texts["gusts"] == f"hover of {lasting_s['gusts']:g} s in gusts of {gusts_mps.pop():g} m/s"
    )
    assert not gusts_mps

    _, climb, translate, rest = of["heavier"].maneuver.phase
    way_s = climb.duration_s + translate.duration_s
    excess = 100.0 * (of["heavier"].plant.payload_mass_factor - 1.0)
    assert (climb.displacement_m, translate.displacement_m) == ((0, 0, -1), (1, 0, 0))
    assert texts["heavier"] == (
        f"up and sideways by 1 m in {way_s:g} s and a hover of {rest.duration_s:g} s, with a payload "
        f"{excess:.0f} % heavier than known"
    )
    for same in ("death", "silence", "shared"):
        assert of[same].maneuver == of["heavier"].maneuver
        assert texts[same].startswith("the same path")
    assert texts["eight UAVs"] == "the same path with eight UAVs"
    assert (*TASKS["eight UAVs"].settings, TASKS["heavier"].settings[1]) == TASKS[
        "heavier"
    ].settings

    (death,) = of["death"].faults.event
    assert (death.do, death.target, of["death"].clock.on_agent_loss) == (
        "kill",
        "agent3",
        "continue",
    )
    assert f"agent 3 dies for good at {death.at_s:g} s" in texts["death"]

    system = of["shared"].system
    mass_kg = system.payload.mass_kg + sum(uav.mass_kg for uav in system.uav)
    (limit,) = of["shared"].controller.constraint
    most_N = float(limit.expression.partition("<=")[2])
    assert limit.expression.startswith("thrust1+thrust2+thrust3+thrust4<=")
    assert texts["shared"].endswith(
        f"at most {most_N:g} N, at hover {mass_kg * system.gravity_mps2:.1f} N"
    )

    first, second = of["told"].maneuver.target
    assert [first.to, second.to] == [[1], [1]]
    away_m = np.linalg.norm(np.subtract(first.points_m[0], of["told"].maneuver.start_m))
    assert texts["told"] == (
        f"a hover of {lasting_s['told']:g} s; agent 1 alone is told a target {away_m:g} m away at "
        f"{first.at_s:g} s, and another one at {second.at_s:g} s"
    )

    targets = of["follow"].maneuver.target
    assert {tuple(target.to) for target in targets} == {(1,)}
    assert np.diff([target.at_s for target in targets]) == pytest.approx([0.5] * 19)
    places_m = np.array([target.points_m[0] for target in targets])
    moved_m = np.linalg.norm(np.diff(places_m, axis=0), axis=1)
    assert moved_m / 0.5 == pytest.approx([1.0] * 19, abs=4e-3)  # places are in mm
    assert texts["follow"].startswith("a platform at 1 m/s with random turns: every half second")

    (wall,) = of["blocked"].obstacle
    way = of["blocked"].maneuver.phase[1]
    assert way.points_m is not None
    assert texts["blocked"] == (
        f"{way.points_m[-1][0]:g} m at {way.speed_mps:g} m/s past a wall that no agent knows before its own "
        f"UAV is within {wall.seen_within_m:g} m"
    )


def test_the_origin_of_a_report_is_told_by_its_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A single seed has no spread; reasons that are the same are one sentence with all places, in their order."""
    monkeypatch.setattr("transport.experiments.arena.arena_report.versions", lambda: "python 3")
    monkeypatch.setattr("transport.experiments.arena.arena_report.machine", lambda: "a machine")
    tuned: Any = SimpleNamespace(version="", tuned="nothing")
    for seeds, told in ((1, "1 seed of each"), (2, "2 seeds of each random run, ±")):
        points = [_counted(task, "late", "one", 0, 0) for task in ("a", "b", "c")]
        arena_runs: Any = SimpleNamespace(
            algorithms={"one": tuned}, refused={0: "why", 1: "because", 2: "why"}, seeds=seeds
        )
        result = ArenaResult(arena_runs, SimpleNamespace(measured=points))  # type: ignore[arg-type]
        lines = result.markdown().splitlines()
        assert lines[-1].startswith(f"*Arena {VERSION}, {told}")
        assert lines[-1].endswith("; python 3; machine: a machine*")
        assert lines[-6:-2] == [
            "- one: tuned: nothing",
            "- no: one: because: b on late",
            "- no: one: why: a on late, c on late",
            f"- late: {NETWORK_TEXTS['late']}",
        ]


def test_an_obstacle_known_by_sight_alone_has_a_goal() -> None:
    """The way to the goal is a number of a run in which obstacles have to be seen, and of no other."""
    wall = "obstacle=[{{kind='sphere',at_m=[9.0,0.0,-10.0],radius_m=0.5,margin_m=0.3{}}}]"
    summary = {"own_constraints": [], "solver": {"failures": 0}}
    for seen, has_goal in ((",seen_within_m=1.2", True), ("", False)):
        run = runs.setup(runs.ticks(100), wall.format(seen))
        states = [runs.plant_state(run, k) for k in range(100)]
        assert (FROM_GOAL in axes(run, summary, log_of(states))) is has_goal
