"""The step of an agent taken apart, over teams and horizons."""

from collections.abc import Callable

import numpy as np

from benchmarks.effort import Effort
from benchmarks.flights import setup, step_times
from benchmarks.page import Table
from benchmarks.timing import Times, digits
from model.arrays import Array
from protocol.wire.messages import STAGES

SHOWN = ("estimate", "linearise", "discretise", "condense", "solve")

TEXT = (
    "Processor time of a step and its stages, ms, medians; of the step the 99th percentile, too. `resilient` made "
    "into teams of N, one UAV per agent, and `paper` and `centralized` as they are. Flown in memory, in turns, until "
    "each has {steps} steps."
)


def measure(effort: Effort, say: Callable[[str], None]) -> list[Table]:
    """Fly every team at every horizon until each has enough steps."""
    cases = [("resilient", uavs, horizon) for uavs in effort.teams for horizon in effort.horizons]
    cases += [("paper", 4, 20), ("centralized", 4, 20)]
    taken: dict[tuple[str, int, int], list[Array]] = {case: [] for case in cases}
    turn = 0
    while waiting := [case for case, flights in taken.items() if sum(map(len, flights)) < effort.steps]:
        turn += 1
        for name, uavs, horizon in waiting:
            say(f"turn {turn}: {name}, {uavs} UAVs, N_p = {horizon}")
            size = uavs if name == "resilient" else None
            run = setup(name, effort.climb, f"controller.horizon={horizon}", uavs=size)
            taken[name, uavs, horizon].append(step_times(run))
    rows = []
    for (name, uavs, horizon), flights in taken.items():
        ms = np.concatenate(flights)
        stages = [digits(float(np.median(ms[:, STAGES.index(stage)]))) for stage in SHOWN]
        total = Times(ms[:, STAGES.index("total")])
        rows.append((f"`{name}`", str(uavs), str(horizon), *stages, digits(total.median), digits(total.p99)))
    columns = ("scenario", "UAVs", "N_p", *SHOWN, "step", "p99")
    return [Table(text=TEXT.format(steps=effort.steps), columns=columns, rows=rows)]
