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
from transport.report.summary_texts import (
    deadlines_text,
    limits_text,
    own_constraint_text,
    plans_text,
    radio_text,
    separation_text,
    solver_text,
)

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


HELD_SOLVER = {"beyond_share": False, "failures": 0}
REACHED = [
    *({"uav": uav, "limit": "largest thrust", "share": 0.5} for uav in (1, 2, 3, 4, 5)),
    {"uav": 1, "limit": "change of thrust", "share": 0.01},
    {"uav": 2, "limit": "smallest thrust", "share": 0.0099},
]


@pytest.mark.parametrize(
    ("violation", "change", "text"),
    [
        (0.0, {}, "held"),
        (9e-7, {}, "held"),
        (1e-6, {}, "exceeded by 0.00% of their range"),
        (None, {}, "-"),
        (
            *(0.125, {"constraint_violation": {"limit": "inputs", "at_s": 1.5}}),
            "exceeded by 12.50% of their range: inputs at 1.50 s",
        ),
        (
            *(0.125, {"solver": {"beyond_share": True, "failures": 7}}),
            "exceeded by 12.50% of their range, but 7 steps without a controller",
        ),
        (
            *(0.0, {"limits_reached": REACHED[:4]}),
            "held; at the largest thrust UAV1 50%, UAV2 50%, UAV3 50%, UAV4 50% of the ticks",
        ),
        (
            *(0.0, {"limits_reached": REACHED}),
            "held; at the largest thrust UAV1 50%, UAV2 50%, UAV3 50%, UAV4 50% of the ticks, and 1 more UAVs; "
            "at the change of thrust UAV1 1% of the ticks",
        ),
    ],
)
def test_limits_are_told(violation: float | None, change: dict[str, Any], text: str) -> None:
    """Which is exceeded most and when, steps without a controller, and UAVs at a limit for 1 % of the ticks or more."""
    summary = {"constraint_violation_max": violation, "solver": HELD_SOLVER, **change}
    assert limits_text(summary) == text


@pytest.mark.parametrize(
    ("violation", "softened", "text"),
    [
        (9e-7, 0, "v0[2] >= 0: held"),
        (0.0, 3, "v0[2] >= 0: held, softened in 3 steps"),
        (1e-6, 0, "v0[2] >= 0: exceeded by 1e-06 at 2.50 s"),
        (0.25, 2, "v0[2] >= 0: exceeded by 0.25 at 2.50 s, softened in 2 steps"),
        (None, 0, "v0[2] >= 0: - at 2.50 s"),
    ],
)
def test_a_constraint_of_the_user_is_told(
    violation: float | None, softened: int, text: str
) -> None:
    """Whether it held, by how much not, and in how many steps it was softened."""
    own = {
        "expression": "v0[2] >= 0",
        "violation_max": violation,
        "at_s": 2.5,
        "softened_steps": softened,
    }
    assert own_constraint_text(own) == text


RADIO = {
    "rate_mbps": 6.0, "airtime_share": 0.256, "delivered_share": 0.9876,
    "delay_ms": {"p50": 1.24, "p99": 3.46}, "collisions": 1, "weak": 2, "queue_drops": 3, "given_up": 4,
    "repetitions": 5, "replaced": 6, "slots": {"cycle_ticks": 2, "plan_ms": 2.51, "slot_ms": 2.5},
}  # fmt: skip
QUIET = dict.fromkeys(
    ("collisions", "weak", "queue_drops", "given_up", "repetitions", "replaced"), 0
)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            {},
            "6 Mb/s, 25.6% of the airtime; 98.8% delivered; delay median 1.2 ms, p99 3.5 ms; "
            "1 lost by collisions; 2 too weak; 3 dropped by queues; 4 given up; 5 repetitions; "
            "6 replaced by newer ones before their slots; a slot for each agent every 2 ticks; "
            "slots of 2.50 ms are shorter than a plan, 2.51 ms",
        ),
        (
            {**QUIET, "slots": {"cycle_ticks": 1, "plan_ms": 2.5, "slot_ms": 2.5}},
            "6 Mb/s, 25.6% of the airtime; 98.8% delivered; delay median 1.2 ms, p99 3.5 ms",
        ),
        (
            {**QUIET, "slots": None, "delay_ms": {"p50": None, "p99": None}},
            "6 Mb/s, 25.6% of the airtime; 98.8% delivered",
        ),
    ],
)
def test_the_radio_is_told(change: dict[str, Any], text: str) -> None:
    """Only losses that there are, slots over several ticks, and slots that a plan does not fit."""
    assert radio_text({**RADIO, **change}) == text


def test_plans_are_told_by_what_became_of_them() -> None:
    """Unsent, lost, not arrived and late ones, with their ages; nothing of a run without plans."""
    messages = {
        "planned": 8, "shared": 6, "sent": 20, "lost": 3, "in_transit": 2, "late": 1,
        "measurements": {"sent": 9, "lost": 0}, "commands": {"sent": 7, "lost": 4},
    }  # fmt: skip
    assert plans_text(messages, {"mean": 1.234, "max": 5}) == (
        "6 of 8 sent to the other agents (75.0%); 3 of 20 lost, 2 not arrived at the end, 1 late; "
        "age 1.23 ticks, max 5; commands 4 of 7 lost"
    )
    earlier = {"planned": 8, "shared": 8, "sent": 0, "lost": 0, "late": 0}
    assert plans_text(earlier, {"mean": None, "max": None}) == "-"
    assert (
        plans_text(earlier, {"mean": 1.0, "max": 1}) == "0 of 0 lost, 0 late; age 1.00 ticks, max 1"
    )


