"""The arena: its combinations, entries of the user, tables, and resumption."""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import numpy as np
import orjson
import pytest

import transport
from tests.support.results import here
from transport.agent.own_run import Run
from transport.experiments import arena_tasks
from transport.experiments.arena import arena
from transport.experiments.arena_entries import BUILT_IN, REFERENCE, entered
from transport.experiments.arena_tasks import NETWORK_TEXTS, NETWORKS, PERFECT, TASKS, Task
from transport.experiments.cases import ExperimentError
from transport.model.arrays import Array

SHORT = (
    "maneuver.phase=[{name='hover',duration_s=0.3,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=0.3,displacement_m=[0,0,-0.2]}]"
)


class Steady:
    """Inputs of hover, which enters the arena."""

    version = "7"
    arena = {  # noqa: RUF012
        "tuned": "nothing",
        "settings": ["controller.received_plans=by_age"],
    }

    def start(self, run: Run) -> None:
        """Keep the inputs of hover."""
        self.u = run.u_hover.reshape(-1, 4)[list(run.owned)].ravel()

    def step(self, measurement: object, messages: object) -> Array:
        """Return them."""
        return self.u

    def stop(self) -> None:
        """Nothing is open."""


class Large(Steady):
    """Data of the whole team over the horizon, too many for eight UAVs."""

    def start(self, run: Run) -> None:
        """Declare them."""
        super().start(run)
        run.share((run.horizon, 4 * run.system.N))


STEADY = f"{__name__}:Steady"


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Replace the tasks by two short ones."""
    tasks = {
        "short": Task(text="0.6 s", settings=(SHORT,)),
        "eight UAVs": Task(text="0.6 s of eight", settings=(SHORT,), uavs=8),
    }
    for module in ("arena", "arena_report", "arena_tasks"):
        monkeypatch.setattr(import_module(f"transport.experiments.{module}"), "TASKS", tasks)
    return iter(())


def test_every_combination_is_there() -> None:
    """Every algorithm is on every task and network, one agent for all on the perfect one only."""
    made = arena(algorithms=["paper"])
    labels = [tuple(point.labels.values()) for point in made.experiment.points]
    expected = {(task, net, "paper") for task in TASKS for net in NETWORKS}
    expected |= {(task, PERFECT, REFERENCE) for task in TASKS}
    assert len(labels) == len(set(labels))
    assert set(labels) == expected
    assert made.refused == {}
    assert set(NETWORK_TEXTS) == set(NETWORKS)


def test_algorithms_differ_in_their_controller_only() -> None:
    """Tasks fix system, weights, limits, plant and faults: the same for every algorithm."""
    made = arena(tasks=["death", "shared"])
    for task in ("death", "shared"):
        rest = set()
        for case in made.cases:
            labels = made.experiment.points[case.point].labels
            if labels["task"] != task or labels["network"] != PERFECT:
                continue
            tree = case.scenario.tree()
            controller = tree["controller"]
            of_task = {key: controller[key] for key in ("weights", "limits", "separation")}
            constraint = controller.get("constraint")
            rest.add(str([tree["system"], tree["maneuver"], tree["plant"], of_task, constraint]))
            is_spared = str(labels["algorithm"]).startswith("centralized")
            assert bool(tree["faults"]["event"]) == (task == "death" and not is_spared)
        assert len(rest) == 1


def test_the_silence_cuts_all_agents_apart() -> None:
    """No message passes between any two agents."""
    (case,) = (
        case
        for case in arena(tasks=["silence"], networks=[PERFECT], algorithms=["paper"]).cases
        if len(case.scenario.owned) > 1
    )
    for partition in case.scenario.links.partition:
        assert partition.end_s - partition.start_s == 5.0
    sides = [partition.between for partition in case.scenario.links.partition]
    assert sides == [["agent1"], ["agent2"], ["agent3"]]


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
def test_an_entry_changes_its_controller_only(
    attribute: dict[str, object], expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What belongs to the task is refused, in one line that names the class."""
    monkeypatch.setattr(Steady, "arena", attribute)
    with pytest.raises(ExperimentError, match=f"--controller {STEADY}: ") as refused:
        entered(STEADY)
    assert expected in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--task", "manoeuvre"), "--task: expected one of maneuver, eight, "),
        (("--network", "none"), "--network: expected one of perfect, late, bursts, radio, got"),
        (("--algorithm", "mine"), "--algorithm: expected one of centralized, "),
        (("--controller", "none:Mine"), "--controller none:Mine: its import from "),
        (("--dask", "nowhere"), "--dask: expected an address"),
    ],
)
def test_what_cannot_be_is_refused(options: tuple[str, ...], expected: str) -> None:
    """Before anything is flown, with the names that there are."""
    done = here("arena", *options)
    assert done.exit_code in (2, 3)
    assert done.stderr.startswith(f"transport: {expected}")
    assert len(done.stderr.splitlines()) == 1


