"""What else a tick takes: the physics, and messages to bytes and back."""

from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.effort import Effort
from benchmarks.flights import messages, setup
from benchmarks.page import BenchmarkError, Table
from benchmarks.timing import WARM_UP, Times, digits, in_turns
from plant.node import PlantNode
from protocol.admission.admission import Admission
from protocol.scenario.setup import Setup
from protocol.wire.codec import decode, encode
from protocol.wire.keys import Keys
from protocol.wire.messages import Message, Plan, PlantState
from protocol.wire.rejections import Rejections

TEXT = (
    "Processor time, ms. The plant integrates one sampling period in steps of `plant.step_s`. A plan is of one UAV "
    "over {horizon} steps, {size} bytes. All checks: size, form, values, key, sender, incarnation, order."
)


def measure(effort: Effort, say: Callable[[str], None]) -> list[Table]:
    """Integrate, encode, decode what was flown and sent on a short flight."""
    rows = []
    for uavs in effort.teams:
        say(f"plant of {uavs} UAVs")
        run = setup("resilient", effort.climb, uavs=uavs)
        times = integration(run, messages(run), effort.repetitions)
        rows.append((f"plant, one period, {uavs} UAVs", digits(times.median), digits(times.p99)))
    say("codec")
    run = setup("resilient", effort.climb)
    plans = [message for message in messages(run) if isinstance(message, Plan) and message.agent == 1]
    for name, times in coding(run, plans, effort.repetitions).items():
        rows.append((name, digits(times.median), digits(times.p99)))
    text = TEXT.format(horizon=run.settings.horizon, size=len(encode(plans[-1])))
    return [Table(text=text, columns=("", "median", "p99"), rows=rows)]


def integration(run: Setup, sent: list[Message], repetitions: int) -> Times:
    """One sampling period of the plant from every state of a flight."""
    plant, period_s = PlantNode(run), run.settings.sampling_period_s
    model, steps = plant.environment.model, plant.steps
    tasks = {
        str(plant_state.tick): partial(model.integrate, plant_state.x, plant_state.u, period_s, steps)
        for plant_state in sent
        if isinstance(plant_state, PlantState)
    }
    return Times(np.concatenate([times.ms for times in in_turns(tasks, repetitions).values()]))


def coding(run: Setup, plans: list[Plan], repetitions: int) -> dict[str, Times]:
    """Plans to bytes, back, and back through the gate of a process of the run."""
    keys = Keys(run.scenario.name)
    data, key = [encode(plan) for plan in plans], keys.of(plans[0])
    turns = []
    for _ in range(repetitions):
        # Nothing gets in twice: a new gate each time round, through which plan after plan goes in its order.
        admission = Admission("plant", keys, run, Rejections())
        admission.announce(plans[0].sender, plans[0].incarnation)
        turns.append(in_turns(_one_after_the_other(admission, key, plans, data), len(plans) - WARM_UP))
    return {name: Times(np.concatenate([turn[name].ms for turn in turns])) for name in turns[0]}


def _one_after_the_other(
    admission: Admission, key: str, plans: list[Plan], data: list[bytes]
) -> dict[str, Callable[[], object]]:
    encoded, decoded, let_in = iter(plans), iter(data), iter(data)

    def read() -> None:
        if admission.read(key, next(let_in)) is None:
            raise BenchmarkError("codec: expected the gate to let a plan in, got a refusal")

    return {
        "plan to bytes": lambda: encode(next(encoded)),
        "bytes to plan": lambda: decode(next(decoded)),
        "bytes to plan, all checks": read,
    }
