"""Computation of the radio: `python -m benchmarks.radio.computation` renews its table in docs/record/radio.md.

Runs in memory with a radio and without one, in turns. The computation is the processor time of the
coordinator's radio within the run: sends, channel, and its reports. The runs have the same states, so
their difference is the computation and all messages about it.
"""

import argparse
import sys
import time
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.radio.__main__ import DOCUMENT
from benchmarks.runs import digits, origin, quiet, setup
from docs.tables import put, table
from transport.coordinator.radio import TeamAir
from transport.flight import memory
from transport.protocol.scenario.setup.run_setup import Setup

TICKS = {4: 200, 16: 60}  # by the number of UAVs
TURNS = 8
HEADINGS = (
    "UAVs",
    "tick, ms",
    "computation, ms",
    "share of the tick",
    "tick over that without a radio",
)


def main() -> None:
    """Measure all team sizes, print the table and renew it in the document."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.radio.computation", description=__doc__
    )
    parser.add_argument("--turns", type=int, default=TURNS, help="runs of each kind")
    parser.add_argument("--dry", action="store_true", help="write nothing")
    given = parser.parse_args()

    content = table(HEADINGS, [row(uavs, given.turns) for uavs in TICKS])
    sys.stdout.write(f"{content}\n")
    if not given.dry:
        text = (
            "`resilient` resized to N UAVs, 6 Mb/s, slots. Processor time in memory, "
            f"medians (smallest to largest) of {given.turns} runs. {origin()}."
        )
        put(DOCUMENT, "computation", f"{text}\n\n{content}")


def row(uavs: int, turns: int) -> tuple[str, ...]:
    """Return the row of a team size."""
    climb = (
        f"maneuver.phase=[{{name='climb',duration_s={TICKS[uavs] * 0.05!r},"
        "displacement_m=[0.5,0,-1.0]}]"
    )
    without = setup("resilient", climb, uavs=uavs)
    radio = setup("resilient", climb, "radio={}", uavs=uavs)

    ticks_ms = []
    computed_ms = []
    ratios = []
    for turn in range(turns + 1):
        other_ms = 0.0 if turn % 2 else run_ms(without)[0]
        tick_ms, own_ms = run_ms(radio)
        if turn % 2:
            other_ms = run_ms(without)[0]
        if turn == 0:
            continue  # fills caches
        ticks_ms.append(tick_ms)
        computed_ms.append(own_ms)
        ratios.append(tick_ms / other_ms)

    shares = 100.0 * np.array(computed_ms) / np.array(ticks_ms)
    return (
        str(uavs),
        digits(float(np.median(ticks_ms))),
        digits(float(np.median(computed_ms))),
        f"{np.median(shares):.1f} % ({shares.min():.1f} to {shares.max():.1f})",
        f"{np.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})",
    )


def run_ms(run: Setup) -> tuple[float, float]:
    """Return the processor time of a tick, and of its radio, ms."""
    spent_ns = [0]

    def timed(method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            begin_ns = time.thread_time_ns()
            result = method(*arguments, **options)
            spent_ns[0] += time.thread_time_ns() - begin_ns
            return result

        return call

    with quiet(), patch.object(TeamAir, "opened", timed(TeamAir.opened)):
        begin_ns = time.thread_time_ns()
        memory.simulate(run)
        whole_ns = time.thread_time_ns() - begin_ns
    return whole_ns / run.ticks / 1e6, spent_ns[0] / run.ticks / 1e6


if __name__ == "__main__":
    main()