def test_the_whole_command(short: None, tmp_path: Path) -> None:
    """A table for each measure, one file with results and versions, and a figure; it is resumed."""
    options = ("arena", "--controller", STEADY, "--controller", f"{__name__}:Large")
    chosen = ("--algorithm", "alone", "--network", "late", "--seeds", "2", "--jobs", "1")
    out = ("--out", tmp_path)
    done = here(*options, *chosen, *out)
    assert done.exit_code == 0, done.stderr
    assert "Completed runs" in done.stdout
    assert f"{STEADY} (version 7): tuned: nothing" in done.stdout
    refused = f"no: {__name__}:Large: start raised ValueError: run.share: expected a shape of 1 to"
    assert refused in done.stdout

    content = orjson.loads((tmp_path / "arena.json").read_bytes())
    assert content["arena"] == arena_tasks.VERSION
    assert content["algorithms"][STEADY]["version"] == "7"
    assert content["tasks"]["short"]["version"] == 1
    points = {(row["task"], row["network"], row["algorithm"]): row for row in content["points"]}
    assert points["short", PERFECT, REFERENCE]["cost_ratio"] == 1.0
    assert points["short", "late", "alone"]["completed"] == 2
    assert points["short", "late", "alone"]["cost_ratio_ci95"] is not None
    assert points["eight UAVs", "late", f"{__name__}:Large"]["refused"]
    assert points["eight UAVs", "late", STEADY]["completed"] == 2
    assert (tmp_path / "figure.png").stat().st_size > 1000
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "| algorithm | network | short | eight UAVs |" in report

    # Its step returns no data: every one fails.
    ended = [file.name for file in sorted((tmp_path / "ended").iterdir())]
    assert [name.partition("-tests-")[0] for name in ended] == ["short-late", "short-perfect"]
    assert all(name.endswith("test-arena-Large.toml") for name in ended)
    again = here(*options, *chosen, *out)
    runs = sum(row["flights"] for row in content["points"])
    assert f"{runs} of {runs} runs are done already" in again.stderr


def test_from_python(short: None) -> None:
    """A class itself enters, and its results are rows; a cost ratio has the interval of the cost."""
    result = transport.arena(
        Steady, tasks=["short"], networks=["late"], algorithms=["alone"], seeds=2, workers=1,
        progress=False,
    )  # fmt: skip
    rows = {(row["network"], row["algorithm"]): row for row in result.rows()}
    assert set(rows) == {
        (PERFECT, REFERENCE), (PERFECT, "alone"), ("late", "alone"), (PERFECT, STEADY),
        ("late", STEADY),
    }  # fmt: skip
    ratio = rows["late", "alone"]["cost_ratio"]
    assert ratio == pytest.approx(
        rows["late", "alone"]["cost_mean"] / rows[PERFECT, REFERENCE]["cost_mean"]
    )
    assert np.isfinite([row["plan_bytes_per_s"] for row in result.rows()]).all()
    assert result.content["points"][0]["algorithm"] == REFERENCE
    assert "Mean cost over that of" in str(result)
    assert result.notes[-1] == f"{STEADY} (version 7): tuned: nothing"
    assert len(result.plot().axes) == 6


def test_the_project_says_what_was_tuned() -> None:
    """Every algorithm of the project states it."""
    assert all(len(one.tuned) > 10 for one in BUILT_IN.values())


class Falling(Steady):
    """No thrust: the team falls out of the allowed distance from the reference."""

    def start(self, run: Run) -> None:
        """Switch the motors off."""
        super().start(run)
        self.u = 0.0 * self.u


def test_a_run_that_ends_early_can_be_flown_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Its scenario is in the folder, and ends at the same time with the same reason."""
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
