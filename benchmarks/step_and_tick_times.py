"""Times of an agent's step with its stages, of plant and codec, and of a tick with processes: tables of the page."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import tomli_w

from benchmarks.runs import (
    CLIMB,
    BenchmarkError,
    digits,
    kernels,
    messages,
    setup,
    spread,
    step_times,
    times_ms,
)
from docs.tables import table
from transport.flight.roles import plant_run
from transport.model.arrays import Array
from transport.model.kernels import native
from transport.plant.node import PlantNode
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.codec import decode, encode
from transport.protocol.wire.messages import STAGES, Plan

# Scenario, UAVs, N_p.
CASES = (
    *(("resilient", uavs, 20) for uavs in (2, 4, 8, 16, 32)),
    *(("resilient", 4, horizon) for horizon in (10, 40, 80)),
    *(("paper", 4, 20), ("centralized", 4, 20)),
)
LONG_CLIMB = "maneuver.phase=[{name='climb',duration_s=5.0,displacement_m=[0.5,0,-1.0]}]"
SHOWN = ("estimate", "linearise", "discretise", "condense", "solve", "total")
STEPS = 400  # fewest of each case
STEP_TEXT = (
    "Processor time of a step and its stages, ms, medians, and the 99th percentile of the step. `resilient` resized to "
    "N UAVs, one per agent; `paper` and `centralized` unchanged. Runs in memory, in turns, until each case has "
    f"{STEPS} steps."
)
WIDTHS = (8, 4, 2)
WIDTH_CASES = (("paper", 4), ("resilient", 4), ("resilient", 16), ("centralized", 4))
WIDTH_TEXT = (
    "The same with vectors of 8 doubles (AVX-512), of 4 (AVX2) and of 2 in the kernels, as far as this processor has "
    "them, and with Python functions in place of the kernels: medians, ms. The compiled model is the same."
)
PARTS_TEXT = (
    "Processor time, ms, median (99th percentile). The plant integrates one sampling period of 50 ms in steps of "
    "`plant.step_s`. A plan has one UAV and {horizon} steps, {size} bytes."
)
LOOP_TEXT = (
    "`resilient` resized to N UAVs, run by `transport run` as fast as possible; wall-clock times in ms. Tick: mean. "
    "Step of an agent, and network (rest of the tick without the slowest step, `rest_of_tick_ms`): median (99th "
    "percentile)."
)


_Case = TypeVar("_Case", bound=tuple[Any, ...])


def in_turns(cases: Sequence[_Case], times_of: Callable[..., Array]) -> dict[_Case, Array]:
    """Return the times of the stages `SHOWN` of each case, (steps, stages), ms.

    The cases run in turns, so that a slow period of the machine affects all alike, until each has
    `STEPS` steps. `times_of` returns those of one run of a case, with all `STAGES`.
    """
    taken: dict[_Case, list[Array]] = {case: [] for case in cases}
    while waiting := [case for case, runs in taken.items() if sum(map(len, runs)) < STEPS]:
        for case in waiting:
            taken[case].append(times_of(*case))
    columns = [STAGES.index(stage) for stage in SHOWN]
    return {case: np.concatenate(runs)[:, columns] for case, runs in taken.items()}


def step() -> str:
    """Return the table of the stages of an agent's step, over teams and horizons."""

    def times_of(name: str, uavs: int, horizon: int) -> Array:
        size = uavs if name == "resilient" else None
        return step_times(setup(name, CLIMB, f"controller.horizon={horizon}", uavs=size))

    rows = []
    for (name, uavs, horizon), ms in in_turns(CASES, times_of).items():
        numbers = [*np.median(ms, axis=0), np.percentile(ms[:, -1], 99)]
        rows.append([f"`{name}`", str(uavs), str(horizon), *map(digits, numbers)])
    return f"{STEP_TEXT}\n\n{table(['scenario', 'UAVs', 'N_p', *SHOWN[:-1], 'step', 'p99'], rows)}"


