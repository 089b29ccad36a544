"""`transport log`: description of whole and cut logs, and tables that read back bit for bit."""

import csv
import json
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from msgspec import structs
from typer.testing import CliRunner, Result

from tests.support import logs, runs
from transport.cli.main import app
from transport.log.run_log import read_log, topic_of
from transport.log.tables import INPUT_NAMES, RATE_NAMES, tables
from transport.log.writer import LogWriter
from transport.model import state
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import (
    KINDS,
    Airtime,
    Message,
    Note,
    Plan,
    PlantState,
    StepReport,
    Target,
)

KILL = (
    *(
        "clock.on_agent_loss='continue'",
        "controller.prediction='closed_loop'",
        "controller.relaxation='auto'",
    ),
    "faults.event=[{at_s=0.5,do='kill',target='agent3'},{at_s=0.2,do='degrade',target='uav4',efficiency=0.9}]",
)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Message]]:
    """A run folder and its messages."""
    folder = tmp_path_factory.mktemp("log") / "run"
    return folder, logs.record_run(runs.setup(runs.SHORT, *KILL), folder)


def ask(*arguments: str | Path) -> Result:
    """Run the command in this process."""
    return CliRunner().invoke(app, ["log", *map(str, arguments)])


def info(path: Path) -> dict[str, object]:
    """Return the JSON description of a log."""
    result = ask("info", path, "--format", "json")
    assert result.exit_code == 0, result.output
    content: dict[str, object] = json.loads(result.stdout)
    return content


def rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV table."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_whole_log(flight: tuple[Path, list[Message]]) -> None:
    """A whole log has nothing lost; channels, counts and ticks are those of the messages."""
    folder, messages = flight
    content = info(folder)
    assert content["complete"] is True
    assert content["lost"] == []
    assert (content["last_tick"], content["ticks_of_the_run"]) == (29, 30)
    assert content["messages"] == len(messages)
    by_topic: dict[str, list[Message]] = {}
    for message in messages:
        by_topic.setdefault(topic_of(message), []).append(message)
    assert content["channels"] == [row_of(topic, by_topic[topic]) for topic in sorted(by_topic)]
    assert len(by_topic["/plan/3"]) == 10  # killed at tick 10
    assert content["bytes"] == (folder / "run.mcap").stat().st_size
    assert (content["scenario"], content["outcome"], content["reason"]) == (
        "paper",
        "completed",
        "",
    )
    assert "complete" in ask("info", folder / "run.mcap").output


def row_of(topic: str, messages: list[Message]) -> dict[str, object]:
    """Return the description of the messages of a topic."""
    ticks = [message.tick for message in messages]
    return {
        "topic": topic,
        "messages": len(messages),
        "mean_bytes": round(np.mean([len(encode(message)) for message in messages])),
        "first_tick": min(ticks),
        "last_tick": max(ticks),
    }


def write(messages: Sequence[Message], folder: Path) -> None:
    """Write the log of a run, without its scenario."""
    with closing(LogWriter(folder / "run.mcap", logs.HEADER, period_ns=50_000_000)) as writer:
        for number, message in enumerate(messages):
            writer.write(message, number * logs.MILLISECOND_NS)


