"""Teams of increasing size: the sweep, resource use of a run, fitted growth, and the whole command."""

import csv
import io
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace as edited
from rich.console import Console

from protocol.scenario.setup import Setup
from protocol.wire.messages import STAGES, Control, Message, StepReport, Tick
from tests.support.results import here, kept
from tests.support.runs import ticks
from transport.experiments import design_experiments
from transport.experiments.cases import Point, cases_of
from transport.experiments.conclusions import exponent, scaling_conclusions
from transport.experiments.declaration import EXPERIMENTS
from transport.experiments.figures import draw
from transport.experiments.simulation import CPU, ERROR, MESSAGES, NUMBERS, RESOURCES, Result, resource_use
from transport.experiments.simulation import simulate as simulate_case
from transport.experiments.statistics import WIDTH, PointStatistics, statistics_of, table_of
from transport.flight.memory import simulate
from transport.log.run_log import Recorded, RunLog

DONE, USAGE, SCENARIO = 0, 2, 3
SIZES = EXPERIMENTS["scaling"].options["sizes"].default
TICKS = 4
PERIOD_S = 0.05
SMALL = ("experiment", "scaling", "--quick", "--max", "4", "--set", ticks(TICKS))
FLIGHTS = 5  # 2 and 4 UAVs distributed and centralized, 4 in pairs

# Rounding error of an exponent that synthetic data have exactly.
ROUNDING = 1e-12


def simulated(uavs: int, ownership: str) -> tuple[Setup, list[Message]]:
    """Return a short run of a team, and all its messages."""
    experiment = design_experiments.scaling(uavs, [])
    (case,) = (
        case
        for case in cases_of(experiment.points, [ticks(TICKS)], 1)
        if experiment.points[case.point].labels["ownership"] == ownership
    )
    setup, messages = Setup.of(case.scenario, case.source), list[Message]()
    simulate(setup, messages.append)
    return setup, messages


def logged(messages: list[Message], received_ns: Callable[[Message], int] = lambda _: 0) -> RunLog:
    """Return a log of messages."""
    recorded = tuple(Recorded(message=message, received_ns=received_ns(message)) for message in messages)
    return RunLog(header={}, messages=recorded, cut="")


@pytest.mark.slow
def test_sizes_and_ownerships() -> None:
    """Sizes go up to the largest team requested, also an unusual one; pairs exist only for even numbers above two."""
    points = design_experiments.scaling(9, SIZES).points
    sizes = {
        name: [point.labels["uavs"] for point in points if point.labels["ownership"] == name]
        for name in design_experiments.OWNERSHIPS
    }
    every = [2, 3, 4, 6, 8, 9]
    assert sizes == {"distributed": every, "pairs": [4, 6, 8], "centralized": every}
    for point, case in zip(points, cases_of(points, [], 1, timed=True), strict=True):
        assert len(case.scenario.system.uav) == point.labels["uavs"]
        assert len(case.scenario.owned) == point.labels["agents"]
        assert case.timed


# Bytes of a plan by docs/protocol.md and the msgpack specification, for identities, ticks and sequences below 128.
# One byte each: version, list of 14, incarnation, sequence, tick, agent, start tick, negotiation.
HEADS, SHARED = 8, 1
KIND, SENDER, STATUS = 1 + len("plan"), 1 + len("agent1"), 1 + len("solved")
STATES, INPUTS, HORIZON, FLOAT, ARRAY = 12, 4, 20, 8, 16


def bytes_of_plan(owned: int) -> int:
    """Return the bytes of a plan for some UAVs over the horizon, with corrections."""

    def extension(size: int) -> int:
        return size + (3 if size < 256 else 4)  # type and tag, and one byte of length or two

    states = extension(ARRAY + FLOAT * STATES * owned)
    sequence = extension(ARRAY + FLOAT * HORIZON * INPUTS * owned)
    return HEADS + KIND + SENDER + STATUS + SHARED + (1 + owned) + states + 2 * sequence


@pytest.mark.parametrize(
    ("uavs", "ownership", "owned"), [(3, "distributed", 1), (4, "pairs", 2), (2, "centralized", 2)]
)
def test_bytes_are_those_of_the_protocol(uavs: int, ownership: str, owned: int) -> None:
    """Each agent's plan goes to each other agent once a tick; its bytes are those of the documented layout."""
    setup, messages = simulated(uavs, ownership)
    found = resource_use(setup, logged(messages))
    agents = uavs // owned
    assert found["plan_bytes"] == bytes_of_plan(owned)
    assert found["plans_per_tick"] == agents * (agents - 1)
    assert found["plan_bytes_per_s"] == pytest.approx(agents * (agents - 1) * bytes_of_plan(owned) / PERIOD_S)


