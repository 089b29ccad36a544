"""Stages of an agent's step, over teams and horizons."""

from unittest.mock import patch

import numpy as np

from benchmarks.runs import CLIMB, setup, step_times
from benchmarks.timing import digits
from docs.tables import table
from model import native
from model.arrays import Array
from protocol.wire.messages import STAGES

PLAIN = "paper, kernels not compiled"
# Scenario, UAVs, N_p.
CASES = (
    *(("resilient", uavs, 20) for uavs in (2, 4, 8, 16, 32)),
    *(("resilient", 4, horizon) for horizon in (10, 40, 80)),
    *(("paper", 4, 20), ("centralized", 4, 20), (PLAIN, 4, 20)),
)
SHOWN = ("estimate", "linearise", "discretise", "condense", "solve", "total")
STEPS = 400  # fewest of each case

TEXT = (
    "Processor time of a step and its stages, ms, medians, and the 99th percentile of the step. `resilient` resized to "
    "N UAVs, one per agent; `paper` and `centralized` unchanged; the last row without the kernels in C. Runs in "
    f"memory, in turns, until each case has {STEPS} steps."
)


def measure() -> str:
    """Run every case until it has enough steps, and return the table."""
    taken: dict[tuple[str, int, int], list[Array]] = {case: [] for case in CASES}
    while waiting := [case for case, runs in taken.items() if sum(map(len, runs)) < STEPS]:
        for name, uavs, horizon in waiting:
            size = uavs if name == "resilient" else None
            run = setup(name.partition(",")[0], CLIMB, f"controller.horizon={horizon}", uavs=size)
            with patch.object(native, "AVAILABLE", native.AVAILABLE and name != PLAIN):
                taken[name, uavs, horizon].append(step_times(run))
    rows = []
    for (name, uavs, horizon), runs in taken.items():
        ms = np.concatenate(runs)[:, [STAGES.index(stage) for stage in SHOWN]]
        numbers = [*np.median(ms, axis=0), np.percentile(ms[:, -1], 99)]
        rows.append([f"`{name}`", str(uavs), str(horizon), *map(digits, numbers)])
    return f"{TEXT}\n\n{table(['scenario', 'UAVs', 'N_p', *SHOWN[:-1], 'step', 'p99'], rows)}"
