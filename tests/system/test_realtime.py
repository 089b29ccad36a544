"""Real time across processes: pace of the wall clock, deadlines in the summary, and overruns."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import pytest

from tests.support.commands import Forked, processes_of, settings
from transport.log.run_log import read_log
from transport.protocol.wire.messages import Tick

REALTIME = "clock.mode=realtime"
OVERRUN, INTERRUPTED = 5, 130

# Delay of a slow or busy machine, above all of the last plant state.
SLACK_S = 2.0


def hover(duration_s: float) -> str:
    """Return the setting of a maneuver that hovers for a time."""
    return f"maneuver.phase=[{{name='hover',duration_s={duration_s},displacement_m=[0,0,0]}}]"


def flown(forked: Callable[..., Forked], folder: Path, *changes: str) -> dict[str, Any]:
    """Return the summary of a completed run with the shared control law, which tolerates delayed plans."""
    options = ["--out", "run", "--no-figures"]
    code, printed = forked("run", "resilient", *settings(*changes), *options, cwd=folder).end()
    assert code == 0, printed
    assert processes_of("run") == {}
    summary: dict[str, Any] = json.loads((folder / "run" / "summary.json").read_text())
    return summary


@pytest.mark.slow
def test_twice_as_fast(forked: Callable[..., Forked], tmp_path: Path) -> None:
    """At speed 2 a run of 3 s takes 1.5 s of wall time, and the summary counts missed deadlines."""
    summary = flown(forked, tmp_path, hover(3.0), REALTIME, "clock.speed=2")
    assert (summary["outcome"], summary["ticks"]) == ("completed", 60)
    # Without a clock it would take a fifth of that. A busy machine may record the first tick late,
    # and the last one.
    assert 0.75 <= summary["wall_time_s"] <= 1.5 + SLACK_S
    deadline = summary["deadline"]
    assert deadline["plans"] == 59 * 4
    assert 0 <= deadline["missed"] <= deadline["plans"]
    assert deadline["share"] == deadline["missed"] / deadline["plans"]
    assert 0.0 <= deadline["tick_late_ms"]["p50"] <= deadline["tick_late_ms"]["max"]
    opened = [tick for tick in read_log(tmp_path / "run" / "run.mcap").of(Tick) if tick.tick]
    assert 1e3 * max(tick.late_ns for tick in opened) / 1e9 == deadline["tick_late_ms"]["max"]
    # Deadlines are absolute, so delays of ticks do not add up.
    assert opened[-1].late_ns / 1e9 <= SLACK_S


def test_delayed_plans_are_late(forked: Callable[..., Forked], tmp_path: Path) -> None:
    """Over links with 120 ms delay plans are used at an age of three ticks, held back by each agent's own clock.

    At half speed a tick must be processed 40 ms late before a plan can be used one tick earlier.
    """
    summary = flown(forked, tmp_path, hover(1.5), REALTIME, "clock.speed=0.5", "links.delay_s=0.12")
    with (tmp_path / "run" / "steps.csv").open(newline="") as stream:
        ages = [int(row["plan_age_max"]) for row in csv.DictReader(stream) if int(row["tick"]) >= 5]
    assert median(ages) >= 3
    assert summary["messages"]["lost"] == 0
    assert summary["messages"]["late"] > 0.5 * summary["messages"]["delivered"]


def test_an_impossible_speed(forked: Callable[..., Forked], tmp_path: Path) -> None:
    """With "abort" a sampling period of 1 ms, shorter than a step, ends the run with exit code 5."""
    changes = settings(
        hover(5.0), REALTIME, "clock.speed=50", "clock.on_overrun=abort", "clock.overrun_limit=2"
    )
    options = ["--out", "run", "--no-figures"]
    code, printed = forked("run", "resilient", *changes, *options, cwd=tmp_path).end()
    assert code == OVERRUN, printed
    assert "missed the deadline of tick" in printed
    assert "missed in total, 2 allowed" in printed
    assert "Traceback" not in printed
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["outcome"], summary["exit_code"], summary["log_cut"]) == (
        "aborted",
        OVERRUN,
        None,
    )
    assert processes_of("run") == {}