def test_computation_is_summed_over_the_team() -> None:
    """Times are median and tail over all steps, sums over a tick's steps, and the duration from the first tick."""
    setup, messages = simulated(3, "distributed")
    # Agent i takes i ms to solve and in total; agent 3 takes a second for its last tick.
    slow_ms, per_message_ns = 1_000.0, 1_000_000

    def timed(message: Message) -> Message:
        if not isinstance(message, StepReport):
            return message
        times_ms = np.zeros(len(STAGES))
        last = message.agent == 3 and message.tick == TICKS - 1
        times_ms[[STAGES.index("solve"), STAGES.index("total")]] = slow_ms if last else message.agent
        return edited(message, times_ms=times_ms)

    messages = [timed(message) for message in messages]
    at = {id(message): per_message_ns * i for i, message in enumerate(messages)}
    found = resource_use(setup, logged(messages, lambda message: at[id(message)]))
    steps_ms = [1.0] * TICKS + [2.0] * TICKS + [3.0] * (TICKS - 1) + [slow_ms]
    assert found["cpu_step_p50_ms"] == found["cpu_solve_p50_ms"] == 2.0
    assert found["cpu_step_p99_ms"] == pytest.approx(np.percentile(steps_ms, 99.0))
    assert found["cpu_condense_p50_ms"] == 0.0
    assert found["cpu_team_tick_ms"] == pytest.approx(sum(steps_ms) / TICKS)
    first = next(i for i, message in enumerate(messages) if isinstance(message, Tick))
    end = next(i for i, message in enumerate(messages) if isinstance(message, Control))
    assert found["cpu_flight_s_per_s"] == pytest.approx((end - first) * 1e-3 / (TICKS * PERIOD_S))