def test_a_log_without_a_scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is described with its gaps, and has tables; a bag needs the run."""
    monkeypatch.chdir(tmp_path)
    run = runs.setup()
    states: list[Message] = [
        structs.replace(runs.plant_state(run, tick), sequence=tick) for tick in (2, 5, 9)
    ]
    end = structs.replace(runs.end(12), outcome="diverged", reason="too far", sequence=0)
    write([*states, end], tmp_path)
    content = info(tmp_path)
    assert content["channels"] == [row_of("/control", [end]), row_of("/plant_state", states)]
    assert (content["outcome"], content["reason"], content["last_tick"]) == (
        "diverged",
        "too far",
        12,
    )
    assert (content["scenario"], content["ticks_of_the_run"]) == (None, None)
    assert [content[name] for name in ("run_id", "versions", "machine")] == [
        logs.HEADER[name] for name in ("run_id", "versions", "machine")
    ]
    gap = "some messages of ticks 0 to 9 did not reach the recorder"
    assert (content["complete"], content["lost"]) == (False, [gap])
    described = [" ".join(line.split()) for line in ask("info", tmp_path).stdout.splitlines()]
    assert f"lost {gap}" in described
    assert any(line.startswith("/plant_state 3 ") for line in described)

    for _ in range(2):  # into a folder that there may be
        exported = ask("export", tmp_path, "--out", "new/tables", "--kind", "plant_state")
        assert exported.stderr == f"warning: {gap}\n"
        assert exported.stdout == " new/tables/plant_state.csv  3 rows\n"
    assert [path.name for path in Path("new/tables").iterdir()] == ["plant_state.csv"]
    refused = ask("export", tmp_path, "--ros2", "bag.mcap")
    assert (refused.exit_code, refused.stdout) == (2, "")
    assert refused.stderr.startswith("transport: --ros2: ")
    assert refused.stderr.endswith("run.mcap has no scenario, or one of another version\n")


def test_a_log_without_messages(tmp_path: Path) -> None:
    """It has no last tick, and no table of topics."""
    write([], tmp_path)
    content = info(tmp_path)
    assert (content["messages"], content["last_tick"], content["channels"]) == (0, None, [])
    assert "topic" not in ask("info", tmp_path).stdout


def test_tables_and_bag_are_counted(
    flight: tuple[Path, list[Message]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A table in rows, a bag in ticks."""
    bag = SimpleNamespace(write_bag=lambda *_: 30)
    monkeypatch.setitem(sys.modules, "transport.report.ros2_bag", bag)
    words = ("--out", tmp_path, "--kind", "roster", "--ros2", tmp_path / "bag.mcap")
    files = json.loads(ask("export", flight[0], *words, "--format", "json").stdout)["files"]
    rosters = sum(message.kind == "roster" for message in flight[1])
    assert files == [
        {"file": str(tmp_path / "roster.csv"), "rows": rosters},
        {"file": str(tmp_path / "bag.mcap"), "ticks": 30},
    ]

    def full(*_: object) -> int:
        raise OSError(28, "full", "a file")

    bag.write_bag = full
    for option, place in (("--ros2", "bag.mcap"), ("--out", "roster.csv")):
        refused = ask("export", flight[0], option, tmp_path / place)
        assert refused.exit_code == 2
        assert refused.stderr.startswith(f"transport: {option}: cannot write ")


