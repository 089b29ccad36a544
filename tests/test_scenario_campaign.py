"""A small part of the campaign of mutated scenarios, and that the campaign finds what it looks for."""

from functools import partial
from pathlib import Path

from tests.campaigns import scenarios
from tests.campaigns.harness import execute_all
from tests.campaigns.scenarios import ENDED, FLOWN, REFUSED

RUNS = 20


def test_mutated_scenarios_have_no_problem(tmp_path: Path) -> None:
    """Each is refused with a clear line, or simulated."""
    results = list(
        execute_all(partial(scenarios.execute, ticks=2), 7, range(RUNS), tmp_path / "campaign")
    )
    assert [result for result in results if result.problems] == []
    assert {result.outcome for result in results} <= {REFUSED, FLOWN, ENDED}
    assert {result.number for result in results} == set(range(RUNS))
