"""Differences of two messages by hand: by field, by input and unit, and the first tick beyond a size."""

from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from transport.analysis.replay.replay_difference import Comparison, InputsApart, differences
from transport.analysis.replay.replay_of_agent import ReplayedStep
from transport.log.tables import RATE_NAMES
from transport.protocol.wire.messages import Plan

# Of agent 1, which owns UAV1 and UAV3: five steps of zeros.
RECORDED = Plan(
    sender="agent1",
    incarnation=0,
    sequence=0,
    tick=7,
    agent=1,
    start_tick=7,
    negotiation=0,
    shared=True,
    uavs=(1, 3),
    uav_states=np.zeros((2, 12)),
    inputs=np.zeros((5, 8)),
    corrections=np.zeros((5, 8)),
    status="solved",
)


def replayed(*entries: tuple[int, int, float], steps: int = 5) -> Plan:
    """Return the recorded plan with other inputs, each by step, column and value."""
    inputs = np.zeros((steps, 8))
    for step, column, value in entries:
        inputs[step, column] = value
    return replace(RECORDED, inputs=inputs)


def compared(answers: tuple[Plan, ...], recorded: tuple[Plan, ...]) -> Comparison:
    """Return the comparison of one tick."""
    comparison = Comparison()
    comparison.add(ReplayedStep(tick=7, answers=answers, recorded=recorded))
    return comparison


# UAV1 0.5 N at step 0 and 0.3 N m at step 2, UAV3 2 N at step 3 and 0.1 N m at step 0.
APART = ((0, 0, 0.5), (3, 4, -2.0), (0, 7, 0.1), (2, 1, -0.3))


@pytest.mark.parametrize("steps", [5, 4])
def test_inputs_apart_at_the_first_step_and_over_the_common_horizon(steps: int) -> None:
    """The largest of both UAVs, thrust and moments apart; a fifth step that one plan lacks does not count."""
    recorded = replace(RECORDED, inputs=np.vstack([np.zeros((4, 8)), np.full((1, 8), 9.0)]))
    answer = replayed(*APART, steps=steps)
    comparison = compared((answer,), (recorded if steps == 4 else RECORDED,))
    assert comparison.inputs_apart == [InputsApart(7, 0.5, 0.1, 2.0, 0.3)]
    assert comparison.inputs_apart[0].largest == 2.0


@pytest.mark.parametrize(("size", "tick"), [(0.9, 3), (1.0, 5), (1.9, 5), (2.0, None)])
def test_first_tick_beyond_a_size(size: float, tick: int | None) -> None:
    """A difference as large as the size is not beyond it; thrust and moments count alike."""
    ticks = [InputsApart(2, 0.0, 0.0, 0.5, 0.1), InputsApart(3, 0.0, 0.0, 0.1, 1.0)]
    comparison = Comparison(inputs_apart=[*ticks, InputsApart(5, 0.0, 0.0, 2.0, 0.0)])
    assert comparison.first_beyond(size) == tick


def test_first_difference_is_of_the_earlier_iteration() -> None:
    """Of two iterations of one tick the one that more follow comes first, whatever field differs."""
    later = replace(RECORDED, start_tick=8)
    earlier = replace(replayed((0, 0, 0.5)), negotiation=1)
    comparison = compared((later, earlier), (RECORDED, replace(RECORDED, negotiation=1)))
    first = comparison.first
    assert first is not None
    assert (first.negotiation, first.field, first.size) == (1, "plan.inputs", 0.5)


def test_a_shorter_array_differs_by_its_length() -> None:
    """Arrays of different shapes have no entry in common: both lengths are told."""
    (difference,) = differences(replayed(steps=4), RECORDED)
    assert (difference.got, difference.expected) == ("4 entries", "5 entries")
    assert (difference.where, difference.size) == ("", None)


def test_a_commanded_rate_has_its_own_name() -> None:
    """Column 6 of UAV1 and UAV3 is the rate about y of UAV3."""
    (difference,) = differences(replayed((1, 6, 0.25)), RECORDED, RATE_NAMES)
    assert difference.where == "[1, 6], UAV3 rate_y_rad_s, step 1 of the horizon"
    assert difference.size == 0.25


STATES = np.zeros((2, 12))
STATES[1, 3] = -0.5
CORRECTIONS = np.zeros((5, 8))
CORRECTIONS[2, 5] = 0.25


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"status": "limit"}, ("limit", "solved", "", None)),
        ({"start_tick": 9}, ("9", "7", "", 2.0)),
        ({"uav_states": STATES}, ("-0.5", "0.0", "[1, 3]", 0.5)),
        (
            {"corrections": CORRECTIONS},
            ("0.25", "0.0", "[2, 5], UAV3 moment_x_Nm, step 2 of the horizon", 0.25),
        ),
        ({"inputs": -RECORDED.inputs}, ("-0.0", "0.0", "[0, 0], UAV1 thrust_N, step 0 of the horizon", 0.0)),
    ],
)  # fmt: skip
def test_a_difference_is_told_by_both_values_and_its_entry(
    change: dict[str, Any], told: tuple[str, str, str, float | None]
) -> None:
    """Numbers have a size, texts none; an entry of inputs has its UAV, and zeros of different signs differ."""
    (one,) = differences(replace(RECORDED, **change), RECORDED)
    assert (one.name, one.tick) == (*change, 7)
    assert (one.got, one.expected, one.where, one.size) == told


def test_a_tick_with_an_answer_that_the_log_lacks_is_not_compared() -> None:
    """All or nothing: also the plan that the log has is left out."""
    comparison = Comparison()
    proposal = replace(RECORDED, negotiation=1)
    comparison.add(ReplayedStep(tick=7, answers=(proposal, RECORDED), recorded=(None, RECORDED)))
    assert (comparison.unrecorded, comparison.ticks, comparison.plans) == ([7], [], 0)


def test_ignored_fields_do_not_count_and_inputs_are_those_of_the_last_iteration() -> None:
    """Proposals of a negotiation are compared, but are not the inputs of a tick."""
    proposal = replace(replayed((0, 0, 0.5)), negotiation=1)
    last = replayed((0, 0, 0.25))
    recorded = (replace(RECORDED, negotiation=1), RECORDED)
    comparison = compared((proposal, last), recorded)
    assert [apart.thrust_N for apart in comparison.inputs_apart] == [0.25]
    assert (comparison.plans, comparison.identical) == (2, 0)

    ignoring = Comparison()
    step = ReplayedStep(tick=7, answers=(proposal, last), recorded=recorded)
    ignoring.add(step, ignored=("plan.inputs",))
    assert (ignoring.plans, ignoring.identical, ignoring.by_field) == (2, 2, {})
