"""Processor time of plant and codec."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from benchmarks.runs import CLIMB, BenchmarkError, messages, setup
from benchmarks.timing import WARM_UP, spread, times_ms
from docs.tables import table
from plant.node import PlantNode
from protocol.admission.gate import Gate
from protocol.scenario.setup import Setup
from protocol.wire.codec import decode, encode
from protocol.wire.keys import Keys
from protocol.wire.messages import Plan

TEXT = (
    "Processor time, ms, median (99th percentile). The plant integrates one sampling period of 50 ms in steps of "
    "`plant.step_s`. A plan has one UAV and {horizon} steps, {size} bytes. All checks: size, form, values, key, "
    "sender, incarnation, order."
)


def measure() -> str:
    """Integrate, and encode and decode the plans of short runs, and return the table."""
    rows = [[f"plant, one period, {uavs} UAVs", spread(integration("rods", uavs))] for uavs in (2, 4, 8, 16)]
    rows.append(["the same in MuJoCo, 4 UAVs", spread(integration("mujoco", 4))])
    run = setup("resilient", CLIMB)
    plans = [message for message in messages(run) if isinstance(message, Plan) and message.agent == 1]
    data = [encode(plan) for plan in plans]
    rows.append(["plan to bytes", spread(times_ms([partial(encode, plan) for plan in plans]))])
    rows.append(["bytes to plan", spread(times_ms([partial(decode, part) for part in data]))])
    rows.append(["bytes to plan, all checks", spread(checking(run, plans, data))])
    text = TEXT.format(horizon=run.settings.horizon, size=len(data[-1]))
    return f"{text}\n\n{table(['', 'time'], rows)}"


def integration(engine_name: str, uavs: int) -> list[float]:
    """Return times of one sampling period of the plant in hover."""
    run = setup("resilient", CLIMB, f"plant.engine={engine_name}", uavs=uavs)
    engine = PlantNode(run).engine
    engine.reset(run.initial_state())
    return times_ms([partial(engine.advance, run.hover.u, None, run.settings.sampling_period_s)], 400)


def checking(run: Setup, plans: Sequence[Plan], data: Sequence[bytes]) -> list[float]:
    """Return times of plans back from bytes with all checks of a process of the run.

    Raises: BenchmarkError: a plan is refused.
    """
    keys = Keys(run.scenario.name)
    gate = Gate("plant", keys, replace(run.shape, relayed=False))
    accepted = (message for part in data for message in gate.accept(keys.of(plans[0]), part))
    found = times_ms([partial(next, accepted)], len(plans) - WARM_UP)  # none twice, as it refuses repeated messages
    if gate.rejections.total:
        raise BenchmarkError(f"codec: expected all plans to be accepted, got {gate.rejections.total} refusals")
    return found
