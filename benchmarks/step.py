"""Stages of an agent's step, over teams and horizons."""

from collections.abc import Callable
from unittest.mock import patch

import numpy as np

from benchmarks.effort import Effort
from benchmarks.page import Table
from benchmarks.runs import setup, step_times
from benchmarks.timing import Times, digits
from model import native
from model.arrays import Array
from protocol.wire.messages import STAGES

PLAIN = "paper, kernels not compiled"
SHOWN = ("estimate", "linearise", "discretise", "condense", "solve")

TEXT = (
    "Processor time of a step and its stages, ms, medians, and the 99th percentile of the step. `resilient` resized to "
    "N UAVs, one per agent; `paper` and `centralized` unchanged; the last row without the kernels in C. Runs in "
    "memory, in turns, until each case has {steps} steps."
)


def measure(effort: Effort, log: Callable[[str], None]) -> list[Table]:
    """Run every team at every horizon until each has enough steps."""
    cases = [("resilient", uavs, horizon) for uavs in effort.teams for horizon in effort.horizons]
    cases += [("paper", 4, 20), ("centralized", 4, 20), (PLAIN, 4, 20)]
    taken: dict[tuple[str, int, int], list[Array]] = {case: [] for case in cases}
    while waiting := [case for case, runs in taken.items() if sum(map(len, runs)) < effort.steps]:
        for name, uavs, horizon in waiting:
            log(f"{name}, {uavs} UAVs, N_p = {horizon}")
            size = uavs if name == "resilient" else None
            run = setup(name.partition(",")[0], effort.climb, f"controller.horizon={horizon}", uavs=size)
            with patch.object(native, "AVAILABLE", native.AVAILABLE and name != PLAIN):
                taken[name, uavs, horizon].append(step_times(run))
    rows = []
    for (name, uavs, horizon), runs in taken.items():
        ms = np.concatenate(runs)
        stages = [digits(float(np.median(ms[:, STAGES.index(stage)]))) for stage in SHOWN]
        rows.append((f"`{name}`", str(uavs), str(horizon), *stages, *Times(ms[:, STAGES.index("total")]).cells))
    columns = ("scenario", "UAVs", "N_p", *SHOWN, "step", "p99")
    return [Table(text=TEXT.format(steps=effort.steps), columns=columns, rows=rows)]