def widths() -> str:
    """Return the table of a step with vectors of each width that this processor has, and without kernels."""
    own = native.KERNELS.vector_width() if native.AVAILABLE else 0
    kinds = [str(width) for width in WIDTHS if width <= own]
    cases = [(name, uavs, kind) for name, uavs in WIDTH_CASES for kind in [*kinds, "0"]]

    def times_of(name: str, uavs: int, kind: str) -> Array:
        with kernels(kind):
            setup.cache_clear()  # a model keeps whether there are kernels
            return step_times(setup(name, CLIMB, uavs=uavs if name == "resilient" else None))

    rows = []
    for (name, uavs, kind), ms in in_turns(cases, times_of).items():
        vectors = "none: Python" if kind == "0" else kind
        rows.append([f"`{name}`", str(uavs), vectors, *map(digits, np.median(ms, axis=0))])
    return f"{WIDTH_TEXT}\n\n{table(['scenario', 'UAVs', 'vectors', *SHOWN[:-1], 'step'], rows)}"


def parts() -> str:
    """Return the table of plant and codec."""
    rows = [
        [f"plant, one period, {uavs} UAVs", spread(integration("rods", uavs))]
        for uavs in (2, 4, 8, 16)
    ]
    rows.append(["the same in MuJoCo, 4 UAVs", spread(integration("mujoco", 4))])
    run = setup("resilient", CLIMB)
    plans = [
        message for message in messages(run) if isinstance(message, Plan) and message.agent == 1
    ]
    data = [encode(plan) for plan in plans]
    rows.append(["plan to bytes", spread(times_ms([partial(encode, plan) for plan in plans]))])
    rows.append(["bytes to plan", spread(times_ms([partial(decode, part) for part in data]))])
    text = PARTS_TEXT.format(horizon=run.settings.horizon, size=len(data[-1]))
    return f"{text}\n\n{table(['', 'time'], rows)}"


def integration(engine_name: str, uavs: int) -> list[float]:
    """Return times of one sampling period of the plant in hover, ms."""
    run = setup("resilient", CLIMB, f"plant.engine={engine_name}", uavs=uavs)
    engine = PlantNode(plant_run(run)).engine
    return times_ms(
        [partial(engine.advance, run.hover.u, None, run.settings.sampling_period_s)], 400
    )


def loop() -> str:
    """Return the table of runs with processes.

    Raises: BenchmarkError: a run fails.
    """
    rows = []
    for uavs in (4, 8, 16):
        run = setup("resilient", LONG_CLIMB, uavs=uavs)
        summary = recorded(run)
        spreads = [summary[name] for name in ("agent_step_ms", "rest_of_tick_ms")]
        cells = [f"{digits(values['p50'])} ({digits(values['p99'])})" for values in spreads]
        numbers = (summary["real_time_factor"], summary["startup_s"])
        rows.append(
            [
                str(uavs),
                digits(1e3 * summary["wall_time_s"] / run.ticks),
                *cells,
                *map(digits, numbers),
            ]
        )
    columns = ("UAVs", "tick, ms", "an agent's step", "network", "real-time factor", "start-up, s")
    return f"{LOOP_TEXT}\n\n{table(columns, rows)}"


def recorded(run: Setup) -> dict[str, Any]:
    """Return the summary of a run by `transport run`.

    Raises: BenchmarkError: the command fails.
    """
    with tempfile.TemporaryDirectory(prefix="benchmarks-") as parent:
        scenario, folder = Path(parent) / "run.toml", Path(parent) / "run"
        scenario.write_text(tomli_w.dumps(run.scenario.tree()), encoding="utf-8")
        command = [
            sys.executable,
            "-m",
            "transport",
            "run",
            str(scenario),
            "--out",
            str(folder),
            "--no-figures",
        ]
        code = subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode
        if code != 0:
            raise BenchmarkError(f"{' '.join(command)}: exit code {code}")
        summary: dict[str, Any] = json.loads((folder / "summary.json").read_bytes())
        return summary
