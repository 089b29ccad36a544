"""The commands: what is refused before anything flies, what a flight that fails does, what is printed."""

from collections.abc import Callable
from pathlib import Path

import orjson
import pytest

from tests.support.results import here, kept, tables
from tests.support.runs import ticks
from transport.experiments.result_tables import WIDTH
from transport.experiments.run_numbers import NUMBERS
from transport.flight import memory
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Control

DONE, USAGE, SCENARIO, LOST, CASES = 0, 2, 3, 4, 7

REFUSED = [
    (
        ("latency", "--delay", "-0.1"),
        SCENARIO,
        "links.delay_s=-0.1: expected greater than or equal to 0, got -0.1",
    ),
    (("latency", "--jobs", "0"), USAGE, "--jobs"),
    (("latency", "--seeds", "0"), USAGE, "--seeds"),
    (
        ("kill", "--scenario", "paper", "--scenario", "paper"),
        USAGE,
        "--scenario: expected each value once",
    ),
    (
        ("loss", "--burst", "0.5"),
        USAGE,
        "invalid value for '--burst': expected greater than or equal to 1, got '0.5'",
    ),
    (("paper", "--gust", "-1"), USAGE, "--gust: expected a speed >= 0 m/s, got -1"),
    (
        ("paper", "--set", "agents.owned=[[1],[2,3,4]]"),
        SCENARIO,
        "agents.owned=[[1],[2,3,4]]: expected one agent that owns all, got 2",
    ),
    (
        ("paper", "--set", "controller.horizon=0"),
        SCENARIO,
        "controller.horizon=0: expected greater than or equal to 1",
    ),
    (("ablation", "--set", "clock.mode=realtime"), SCENARIO, "clock."),
    (("latency", "--scenario", "papr"), SCENARIO, "did you mean 'paper'?"),
    (
        ("latency", "--set", "links.los=1"),
        SCENARIO,
        "links.los=1: unknown key; did you mean 'loss'?",
    ),
    (
        ("latency", "--set", "clock={mode='realtime',speed=1.0}"),
        SCENARIO,
        "clock.mode: expected lockstep, got realtime",
    ),
    (
        ("latency", "--dask", "tcp://host:8786", "--jobs", "2"),
        USAGE,
        "--dask: expected only one of --dask and --jobs",
    ),
    (
        ("latency", "--dask", "nowhere"),
        USAGE,
        "--dask: expected an address such as tcp://host:8786, got 'nowhere'",
    ),
]


@pytest.mark.parametrize(
    ("arguments", "code", "expected"), REFUSED, ids=[" ".join(row[0]) for row in REFUSED]
)
def test_what_cannot_be_is_refused(
    arguments: tuple[str, ...],
    code: int,
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A bad option ends with its exit code and option, expected and got.

    Nothing is flown and nothing appears.
    """
    monkeypatch.chdir(tmp_path)
    result = here("experiment", *arguments)
    assert result.exit_code == code, result.output
    assert expected in result.stderr
    assert result.stdout == ""
    assert list(tmp_path.iterdir()) == []


def test_a_missing_scheduler_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An address without a scheduler gives exit code 4; earlier results are kept."""
    monkeypatch.setattr("transport.experiments.workers._ANSWER_S", 0.5)
    result = here("experiment", "latency", "--dask", "tcp://127.0.0.1:9", "--out", tmp_path / "out")
    assert result.exit_code == LOST
    assert "--dask: expected a scheduler at tcp://127.0.0.1:9, got no answer" in result.stderr
    assert kept(tmp_path / "out") == 0


LATE = (
    "experiment",
    "latency",
    "--scenario",
    "resilient",
    "--delay",
    "0.1",
    "--set",
    ticks(4),
    "--jobs",
    "1",
)


def failing(when: Callable[[Setup], bool], monkeypatch: pytest.MonkeyPatch) -> None:
    """Let simulations raise."""
    whole = memory.simulate

    def simulate(setup: Setup, *arguments: object, **options: object) -> Control:
        if when(setup):
            raise RuntimeError("the wing\nfell off")
        return whole(setup, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(memory, "simulate", simulate)


def test_a_case_that_raises_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The others are simulated, the row gives the reason, the exit code is 7.

    Resuming repeats that case only.
    """
    with monkeypatch.context() as patch:
        failing(lambda setup: setup.scenario.links.delay_s == 0.0, patch)
        result = here(*LATE, "--out", tmp_path / "out")
    assert result.exit_code == CASES
    assert "a run raised an error: RuntimeError: the wing fell off" in result.stderr
    assert "0/0 1!" in result.stdout
    assert "1 run could not be simulated" in result.stdout
    points, cases = tables(tmp_path / "out")
    assert (
        b"resilient,0.0,0,error,RuntimeError: the wing fell off" + b"," * len(NUMBERS) + b"\n"
        in cases
    )
    assert b"resilient,0.0,0,0,1,,," in points
    result = here(*LATE, "--out", tmp_path / "out")
    assert result.exit_code == DONE, result.output
    assert "1 of 2 runs are done already" in result.stderr
    assert kept(tmp_path / "out") == 3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kill", "matrix", "sharing"])
def test_a_trial_says_so(name: str, tmp_path: Path) -> None:
    """`--quick` of an experiment runs, is called a trial, and its table fits its width."""
    settings = (
        "--set",
        ticks(4),
        "--seeds",
        "1",
        "--jobs",
        "1",
        "--scenario",
        "resilient",
    )
    result = here("experiment", name, "--quick", *settings, "--out", tmp_path)
    assert result.exit_code == DONE, result.output
    assert "--quick: a trial, no measurement" in result.stderr
    assert "(trial, no measurement)" in result.stdout
    table = result.stdout.partition("\n\n")[0].splitlines()
    assert max(len(line.rstrip()) for line in table) <= WIDTH
    assert "…" not in "".join(table)
    assert "resilient: completes" in result.stdout
    assert "machine: " in result.stdout
    for file in ("points.csv", "cases.csv", "figure.png", "figure.svg", "report.md"):
        assert f" {tmp_path / file}\n" in result.stdout
        assert (tmp_path / file).stat().st_size > 0
    assert orjson.loads((tmp_path / "experiment.json").read_bytes())["experiment"] == name
