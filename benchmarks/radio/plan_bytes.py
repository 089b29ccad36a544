"""Bytes of plans: `python -m benchmarks.radio.plan_bytes` renews their table in docs/record/radio.md.

A run of `resilient` is repeated with plans that the other agents receive in a shorter form. The
table has the bytes of each form, and how far the run is from that with whole plans.
"""

import sys
import zlib
from collections.abc import Callable, Sequence
from itertools import pairwise
from unittest.mock import patch

import numpy as np
from msgspec.structs import replace

from benchmarks.radio.__main__ import DOCUMENT
from benchmarks.runs import origin, setup
from docs.tables import put, table
from transport.agent.node import AgentNode
from transport.flight.memory import simulate
from transport.model.arrays import Array
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.codec import encode, encoded_length
from transport.protocol.wire.messages import Message, Plan, PlantState

HEADINGS = ("form of a plan", "bytes", "perfect network", "100 ms late, 30 % lost", "agent 2 dies")
CLIMB = (
    "maneuver.phase=[{name='hover',duration_s=1.0,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=3.0,displacement_m=[0.5,0,-1.0]},"
    "{name='hover',duration_s=2.0,displacement_m=[0,0,0]}]"
)
DEATH = (
    "clock.on_agent_loss=continue",
    "faults.event=[{at_s=2.0,do='kill',target='agent2'}]",
)
NETWORKS = ((), ("links.delay_s=0.1", "links.loss=0.3"), DEATH)
_MM_PER_M = 1e3
Form = Callable[[Plan], Plan]  # what an agent receives of a plan
_FLOAT64, _FLOAT32 = 8, 4  # bytes of a number


def main() -> None:
    """Measure, print the table and renew it in the document."""
    runs = [setup("resilient", CLIMB, *network) for network in NETWORKS]
    whole = [flown(run, _whole) for run in runs]
    plans = [one for one in whole[0] if isinstance(one, Plan) and one.agent == 2]
    rows = [
        ("whole, float64", mean_length([encode(plan) for plan in plans]), *["equal bits"] * 3),
        ("the same compressed, zlib", mean_length(compressed(plans)), *["equal bits"] * 3),
        (
            "differences from the last plan, compressed",
            mean_length(differences(plans)),
            *["equal bits", "useless without the last plan", "equal bits"],
        ),
        row("first input and corrections: `inputs=first`", runs, whole, first_input),
        row("float32", runs, whole, single),
        row("first input and corrections, float32", runs, whole, _both),
        row("inputs without corrections", runs, whole, without_corrections),
    ]
    content = table(HEADINGS, rows)
    sys.stdout.write(f"{content}\n")
    text = (
        "`resilient`, one UAV for each agent, 20 steps. Largest difference of the payload's position "
        f"in 6 s from the run with whole plans. {origin()}."
    )
    put(DOCUMENT, "bytes", f"{text}\n\n{content}")


def flown(run: Setup, form: Form) -> list[Message]:
    """Return the messages of a run whose agents receive plans in a form."""
    take = AgentNode._take_plan

    def taken(node: AgentNode, plan: Plan, now_ns: int) -> None:
        take(node, form(plan), now_ns)

    messages: list[Message] = []
    with patch.object(AgentNode, "_take_plan", taken):
        simulate(run, messages.append)
    return messages


def row(
    text: str, runs: Sequence[Setup], whole: Sequence[Sequence[Message]], form: Form
) -> tuple[str, ...]:
    """Return the row of a form: bytes, and its effect on each network."""
    plans = [one for one in whole[0] if isinstance(one, Plan) and one.agent == 2]
    effects = []
    for run, messages in zip(runs, whole, strict=True):
        apart_m = np.abs(states(flown(run, form)) - states(messages))
        largest_mm = _MM_PER_M * float(apart_m[:, :3].max())
        effects.append(f"{largest_mm:.1g} mm" if apart_m.any() else "equal bits")
    return text, f"{np.mean([length(plan, form) for plan in plans]):.0f}", *effects


def states(messages: Sequence[Message]) -> Array:
    """Return the states of the plant, (ticks, n)."""
    return np.array([one.x for one in messages if isinstance(one, PlantState)])


def length(plan: Plan, form: Form) -> int:
    """Return the bytes of a plan in a form: of the numbers that are sent, in their length."""
    if form is without_corrections:
        return encoded_length(replace(plan, corrections=plan.corrections[:0]))

    # A form with the first input sends that one alone; one of all inputs sends all.
    sent = plan if form is single else replace(plan, inputs=plan.inputs[:1])
    whole = encoded_length(sent)
    if form not in (single, _both):
        return whole
    numbers = sum(array.size for array in (sent.uav_states, sent.inputs, sent.corrections))
    return whole - (_FLOAT64 - _FLOAT32) * numbers


def mean_length(encoded: Sequence[bytes]) -> str:
    """Return the mean length, bytes."""
    return f"{np.mean([len(data) for data in encoded]):.0f}"


def compressed(plans: Sequence[Plan]) -> list[bytes]:
    """Return plans whose numbers are sorted by byte and compressed."""
    return [_packed(_numbers(plan).view(np.uint64)) for plan in plans]


def differences(plans: Sequence[Plan]) -> list[bytes]:
    """Return the bits in which plans differ from the last one, shifted by a step, compressed."""
    found = []
    for before, plan in pairwise(plans):
        inputs = np.vstack([before.inputs[1:], before.inputs[-1:]])
        corrections = np.vstack([before.corrections[1:], 0.0 * before.corrections[-1:]])
        expected = replace(before, inputs=inputs, corrections=corrections)
        bits = _numbers(plan).view(np.uint64) ^ _numbers(expected).view(np.uint64)
        found.append(_packed(bits))
    return found


def _numbers(plan: Plan) -> Array:
    return np.concatenate([plan.uav_states.ravel(), plan.inputs.ravel(), plan.corrections.ravel()])


def _packed(numbers: np.ndarray) -> bytes:
    """Return numbers compressed: all first bytes, all second bytes and so on."""
    by_byte = np.frombuffer(numbers.tobytes(), np.uint8).reshape(-1, 8).T
    return zlib.compress(by_byte.tobytes(), 9)


def _whole(plan: Plan) -> Plan:
    return plan


def first_input(plan: Plan) -> Plan:
    """Return a plan whose first input is held."""
    return replace(plan, inputs=np.repeat(plan.inputs[:1], len(plan.inputs), axis=0))


def single(plan: Plan) -> Plan:
    """Return a plan whose numbers have been float32."""
    return replace(
        plan,
        uav_states=_rounded(plan.uav_states),
        inputs=_rounded(plan.inputs),
        corrections=_rounded(plan.corrections),
    )


def _rounded(numbers: Array) -> Array:
    return numbers.astype(np.float32).astype(np.float64)


def _both(plan: Plan) -> Plan:
    return single(first_input(plan))


def without_corrections(plan: Plan) -> Plan:
    """Return a plan without its corrections."""
    return replace(plan, corrections=np.zeros_like(plan.corrections))


if __name__ == "__main__":
    main()
