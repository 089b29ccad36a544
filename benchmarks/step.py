"""Stages of an agent's step, over teams and horizons."""

from collections.abc import Callable
from itertools import product
from unittest.mock import patch

import numpy as np
from msgspec.structs import replace

from benchmarks.effort import Effort
from benchmarks.page import section
from benchmarks.runs import messages, setup, step_times
from benchmarks.timing import Times, digits
from model import native
from model.arrays import Array
from protocol.wire.codec import encode
from protocol.wire.messages import STAGES, Plan
from protocol.wire.names import agent_name

PLAIN = "paper, kernels not compiled"
SHOWN = ("estimate", "linearise", "discretise", "condense", "solve")

TEXT = (
    "Processor time of a step and its stages, ms, medians, and the 99th percentile of the step. `resilient` resized to "
    "N UAVs, one per agent; `paper` and `centralized` unchanged; the last row without the kernels in C. Runs in "
    "memory, in turns, until each case has {steps} steps. From {least} to {most} UAVs, at N_p = 20, the step grows "
    "with N to the power of {exponent:.2f}."
)
NETWORK = (
    "With {agents} UAVs, an agent each, and N_p = 20 there are {plans:,} plans of {size:,} bytes a second: {mbits:.0f} "
    "Mbit/s where the network sends each to all at once, and {deliveries:,} messages and {separate:.0f} Mbit/s where "
    "an agent sends it to each other agent; bytes of messages, without those of Zenoh, TCP and IP."
)


def measure(effort: Effort, log: Callable[[str], None]) -> list[str]:
    """Run every team at every horizon until each has enough steps."""
    cases = [("resilient", uavs, horizon) for uavs, horizon in product(effort.teams, effort.horizons)]
    cases += [("resilient", uavs, 20) for uavs in effort.large_teams]
    cases += [("paper", 4, 20), ("centralized", 4, 20), (PLAIN, 4, 20)]
    taken: dict[tuple[str, int, int], list[Array]] = {case: [] for case in cases}
    while waiting := [case for case, runs in taken.items() if sum(map(len, runs)) < effort.steps]:
        for name, uavs, horizon in waiting:
            log(f"{name}, {uavs} UAVs, N_p = {horizon}")
            size = uavs if name == "resilient" else None
            run = setup(name.partition(",")[0], effort.climb, f"controller.horizon={horizon}", uavs=size)
            with patch.object(native, "AVAILABLE", native.AVAILABLE and name != PLAIN):
                taken[name, uavs, horizon].append(step_times(run))
    rows, medians = [], {}
    for (name, uavs, horizon), runs in taken.items():
        ms = np.concatenate(runs)
        medians[name, uavs, horizon] = np.median(ms[:, STAGES.index("total")])
        stages = [digits(float(np.median(ms[:, STAGES.index(stage)]))) for stage in SHOWN]
        rows.append((f"`{name}`", str(uavs), str(horizon), *stages, *Times(ms[:, STAGES.index("total")]).cells))
    columns = ("scenario", "UAVs", "N_p", *SHOWN, "step", "p99")
    teams = [*effort.teams, *effort.large_teams][-4:]
    exponent = np.polyfit(np.log(teams), np.log([medians["resilient", uavs, 20] for uavs in teams]), 1)[0]
    text = TEXT.format(steps=effort.steps, least=teams[0], most=teams[-1], exponent=exponent)
    return [section(f"{text} {network(effort, 64)}", columns, rows)]


def network(effort: Effort, agents: int) -> str:
    """Return how many messages and bits a second the plans of agents with one UAV each are."""
    run = setup("resilient", effort.climb)
    plan = next(message for message in reversed(messages(run)) if isinstance(message, Plan))
    size = len(encode(replace(plan, sender=agent_name(agents), agent=agents, uavs=(agents,))))
    plans = round(agents / run.settings.sampling_period_s)
    mbits, others = 8e-6 * plans * size, agents - 1
    return NETWORK.format(
        agents=agents, plans=plans, size=size, mbits=mbits, deliveries=plans * others, separate=mbits * others
    )
