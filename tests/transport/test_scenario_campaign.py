"""A small part of the campaign of mutated scenarios, and that the campaign finds what it looks for."""

import os
import random
import signal
import tomllib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from protocol.scenario.file import find_scenario
from tests.campaigns import scenarios
from tests.campaigns.harness import execute_all
from tests.campaigns.scenarios import ENDED, FLOWN, REFUSED, attempt, scenario
from tests.support.mutations import KINDS, mutated

RUNS = 20
PAPER = find_scenario("paper").read_bytes()


def test_mutated_scenarios_have_no_problem(tmp_path: Path) -> None:
    """Each is refused with a clear line, or simulated."""
    results = list(execute_all(partial(scenarios.execute, ticks=2), 7, range(RUNS), tmp_path / "campaign"))
    assert [result for result in results if result.problems] == []
    assert {result.outcome for result in results} <= {REFUSED, FLOWN, ENDED}
    assert {result.number for result in results} == set(range(RUNS))


def test_scenarios_are_drawn_from_seed_and_number() -> None:
    """The same seed and number make the same scenario, others another; every kind of mutation occurs."""
    assert scenario(1, 5) == scenario(1, 5)
    assert len({scenario(1, number)[0] for number in range(20)}) == len({scenario(2, n)[0] for n in range(20)}) == 20
    tree = tomllib.loads(PAPER.decode())
    found = {mutated(tree, random.Random(number))[1] for number in range(200)}  # noqa: S311  # no secret
    assert found == set(KINDS)
    assert tree == tomllib.loads(PAPER.decode())


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


def test_a_process_that_sleeps_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A scenario that makes its process wait for something that does not come is found as well."""
    monkeypatch.setattr(scenarios, "_ASLEEP_S", 0.1)
    monkeypatch.setattr(scenarios, "validate", lambda _: signal.pause())
    assert attempt(PAPER, tmp_path, ticks=1)[0] == "silent"
