"""Steps without a solution: counted by agent, and the verdict at the end of a run."""

import pytest
from msgspec.structs import replace

from tests.support.coordinator_clock import at_last_tick, coordinator, tell
from tests.support.runs import ALL, plan, plant_state, setup, ticks
from transport.coordinator.outcome import FailedSteps
from transport.protocol.wire.errors_and_exit_codes import EXIT_FAILED
from transport.protocol.wire.message_form import MAX_TEXT
from transport.protocol.wire.messages import Control

TWENTY = 20  # steps, so that one failure is the default share


def counted(allowed: float, failed: dict[int, int], steps: int = TWENTY) -> FailedSteps:
    """Return the counts of a team whose agents fail in their first steps."""
    counts = FailedSteps(allowed)
    for agent, failures in failed.items():
        for k in range(steps):
            # The form of a plan is of no concern here, so agent 1's serves for all.
            one = replace(plan(setup(), 1, k), agent=agent)
            counts.count(replace(one, status="numerical") if k < failures else one)
    return counts


@pytest.mark.parametrize(
    ("allowed", "failures", "fails"),
    [(0.05, 0, False), (0.05, 1, False), (0.05, 2, True), (0.0, 1, True), (1.0, TWENTY, False)],
)
def test_the_share_is_a_limit_of_each_agent(allowed: float, failures: int, fails: bool) -> None:
    """A share equal to the limit is allowed; one agent beyond it is enough, whatever the others do."""
    counts = counted(allowed, {1: 0, 2: failures, 3: 0})
    assert bool(counts.verdict()) == fails


def test_every_failed_agent_is_named() -> None:
    """Agents with equal counts share a clause; one below the limit is named as well."""
    assert counted(0.05, {1: 20, 2: 0, 3: 20, 4: 1}).verdict() == (
        "agent1, agent3 failed in 20 of 20 steps each; agent4 failed in 1 of 20 steps; "
        "at most 5 % of an agent's steps may fail"
    )


def test_the_sentence_of_a_large_team_fits_a_message() -> None:
    """Beyond the length of a text the sentence has the number of agents and the worst one."""
    text = counted(0.0, {agent: agent for agent in range(1, 251)}, 250).verdict()
    assert len(text) <= MAX_TEXT
    assert text.startswith("250 agents failed, agent250 in 250 of 250 steps")


@pytest.mark.parametrize("failing", [(), (3,), ALL])
def test_a_run_with_failed_steps_is_no_success(failing: tuple[int, ...]) -> None:
    """The run goes on to its last tick; its end has outcome, exit code and the agents that failed."""
    node = at_last_tick(coordinator())
    plans = [
        replace(one, status="infeasible") if one.agent in failing else one
        for one in (plan(setup(ticks(3)), agent, 2) for agent in ALL)
    ]
    (end,) = (
        message
        for message in tell(node, [*plans, plant_state(setup(ticks(3)), 2)])
        if isinstance(message, Control)
    )
    if not failing:
        assert (end.outcome, end.exit_code, end.reason) == ("completed", 0, "")
        return
    assert (end.outcome, end.exit_code) == ("failed", EXIT_FAILED)
    assert all(f"agent{agent}" in end.reason for agent in failing)
