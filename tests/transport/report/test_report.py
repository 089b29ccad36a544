"""The report of a run folder: schema of the summary, reproducible files, cut logs, printed table."""

import json
from importlib.resources import files
from pathlib import Path
from typing import Any, get_args

import pytest
from jsonschema import Draft202012Validator
from rich.console import Console

from tests.support import runs
from tests.support.logs import record_run
from transport.protocol.wire.errors_and_exit_codes import Reason
from transport.protocol.wire.messages import Message
from transport.report.report import write_report
from transport.report.summary_table import summary_table, warnings

SCHEMA = json.loads(
    files("transport.analysis").joinpath("summary.schema.json").read_text(encoding="utf-8")
)

# Largest table that fits a terminal.
MOST_LINES = 18


def checked(folder: Path) -> dict[str, Any]:
    """Return the summary of a folder after checking it against the schema and summary.json."""
    summary = write_report(folder, figures=False)
    Draft202012Validator(SCHEMA).validate(summary)
    assert json.loads((folder / "summary.json").read_text(encoding="utf-8")) == summary
    return summary


def printed(summary: dict[str, Any]) -> str:
    """Return the text of the table on a terminal of usual width."""
    console = Console(width=100, record=True, file=None, quiet=False)
    with console.capture() as capture:
        console.print(summary_table(summary))
    return capture.get()


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Message]]:
    """Return a run folder of the shortened `paper` scenario and the messages in its log."""
    folder = tmp_path_factory.mktemp("run")
    return folder, record_run(runs.setup(runs.SHORT), folder)


def test_the_schema_is_complete() -> None:
    """The schema is valid, describes every field, and allows no field it does not describe."""
    Draft202012Validator.check_schema(SCHEMA)

    def closed(schema: dict[str, Any]) -> bool:
        parts = schema.get("properties", {}).values()
        return "properties" not in schema or (
            schema["additionalProperties"] is False and all(map(closed, parts))
        )

    assert closed(SCHEMA)
    assert set(SCHEMA["required"]) == set(SCHEMA["properties"])
    assert all("description" in field for field in SCHEMA["properties"].values())
    reason = SCHEMA["properties"]["rejections"]["items"]["properties"]["reason"]
    assert reason["enum"] == list(get_args(Reason))


def test_a_run_is_summarised(flight: tuple[Path, list[Message]]) -> None:
    """The summary of a run follows the schema and holds its results."""
    summary = checked(flight[0])
    assert (summary["outcome"], summary["ticks"], summary["scenario"]) == ("completed", 30, "paper")
    assert summary["messages"] == {
        "planned": 120,
        "shared": 120,
        "sent": 29 * 12,
        "delivered": 29 * 12,
        "lost": 0,
        "in_transit": 0,
        "late": 0,
        "measurements": {"sent": 120, "lost": 0},
        "commands": {"sent": 120, "lost": 0},
        "rejected": 0,
    }
    assert 0.0 < summary["cost"]["mean"] < summary["cost"]["max"] < 1.0
    assert summary["versions"] == {"python": "3.12.1", "numpy": "2.0.0"}
    assert summary["log_cut"] is None


@pytest.mark.parametrize(
    ("settings", "outcome"),
    [
        ((runs.SHORT, *runs.SINGLE_UAV), "completed"),
        ((runs.SHORT, "agents.owned=[[1,2,3,4]]"), "completed"),
        ((runs.SHORT, "plant.max_error_m=0.05", "clock.actuation=next_tick"), "diverged"),
    ],
    ids=["one-uav", "centralized", "diverged"],
)
def test_other_runs_keep_the_schema(
    tmp_path: Path, settings: tuple[str, ...], outcome: str
) -> None:
    """One UAV, one agent for all, and a run that ends early have summaries of the same schema."""
    run = runs.setup(*settings)
    record_run(run, tmp_path)
    summary = checked(tmp_path)
    assert summary["outcome"] == outcome
    assert (summary["separation_min_m"] is None) == (run.system.N == 1)
    assert bool(summary["faults"]) == (outcome == "diverged")
    assert len(printed(summary).splitlines()) <= MOST_LINES