def test_the_package_of_parquet_is_asked_for_before_the_log_is_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Which may take minutes."""

    def find_spec(name: str, *_: object) -> None:
        if name == "pyarrow":
            raise ModuleNotFoundError(name=name)

    for name in ("pyarrow", "pyarrow.parquet"):
        monkeypatch.delitem(sys.modules, name)
    finder: Any = SimpleNamespace(find_spec=find_spec)
    monkeypatch.setattr(sys, "meta_path", [finder, *sys.meta_path])
    refused = ask("export", "nowhere", "--out", "tables", "--parquet")
    assert refused.stderr.startswith("transport: expected the package pyarrow, got none: pip ")


def test_log_cut_at_sixty_percent(flight: tuple[Path, list[Message]], tmp_path: Path) -> None:
    """For a log cut at 60 %, the last tick is reported; the rest can be exported and plotted."""
    folder, _ = flight
    data = (folder / "run.mcap").read_bytes()
    cut = tmp_path / "run.mcap"
    cut.write_bytes(data[: len(data) * 6 // 10])
    (tmp_path / "scenario.toml").write_text((folder / "scenario.toml").read_text())
    content = info(cut)
    last = content["last_tick"]
    assert isinstance(last, int)
    assert 8 < last < 29
    assert content["complete"] is False
    assert content["outcome"] == "unknown"
    text = " ".join(ask("info", cut).output.split())
    assert (
        f"the log is incomplete (it stops before its end): {content['messages']} messages are readable"
        in text
    )
    exported = ask("export", cut, "--out", tmp_path / "tables")
    assert exported.exit_code == 0
    assert "the log is incomplete" in exported.stderr
    assert rows(tmp_path / "tables" / "plant_state.csv")
    plotted = CliRunner().invoke(app, ["plot", str(tmp_path)])
    assert plotted.exit_code == 0
    assert "stops before its end" in " ".join(plotted.output.split())
    assert (tmp_path / "figures" / "performance.png").exists()


def test_tables_hold_the_bits(flight: tuple[Path, list[Message]], tmp_path: Path) -> None:
    """CSV and Parquet have a table for each kind of message, with the numbers of the messages bit for bit."""
    folder, messages = flight
    for form in ("--csv", "--parquet"):
        result = ask("export", folder, form, "--out", tmp_path)
        assert result.exit_code == 0, result.output
    kinds = {message.kind for message in messages}
    assert (
        {path.stem for path in tmp_path.glob("*.csv")}
        == kinds
        == {path.stem for path in tmp_path.glob("*.parquet")}
    )
    plant_state = next(
        message for message in messages if isinstance(message, PlantState) and message.tick == 20
    )
    from_csv = rows(tmp_path / "plant_state.csv")[20]
    from_parquet = pq.read_table(tmp_path / "plant_state.parquet").to_pylist()[20]
    names = [name for name in from_csv if name.startswith("uav4_")]
    expected = [
        *plant_state.x[state.uav_slice(3)],
        *plant_state.u[state.input_slice(3)],
        float(plant_state.plan_ticks[3]),
    ]
    for row in (from_csv, from_parquet):
        assert (
            np.array([float(row[name]) for name in names]).tobytes() == np.array(expected).tobytes()
        )
    assert names[-5:-3] == ["uav4_thrust_N", "uav4_moment_x_Nm"]
    actual = rows(tmp_path / "actual_inputs.csv")[4 * 20 + 3]
    assert (actual["tick"], actual["uav"]) == ("20", "4")
    assert float(actual["thrust_N"]) == pytest.approx(0.9 * plant_state.u[12], rel=1e-12)
    plan = next(
        message
        for message in messages
        if isinstance(message, Plan) and (message.agent, message.tick) == (2, 15)
    )
    planned = next(
        row for row in rows(tmp_path / "plan.csv") if (row["agent"], row["tick"]) == ("2", "15")
    )
    assert planned["uav"] == "2"
    steps = [float(planned[f"moment_y_Nm[{step}]"]) for step in range(len(plan.inputs))]
    assert np.array(steps).tobytes() == plan.inputs[:, 2].tobytes()
    assert float(planned["correction_thrust_N[0]"]) == plan.corrections[0, 0]
    reports = [message for message in messages if isinstance(message, StepReport)]
    assert len(rows(tmp_path / "report.csv")) == len(reports)

    header = read_log(folder / "run.mcap").header
    metadata = pq.read_schema(tmp_path / "plan.parquet").metadata
    assert header["run_id"]
    assert metadata == {key.encode(): value.encode() for key, value in header.items()}


def test_tables_name_the_inputs_that_are_commanded(tmp_path: Path) -> None:
    """For a team that commands body rates the columns are thrust and rates, in no table moments."""
    run = runs.ready("resilient", runs.SHORT, "controller.inputs=rates")
    logs.record_run(run, tmp_path / "run")
    exported = ask("export", tmp_path / "run", "--out", tmp_path, "--kind", "plan")
    assert exported.exit_code == 0, exported.output
    columns = rows(tmp_path / "plan.csv")[0].keys()
    assert {f"{name}[0]" for name in RATE_NAMES} <= columns
    assert not {f"{name}[0]" for name in INPUT_NAMES[1:]} & columns


def test_numbers_of_a_class_take_no_column_of_others() -> None:
    """One named as another column stands beside it, also where that name is taken."""
    note = Note(
        sender="agent2", incarnation=0, sequence=0, tick=7, agent=2, problem="",
        names=("tick", "gap", "own_tick"), values=np.array([3.5, 4.5, 5.5]),
    )  # fmt: skip
    (row,) = tables(logs.log_of([note]), 0.05)["note"]
    assert (row["tick"], row["own_tick"], row["gap"], row["own_own_tick"]) == (7, 3.5, 4.5, 5.5)


@pytest.mark.parametrize("form", ["--csv", "--parquet"])
def test_targets_and_airtime_have_tables(form: str, tmp_path: Path) -> None:
    """Their arrays are texts that read back as the same bits, in both formats."""
    hover = "maneuver.phase=[{name='hover',duration_s=6.0,displacement_m=[0.0,0.0,0.0]}]"
    target = "maneuver.target=[{at_s=0.5,points_m=[[0.4,0.1,-10.0]],speed_mps=0.5}]"
    messages = logs.record_run(runs.setup(hover, "radio={}", target), tmp_path / "run")
    sent = next(message for message in messages if isinstance(message, Target))
    air = [message for message in messages if isinstance(message, Airtime)]

    assert ask("export", tmp_path / "run", "--out", tmp_path, form).exit_code == 0
    found = {}
    for kind in ("target", "airtime"):
        found[kind] = (
            rows(tmp_path / f"{kind}.csv")
            if form == "--csv"
            else pq.read_table(tmp_path / f"{kind}.parquet").to_pylist()
        )
    points = np.array(found["target"][0]["points"].split(), dtype=np.float64)
    assert points.tobytes() == sent.points.ravel().tobytes()
    for row, one in zip(found["airtime"], air, strict=True):
        arrivals = np.array(row["arrivals"].split(), dtype=np.float64)
        assert arrivals.tobytes() == one.arrivals.ravel().tobytes()
        assert row["plan_ticks"] == " ".join(map(str, one.plan_ticks))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("info", "nowhere"), "no such run, neither here nor in"),
        (("export", "nowhere", "--out", "tables"), "no such run, neither here nor in"),
        (
            ("export", "nowhere", "--out", "tables", "--kind", "poem"),
            f"expected one of {', '.join(KINDS)}, got 'poem'",
        ),
        (
            ("export", "nowhere", "--out", "tables", "--kind", "plan", "--kind", "poem"),
            "got 'poem'",
        ),
        (("export", "nowhere"), "expected --out, --ros2 or both, got none"),
        (
            ("export", "nowhere", "--ros2", "bag.mcap", "--kind", "plan"),
            "--kind: expected --out for the tables, got none",
        ),
        (
            ("export", "nowhere", "--ros2", "bag.mcap", "--parquet"),
            "--parquet: expected --out for the tables, got none",
        ),
    ],
)
def test_refusals(arguments: tuple[str, ...], text: str) -> None:
    """Unreadable input is refused with exit code 2 and one line."""
    result = ask(*arguments)
    assert result.exit_code == 2
    assert text in result.output


@pytest.mark.parametrize(
    ("name", "expected"),
    [("bag", "a file name that ends in .mcap"), ("run.mcap", "a file that does not exist yet")],
)
def test_the_name_of_a_bag(flight: tuple[Path, list[Message]], name: str, expected: str) -> None:
    """Players tell the format by the ending, and nothing is overwritten: refused before the log is read."""
    target = flight[0] / name
    before = sorted(flight[0].iterdir())
    result = ask("export", flight[0], "--ros2", target)
    assert result.exit_code == 2
    assert result.stderr == f"transport: --ros2: expected {expected}, got {target}\n"
    assert sorted(flight[0].iterdir()) == before
