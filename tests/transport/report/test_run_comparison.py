"""`transport compare`: numbers side by side, differences from the first run, and notes about unequal runs."""

import csv
import itertools
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from tests.support import logs, runs
from transport.cli.main import app
from transport.log.run_folder import open_run
from transport.report.run_comparison import ComparedRun, doubts, rows, settings_apart


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Run folders: as published, with late plans, with another maneuver and weight."""
    parent = tmp_path_factory.mktemp("compare")
    for name, settings in (
        ("usual", (runs.SHORT,)),
        ("late", (runs.SHORT, "links.delay_s=0.1", "controller.received_plans='by_age'")),
        ("other", (runs.ticks(10), "controller.weights.attitude=6.0")),
    ):
        logs.record_run(runs.setup(*settings), parent / name)
    return {path.name: path for path in parent.iterdir()}


def ask(*arguments: str | Path) -> Result:
    """Run the command in this process."""
    return CliRunner().invoke(app, ["compare", *map(str, arguments)])


def test_numbers_and_differences(folders: dict[str, Path]) -> None:
    """Values are those of the summaries; percentages refer to the first run; text has none."""
    usual, late = (ComparedRun.of(name, open_run(folders[name])) for name in ("usual", "late"))
    table = {row.name: row for row in rows([usual, late])}
    costs = tuple(one.summary["cost"]["mean"] for one in (usual, late))
    row = table["cost, mean"]
    assert row.values == costs
    assert costs[0] != costs[1]
    assert row.percent[0] == 0.0
    percent = row.percent[1]
    assert percent is not None
    assert costs[0] * (1.0 + percent / 100.0) == pytest.approx(costs[1], rel=1e-12)
    assert table["plan age, max"].values == (1, 2)
    assert table["plan age, max"].percent == (0.0, 100.0)
    assert table["outcome"].values == ("completed", "completed")
    assert table["outcome"].percent == (None, None)
    assert table["plans lost"].percent == (None, None)  # no share of 0
    assert list(doubts([usual, late])) == []


def test_unequal_runs_are_noted(folders: dict[str, Path], tmp_path: Path) -> None:
    """Another maneuver and other weights are notes, not errors; the figure is drawn all the same."""
    result = ask(f"first={folders['usual']}", folders["other"], "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "other has another maneuver than first" in result.stderr
    assert "other has another set of weights than first" in result.stderr
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "compare.csv",
        "compare.png",
        "compare.svg",
    }
    assert (tmp_path / "out" / "compare.png").read_bytes().startswith(b"\x89PNG")
    with (tmp_path / "out" / "compare.csv").open(newline="") as file:
        header, *lines = csv.reader(file)
    assert header == ["quantity", "unit", "first", "other", "other, more than first (%)"]
    flown = next(line for line in lines if line[0] == "simulated time")
    assert np.allclose([float(cell) for cell in flown[2:]], [1.5, 0.5, -200.0 / 3.0])


def test_every_quantity_is_another_number_of_the_summary(folders: dict[str, Path]) -> None:
    """Each has its place in the summary, where all numbers differ; shares are in percent."""
    one = ComparedRun.of("usual", open_run(folders["usual"]))
    numbers = (1.0 + 0.25 * k for k in itertools.count())

    def numbered(tree: Any) -> Any:
        if isinstance(tree, dict):
            return {key: numbered(value) for key, value in tree.items()}
        return next(numbers) if isinstance(tree, int | float | None) else tree

    radio = {"airtime_share": None, "delivered_share": None}
    summary = numbered({**one.summary, "radio": radio})
    found = {row.name: row.values[0] for row in rows([one._replace(summary=summary)])}
    percent = {
        "limits exceeded, max": summary["constraint_violation_max"],
        "deadlines missed": summary["deadline"]["share"],
        "plans lost": summary["messages"]["lost"] / summary["messages"]["sent"],
        "radio: airtime": summary["radio"]["airtime_share"],
        "radio: delivered": summary["radio"]["delivered_share"],
    }
    assert {name: found.pop(name) for name in percent} == {
        name: pytest.approx(100.0 * share) for name, share in percent.items()
    }
    assert found == {
        "scenario": summary["scenario"],
        "outcome": "completed",
        "simulated time": summary["sim_time_s"],
        "cost, mean": summary["cost"]["mean"],
        "cost, max": summary["cost"]["max"],
        "cost, max after hover": summary["cost"]["max_after_hover"],
        "payload attitude, max": summary["attitude_max_deg"],
        "UAV error, rms": summary["uav_tracking"]["rms_m"],
        "UAV error, max": summary["uav_tracking"]["max_m"],
        "payload error, rms": summary["payload_tracking"]["rms_m"],
        "payload error, max": summary["payload_tracking"]["max_m"],
        "payload error, max of last 4 s": summary["payload_tracking"]["swing_m"],
        "separation, min": summary["separation_min_m"],
        "agent step, median": summary["agent_step_ms"]["p50"],
        "agent step, p99": summary["agent_step_ms"]["p99"],
        "rest of tick, median": summary["rest_of_tick_ms"]["p50"],
        "real-time factor": summary["real_time_factor"],
        "plan age, mean": summary["plan_age_ticks"]["mean"],
        "plan age, max": summary["plan_age_ticks"]["max"],
        "messages rejected": summary["messages"]["rejected"],
        "solver fallbacks": summary["solver"]["fallbacks"],
        "solver failures": summary["solver"]["failures"],
        "faults and changes": 0,
    }


@pytest.mark.parametrize(("share", "shown"), [(None, None), (9e-7, 0.0), (1e-6, 1e-4), (0.05, 5.0)])
def test_a_limit_exceeded_within_the_tolerance_of_the_solver_is_held(
    folders: dict[str, Path], share: float | None, shown: float | None
) -> None:
    """The excess is in percent of the range; a log may not tell."""
    one = ComparedRun.of("usual", open_run(folders["usual"]))
    changed = one._replace(summary={**one.summary, "constraint_violation_max": share})
    table = {row.name: row.values[0] for row in rows([changed])}
    assert table.get("limits exceeded, max") == (None if shown is None else pytest.approx(shown))


def test_short_logs_and_other_machines_are_noted(folders: dict[str, Path]) -> None:
    """A log of 20 of 30 ticks with the reason, or the outcome where there is none; times of another machine."""
    one = ComparedRun.of("usual", open_run(folders["usual"]))
    ended = {**one.summary, "ticks": 20, "outcome": "aborted"}
    runs_compared = [
        one,
        one._replace(label="a", summary={**ended, "reason": "by hand"}),
        one._replace(label="b", summary={**ended, "machine": "another", "reason": ""}),
    ]
    assert list(doubts(runs_compared)) == [
        "b has another machine than usual: times do not only depend on the controller",
        "a: the log holds 1.00 of 1.50 s (by hand); means are over this time",
        "b: the log holds 1.00 of 1.50 s (aborted); means are over this time",
    ]


def test_settings_apart(folders: dict[str, Path], tmp_path: Path) -> None:
    """The keys of the scenarios that differ are listed, with the values of all runs."""
    usual, late, other = (
        ComparedRun.of(name, open_run(folders[name])) for name in ("usual", "late", "other")
    )
    assert settings_apart([usual, usual]) == []
    assert [tuple(one) for one in settings_apart([usual, late])] == [
        ("controller.received_plans", ("by_one", "by_age")),
        ("links.delay_s", (0.0, 0.1)),
    ]
    phases, weight = settings_apart([usual, other])[:2]
    assert (phases.key, len(phases.values[0])) == ("maneuver.phase", 2)
    assert weight == ("controller.weights.attitude", (5.0, 6.0))
    result = ask(f"a={folders['usual']}", f"b={folders['late']}", "--out", tmp_path, "--no-figures")
    assert "links.delay_s" in result.stdout


def made(label: str, *settings: str, cut: str = "", **summary: Any) -> ComparedRun:
    """Return a run of some settings whose summary has what is given."""
    setup = runs.setup(*settings)
    run: Any = SimpleNamespace(setup=setup, log=SimpleNamespace(cut=cut))
    series: Any = None
    return ComparedRun(label, run, {"machine": "", "ticks": setup.ticks, **summary}, series)


def test_settings_apart_are_told_at_their_place() -> None:
    """Entries of equal numbers one by one, from 1 on; of others the lists. Names and addresses change no run."""
    lossy = "links.gilbert_elliott={enter=0.1,leave=0.2,loss=1.0}"
    others = ("name=other", "network.base_port=9000", "maneuver.phase.2.duration_s=7.0", lossy)
    found = settings_apart(
        [made("a"), made("b", *others, "links.override=[{from='agent1',loss=0.1}]")]
    )
    told = {one.key: one.values for one in found}
    assert told["links.override"][0] == []
    assert told["links.override"][1][0]["from"] == "agent1"
    assert {key: values for key, values in told.items() if key != "links.override"} == {
        "maneuver.phase.2.duration_s": (5.0, 7.0),
        "links.gilbert_elliott": (None, {"enter": 0.1, "leave": 0.2, "loss": 1.0}),
    }


def test_what_runs_should_share_is_noted() -> None:
    """Another system and cost function make costs incomparable; a short log may be cut as well."""
    another = ("system.payload.mass_kg=1.1", "controller.cost=[{expression='v0[0]',weight=1.0}]")
    ended = {"ticks": 20, "reason": "", "outcome": "unknown"}
    runs_compared = [made("first"), made("other", *another, cut="it is cut", **ended)]
    assert list(doubts(runs_compared)) == [
        "other has another system than first: costs are not comparable",
        "other has another cost function than first: costs are not comparable",
        "other: the log holds 1.00 of 25.00 s (unknown); means are over this time",
        "other: it is cut",
    ]


def test_a_quantity_that_one_run_lacks_has_no_difference(folders: dict[str, Path]) -> None:
    """One that no run has is left out; without plans none is lost. A difference has the sign of the change."""
    whole = ComparedRun.of("usual", open_run(folders["usual"])).summary
    messages = {**whole["messages"], "sent": 0}
    radio = {"airtime_share": 0.05, "delivered_share": None}
    table = {
        row.name: row
        for row in rows(
            [
                made("a", **{**whole, "messages": messages, "separation_min_m": -2.0}),
                made(
                    "b", **{**whole, "messages": messages, "separation_min_m": -1.0, "radio": radio}
                ),
            ]
        )
    }
    assert (table["radio: airtime"].values, table["radio: airtime"].percent) == (
        (None, 5.0),
        (None, None),
    )
    assert table["separation, min"].percent == (0.0, 50.0)
    assert not {"radio: delivered", "plans lost"} & table.keys()


def test_json(folders: dict[str, Path], tmp_path: Path) -> None:
    """The same as one JSON object on standard output, and nothing else there."""
    result = ask(
        folders["usual"],
        f"again={folders['usual']}",
        "--no-figures",
        "--format",
        "json",
        "--out",
        tmp_path,
    )
    content = json.loads(result.stdout)
    assert [run["label"] for run in content["runs"]] == ["usual", "again"]
    equal = [q["percent"] for q in content["quantities"]]
    assert all(value in (0.0, None) for values in equal for value in values)
    assert content["notes"] == []
    assert [Path(name).name for name in content["files"]] == ["compare.csv"]


def test_nothing_to_compare(folders: dict[str, Path], tmp_path: Path) -> None:
    """One run, no log, or a log without a tick: exit code 2 and one line."""
    assert "expected at least two runs, got 1" in ask(folders["usual"]).output
    assert "no such run, neither here nor in" in ask(folders["usual"], tmp_path / "nowhere").output
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "scenario.toml").write_text((folders["usual"] / "scenario.toml").read_text())
    (empty / "run.mcap").write_bytes((folders["usual"] / "run.mcap").read_bytes()[:40])
    result = ask(folders["usual"], empty, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert "expected at least two logs with a simulated tick, got 1 of 2" in result.output
    assert not (tmp_path / "out").exists()
