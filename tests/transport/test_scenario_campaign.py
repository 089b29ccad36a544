"""A small part of the campaign of mutated scenarios, and that the campaign finds what it looks for."""

import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from protocol.scenario.file import find_scenario
from tests.campaigns import scenarios
from tests.campaigns.harness import execute_all
from tests.campaigns.scenarios import ENDED, FLOWN, REFUSED, attempt

RUNS = 20
PAPER = find_scenario("paper").read_bytes()


def test_mutated_scenarios_have_no_problem(tmp_path: Path) -> None:
    """Each is refused with a clear line, or simulated."""
    results = list(execute_all(partial(scenarios.execute, ticks=2), 7, range(RUNS), tmp_path / "campaign"))
    assert [result for result in results if result.problems] == []
    assert {result.outcome for result in results} <= {REFUSED, FLOWN, ENDED}
    assert {result.number for result in results} == set(range(RUNS))


def endless(_: str) -> None:
    """Compute for ever."""
    while True:
        pass


def raising(_: str) -> None:
    """End with an exception."""
    raise ValueError


def aborted(_: str) -> None:
    """End by a signal."""
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize(
    ("broken", "outcome"), [(raising, "traceback"), (aborted, "traceback"), (endless, "silent"), (None, "over 1 GB")]
)
def test_every_problem_is_found(
    broken: Callable[[str], None] | None, outcome: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An exception, an end by a signal, computing without a sign and too much memory are found and told apart."""
    monkeypatch.setattr(scenarios, "SILENCE_S", 0.2)
    if broken is None:
        monkeypatch.setattr(scenarios, "LARGEST_BYTES", 1)
        monkeypatch.setattr(scenarios, "SILENCE_S", 60.0)
    else:
        monkeypatch.setattr(scenarios, "validate", broken)
    assert attempt(PAPER, tmp_path, ticks=1)[0] == outcome
