"""Processor time of plant and codec."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from benchmarks.effort import Effort
from benchmarks.page import BenchmarkError, section
from benchmarks.runs import messages, setup
from benchmarks.timing import WARM_UP, Times, in_turns, joined
from model.arrays import Array
from plant.node import PlantNode
from protocol.admission.gate import Gate
from protocol.scenario.setup import Setup
from protocol.wire.codec import decode, encode
from protocol.wire.keys import Keys
from protocol.wire.messages import Message, Plan, PlantState

TEXT = (
    "Processor time, ms. The plant integrates one sampling period in steps of `plant.step_s`. A plan has one UAV "
    "and {horizon} steps, {size} bytes. All checks: size, form, values, key, sender, incarnation, order."
)


def measure(effort: Effort, log: Callable[[str], None]) -> list[str]:
    """Integrate the states and encode and decode the plans of short runs."""
    rows = []
    for uavs in effort.teams:
        log(f"plant of {uavs} UAVs")
        run = setup("resilient", effort.climb, uavs=uavs)
        rows.append((f"plant, one period, {uavs} UAVs", *integration(run, messages(run), effort.repetitions).cells))
    log("codec")
    run = setup("resilient", effort.climb)
    plans = [message for message in messages(run) if isinstance(message, Plan) and message.agent == 1]
    rows += [(name, *times.cells) for name, times in coding(run, plans, effort.repetitions).items()]
    text = TEXT.format(horizon=run.settings.horizon, size=len(encode(plans[-1])))
    return [section(text, ("", "median", "p99"), rows)]


def integration(run: Setup, sent: list[Message], repetitions: int) -> Times:
    """Time one sampling period of the plant from every state of a run."""
    engine, period_s = PlantNode(run).engine, run.settings.sampling_period_s

    def integrate(x: Array, u: Array) -> None:
        engine.reset(x)
        engine.advance(u, None, period_s)

    tasks = {str(m.tick): partial(integrate, m.x, m.u) for m in sent if isinstance(m, PlantState)}
    return joined(in_turns(tasks, repetitions).values())


def coding(run: Setup, plans: list[Plan], repetitions: int) -> dict[str, Times]:
    """Time plans to bytes, back, and back with all checks of a process of the run.

    Raises: BenchmarkError: a plan is refused.
    """
    keys = Keys(run.scenario.name)
    data, key = [encode(plan) for plan in plans], keys.of(plans[0])
    shape = replace(run.shape, relayed=False)
    turns = []
    for _ in range(repetitions):
        gate = Gate("plant", keys, shape)  # a new one, as it refuses repeated messages
        calls: dict[str, Callable[[], object]] = {
            "plan to bytes": partial(next, map(encode, plans)),
            "bytes to plan": partial(next, map(decode, data)),
            "bytes to plan, all checks": partial(
                next, (message for part in data for message in gate.accept(key, part))
            ),
        }
        turns.append(in_turns(calls, len(plans) - WARM_UP))
        if gate.rejections.total:
            raise BenchmarkError(f"codec: expected all plans to be accepted, got {gate.rejections.total} refusals")
    return {name: joined(turn[name] for turn in turns) for name in turns[0]}