def test_the_stopwatch_is_the_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processor time excludes waiting: a delayed process uses no more of it."""
    waited_ms = 50.0
    case = cases_of(design_experiments.scaling(2, []).points, [ticks(TICKS)], 1, timed=True)[0]
    monkeypatch.setattr("mpc.controller.Controller.solve", _held_up(waited_ms / 1e3))
    numbers = simulate_case(case).numbers
    assert set(numbers) == {*NUMBERS, *RESOURCES}
    assert 0.0 < (numbers["cpu_solve_p50_ms"] or 0.0) < waited_ms / 2.0


def _held_up(seconds: float) -> Callable[..., object]:
    import time

    from mpc.controller import Controller

    whole = Controller.solve

    def solve(self: Controller, *arguments: object) -> object:
        time.sleep(seconds)
        return whole(self, *arguments)  # type: ignore[arg-type]

    return solve


@pytest.mark.parametrize("power", [0.0, 1.0, 1.7, 3.0])
def test_exponent_of_a_power_law(power: float) -> None:
    """The slope of a power law is its exponent, whatever the unit."""
    uavs = [4, 6, 8, 10, 12]
    assert exponent(uavs, [0.3 * n**power for n in uavs]) == pytest.approx(power, abs=ROUNDING)


SCALING = design_experiments.scaling(16, SIZES)


def made(results: Callable[[Point], list[Result]]) -> list[PointStatistics]:
    """Return the statistics of the points, with invented results."""
    return statistics_of(SCALING.points, [results(point) for point in SCALING.points], (*NUMBERS, *RESOURCES)[1:])


def invented(point: Point) -> list[Result]:
    """A run with growth of known powers, except at team sizes that are not fitted."""
    uavs, is_central = int(point.labels["uavs"]), point.labels["ownership"] == "centralized"
    outside = 1.0 if 4 <= uavs <= 12 else 7.0
    numbers: dict[str, float | None] = dict.fromkeys((*NUMBERS, *RESOURCES), 0.5)
    numbers |= {"lost_s": None, "cost_mean": uavs * (1.0 if is_central else 1.5)}
    numbers |= {"cpu_step_p50_ms": outside * uavs ** (3.0 if is_central else 1.25)}
    numbers |= {"cpu_team_tick_ms": outside * uavs ** (3.0 if is_central else 2.25)}
    numbers |= {"plan_bytes_per_s": 0.0 if is_central else outside * 1e3 * uavs**2}
    return [Result(key="k", outcome="completed", reason="", numbers=numbers)]


def test_conclusions_name_the_growth() -> None:
    """Conclusions give the exponents from 4 to 12 UAVs, omit missing values, and compare the largest team."""
    lines = scaling_conclusions(made(invented))
    assert lines[0] == (
        "distributed: completes all 8 points (8 of 8 runs); "
        "CPU of an agent's step grows as N^1.25 from 4 to 12 UAVs (5.66 to 22.3 ms); "
        "CPU of the team per tick grows as N^2.25 from 4 to 12 UAVs (22.6 to 268 ms); "
        "volume of plans grows as N^2.00 from 4 to 12 UAVs (16 to 144 kB/s)"
    )
    assert lines[2] == (
        "centralized: completes all 8 points (8 of 8 runs); "
        "CPU of an agent's step grows as N^3.00 from 4 to 12 UAVs (64 to 1730 ms); "
        "CPU of the team per tick grows as N^3.00 from 4 to 12 UAVs (64 to 1730 ms)"
    )
    assert lines[3] == "distributed against centralized, 16 UAVs: CPU of an agent's step x0.00781, cost x1.50"
    assert len(lines) == 5


def _diverged(point: Point) -> list[Result]:
    numbers: dict[str, float | None] = dict.fromkeys((*NUMBERS, *RESOURCES), 0.5)
    return [Result(key="k", outcome="diverged", reason="", numbers=numbers)]


def _times(factor: float, results: list[Result]) -> list[Result]:
    """Return results on a slower machine."""
    return [
        replace(result, numbers={name: factor * (value or 0.0) for name, value in result.numbers.items()})
        for result in results
    ]


MIXES: dict[str, Callable[[Point], list[Result]]] = {
    "completed": invented,
    "repeated": lambda point: 3 * invented(point),
    "unsure": lambda point: [*invented(point), *_times(3.0, invented(point))],
    "some diverged": lambda point: _diverged(point) if point.labels["uavs"] == 16 else invented(point),
    "all diverged": _diverged,
    "errors": lambda _: [Result(key="k", outcome=ERROR, reason="why", numbers={})],
}


@pytest.mark.parametrize("mix", MIXES)
def test_anything_can_be_reported(mix: str, tmp_path: Path) -> None:
    """Every mix of outcomes gives sentences, a figure, and a table that fits its width."""
    measured = made(MIXES[mix])
    assert len(scaling_conclusions(measured)) == 5
    files = [path.read_bytes() for path in draw(SCALING, measured, tmp_path)]
    assert files[0].startswith(b"\x89PNG\r\n\x1a\n")
    assert [path.read_bytes() for path in draw(SCALING, measured, tmp_path)] == files
    console = Console(width=WIDTH, record=True, file=io.StringIO())
    console.print(table_of("scaling", measured, timed=True))
    text = console.export_text()
    assert "…" not in text
    assert max(len(line.rstrip()) for line in text.splitlines()) <= WIDTH


REFUSED = [
    (("--max", "1"), USAGE, "--max: expected a number of UAVs from 2 to 16, got 1"),
    (("--max", "17"), USAGE, "--max: expected a number of UAVs from 2 to 16, got 17"),
    (("--max", "many"), USAGE, "invalid value for '--max'"),
    (("--jobs", "0"), USAGE, "--jobs"),
    (("--set", "controller.horizon=0"), SCENARIO, "--set controller.horizon=0: expected a number >= 1, got 0"),
    (
        ("--set", "system.uav.2.mass_kg=1.6"),
        SCENARIO,
        "--set system.uav.2.mass_kg=1.6: expected a key that every team has, got one of a single team",
    ),
    (
        ("--set", "agents.owned=[[1,2],[3,4]]"),
        SCENARIO,
        "--set agents.owned=[[1,2],[3,4]]: expected a key that every team has",
    ),
    (
        ("--set", "links.override=[{from='agent3',to='agent1',loss=0.1}]"),
        SCENARIO,
        "2 UAVs distributed: links.override",
    ),
]


@pytest.mark.parametrize(("arguments", "code", "expected"), REFUSED, ids=[" ".join(row[0]) for row in REFUSED])
def test_what_cannot_be_is_refused(
    arguments: tuple[str, ...], code: int, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bad option ends with its exit code, expected and got; no run starts and no folder appears."""
    monkeypatch.chdir(tmp_path)
    result = here("experiment", "scaling", *arguments)
    assert result.exit_code == code, result.output
    assert expected in " ".join(result.stderr.replace("│", " ").split())
    assert result.stdout == ""
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return a trial with one run at a time, and its output."""
    folder = tmp_path_factory.mktemp("scaling") / "one"
    result = here(*SMALL, "--out", folder)
    assert result.exit_code == DONE, result.output
    assert "--quick: a trial, no measurement" in result.stderr
    return folder, result.stdout


def test_a_trial_is_whole(trial: tuple[Path, str]) -> None:
    """Files, rows, table and sentences of a trial; the caption names the maneuver."""
    folder, printed = trial
    names = {"experiment.json", "results.jsonl", "points.csv", "cases.csv", "figure.png", "figure.svg"}
    assert {path.name for path in folder.iterdir()} == names
    assert kept(folder) == FLIGHTS
    with (folder / "cases.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["ownership"], row["uavs"], row["outcome"]) for row in rows] == [
        (ownership, uavs, "completed")
        for ownership, sizes in (("distributed", "24"), ("pairs", "4"), ("centralized", "24"))
        for uavs in sizes
    ]
    for row in rows:
        assert all(float(row[name]) >= 0.0 and math.isfinite(float(row[name])) for name in MESSAGES)
        assert all(float(row[name]) > 0.0 for name in CPU)
    table, _, rest = printed.partition("\n\n")
    assert "(trial, no measurement)" in table
    assert "0.2 s of hover" in table
    assert max(len(line.rstrip()) for line in table.splitlines()) <= WIDTH
    assert "pairs: completes all 1 points (1 of 1 runs)" in rest
    assert "distributed against centralized, 4 UAVs: CPU of an agent's step x" in rest
    assert "machine: " in rest