NO_LOSS = {"planned": 8, "shared": 8, "sent": 9, "lost": 0, "late": 0}
BOTH_LOST = {kind: {"sent": 9, "lost": 2} for kind in ("measurements", "commands")}
ON_TIME = {**DEADLINE, "missed": 0, "share": 0.0, "worst_ms": 0.0}
TWO_FAILED = [{"agent": agent, "steps": 40, "failures": agent} for agent in (2, 3)]


@pytest.mark.parametrize(
    ("told", "text"),
    [
        (
            plans_text({**NO_LOSS, "lost": 9}, {"mean": None, "max": None}),
            "9 of 9 lost, 0 late; age - ticks, max -",  # none is in use
        ),
        (
            plans_text({**NO_LOSS, **BOTH_LOST}, {"mean": 1.0, "max": 1}),
            "0 of 9 lost, 0 late; age 1.00 ticks, max 1; measurements 2 of 9 lost; commands 2 of 9 lost",
        ),
        (
            deadlines_text(ON_TIME),
            "0 of 100 missed (0.00%); ticks opened late: median 0.50 ms, p99 1.00 ms, max 2.0 ms",
        ),
        (
            solver_text({"fallbacks": 1, "failures": 5, "failed_agents": TWO_FAILED}),
            "1 fallbacks, 5 failures: agent2 2 of 40, agent3 3 of 40",
        ),
        (separation_text({"separation_min_m": None, "collision": None}), "-"),
        (
            radio_text({**RADIO, **QUIET, "airtime_share": None, "delivered_share": None, "slots": None}),
            "6 Mb/s, - of the airtime; - delivered; delay median 1.2 ms, p99 3.5 ms",
        ),
    ],
)  # fmt: skip
def test_what_is_not_there_is_not_told(told: str, text: str) -> None:
    """Plans of which none arrived have no age, deadlines that none missed no lateness; all that is there is told."""
    assert told == text


def rows_of(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the names and texts of the table of a summary."""
    names, texts = (list(map(str, column.cells)) for column in summary_table(summary).columns)
    return list(zip(names, texts, strict=True))


def test_every_row_of_the_table_has_its_numbers(flight: tuple[Path, list[Message]]) -> None:
    """Each number of the summary stands in its row, in its unit; a table in a row of its own by name."""
    times = {"p50": 1.0, "p99": 2.0, "max": 3.0}
    summary = {
        **write_report(flight[0], figures=False),
        "outcome": "diverged", "reason": "away", "wall_time_s": 2.5, "real_time_factor": 0.6, "sim_time_s": 1.5,
        "controller": {
            "name": "mpc", "agents": 1, "sampling_period_s": 0.025, "horizon": 20, "prediction": "open_loop",
            "relaxation": 0.5,
        },
        "cost": {"mean": 0.00123, "max": 0.0456, "max_after_hover": None}, "attitude_max_deg": 3.456,
        "uav_tracking": {"rms_m": 0.012, "max_m": 0.034},
        "payload_tracking": {"rms_m": 0.056, "max_m": 0.078, "swing_m": None},
        "targets": TARGETS[:1], "cables": {"tension_min_N": 4.5, "slack": 0},
        "estimate": {**ESTIMATE, "nees": 60.0, "nis": None},
        "clearance_min_m": {"uav": 1.0, "rod": None, "payload": 2.0},
        "separation_min_m": 0.4567, "local_error_max": 2.5e-9, "own_constraints": [],
        "agent_step_ms": times, "rest_of_tick_ms": {"p50": None, "p99": None, "max": None},
        "deadline": {"plans": 0}, "radio": None, "log_cut": "it is cut", "rejections": [],
        "limits_reached": [], "faults": [*FAULTS[:1], {**FAULTS[1], "what": "away"}],
        "solver": {"fallbacks": 1, "failures": 0, "failed_agents": [], "beyond_share": False},
    }  # fmt: skip
    assert str(summary_table(summary).title) == "paper diverged: away"  # which no fault tells again
    for outcome, colour in (("diverged", "red"), ("unknown", "yellow"), ("completed", "green")):
        title: Any = summary_table({**summary, "outcome": outcome}).title
        assert title.spans[-1].style == f"bold {colour}"
    assert rows_of(summary) == [
        ("simulated", "1.50 s in 2.50 s of wall time (0.60 x real time)"),
        ("controller", "1 agent every 25 ms, 20 steps, open loop, relaxation 0.5"),
        ("cost", "mean 0.00123, max 0.0456"),
        ("payload attitude", "max 3.46 deg"),
        ("UAV error", "rms 0.012 m, max 0.034 m"),
        ("payload error", "rms 0.056 m, max 0.078 m"),
        ("payload swing", "-"),
        ("targets", "0 of 1 reached"),
        ("cables", "min tension 4.50 N, never slack"),
        ("estimate", "payload rms 0.010 m, 0.50 deg; NEES 60.0 of 6, NIS - of 1"),
        ("separation", "min 0.457 m"),
        ("clearance", "1.000 m UAVs, - rods, 2.000 m payload"),
        ("limits", "held"),
        ("integration", "largest local error 2.5e-09"),
        ("agent step", "median 1.00 ms, p99 2.00 ms, max 3.0 ms"),
        ("rest of tick", "-"),
        ("plans", "0 of 348 lost, 0 late; age 1.00 ticks, max 1"),
        ("solver", "1 fallbacks, 0 failures"),
        ("faults", "  0.00 s  fault 0"),
        ("log", "it is cut"),
    ]
    own = {**summary, "controller": {**summary["controller"], "name": "mine:Mine 1", "agents": 3}}
    assert ("controller", "3 agents every 25 ms, mine:Mine 1") in rows_of(own)