@pytest.mark.parametrize("share", [0.0, 0.3, 0.999])
def test_a_cut_log_is_reported(
    tmp_path: Path, flight: tuple[Path, list[Message]], share: float
) -> None:
    """A log cut anywhere, even at its begin, gives a valid summary that names the cut, and a table."""
    whole = (flight[0] / "run.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(whole[: int(share * len(whole))])
    (tmp_path / "scenario.toml").write_bytes((flight[0] / "scenario.toml").read_bytes())
    summary = checked(tmp_path)
    assert summary["log_cut"]
    text = printed(summary)
    assert len(text.splitlines()) <= MOST_LINES
    assert "incomplete" in text


TARGETS = [
    {
        "t_s": 1.0,
        "arrives_s": 3.0,
        "position_m": [0.0, 0.0, 0.0],
        "known_s": 0.0,
        "error_m": error_m,
    }
    for error_m in (None, 0.2, 0.1)
]
FAULTS: list[dict[str, Any]] = [
    {
        "tick": k,
        "time_s": 0.05 * k,
        "wall_s": None,
        "kind": "fault",
        "processes": [],
        "what": f"fault {k}",
    }
    for k in range(23)
]
ESTIMATE = {
    "position_rms_m": 0.01,
    "attitude_rms_deg": 0.5,
    "nees": 60.1,
    "nees_band": [1.2, 14.4],
    "nis": 1.0,
}
LATE = {"p50": 0.5, "p99": 1.0, "max": 2.0}
DEADLINE = {"plans": 100, "missed": 3, "share": 0.03, "worst_ms": 7.5, "tick_late_ms": LATE}
UNHEARD = {**DEADLINE, "worst_ms": None}
SOLVER = {
    "failures": 4,
    "failed_agents": [{"agent": 2, "steps": 40, "failures": 4}],
    "beyond_share": True,
}
REJECTIONS = [
    {"by": "plant", "sender": "agent3", "reason": "outside_limits", "count": 4},
    {"by": "agent1", "sender": "plan/2", "reason": "malformed", "count": 3},
    {"by": "agent4", "sender": "plan/2", "reason": "malformed", "count": 2},
]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"payload_tracking": {"swing_m": 0.5538}}, "max 0.554 m in the last 4 s"),
        ({"targets": TARGETS}, "2 of 3 reached, payload at most 0.200 m away"),
        ({"faults": FAULTS}, "and 3 more in summary.json"),
        ({"faults": FAULTS[:20]}, "fault 19"),  # the last that has a line
        ({"estimate": ESTIMATE}, "NIS 1.00 of 1: far more wrong"),
        ({"deadline": DEADLINE}, "3 of 100 missed (3.00%), worst plan 7.5 ms late; ticks"),
        ({"deadline": UNHEARD}, "3 of 100 missed (3.00%), no plan of which arrived; ticks"),
        ({"solver": SOLVER}, "4 failures: agent2 4 of 40"),
        ({"solver": SOLVER}, "none exceeded, but 4 steps without a controller"),
        ({"constraint_violation_max": 0.05}, "exceeded by 5.00% of their range"),
        (
            {"collision": {"at_s": 1.5, "uavs": [1, 3], "distance_m": 0.4}},
            "UAV1 and UAV3 touch at 1.50 s",
        ),
        ({"messages": {"shared": 9}}, "9 of 120 sent to the other agents (7.5%)"),
        (
            {"messages": {"rejected": 9}, "rejections": REJECTIONS},
            "9 messages, 4 from agent3 to plant (outside",
        ),
        (
            {"outcome": "aborted", "reason": "agent2 [/bold] is gone"},
            "agent2 [/bold] is gone",
        ),  # no markup
    ],
)
def test_the_table_names_what_is_unusual(
    flight: tuple[Path, list[Message]], change: dict[str, Any], text: str
) -> None:
    """The swing at the end, plans that were not sent, and the most rejected messages are in the table."""
    summary = write_report(flight[0], figures=False)
    assert text not in printed(summary)
    changed = summary | {
        k: summary[k] | v if isinstance(v, dict) and summary[k] else v for k, v in change.items()
    }
    assert text in printed(changed)
    assert "and 0 more" not in printed(changed)
    Draft202012Validator(SCHEMA).validate(changed)


@pytest.mark.parametrize(
    ("error", "count"), [(None, 0), (1e-6, 0), (1.1e-6, 1)], ids=["unknown", "accurate", "large"]
)
def test_a_large_error_of_the_integration_is_a_warning(error: float | None, count: int) -> None:
    """Above 1e-6 the numbers of a run cannot be trusted: the warning says what to set."""
    told = warnings({"local_error_max": error})
    assert len(told) == count
    assert all("set a smaller plant.tolerance or plant.step_s" in text for text in told)
