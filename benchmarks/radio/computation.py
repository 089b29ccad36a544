"""Computation of the radio: `python -m benchmarks.radio.computation` renews its table in docs/radio.md.

Runs in memory, in turns: without a radio; with one; and with one whose computation is replaced by
its recorded news. The last two have the same messages, so their difference is the computation
alone. Processor time of the thread.
"""

import argparse
import itertools
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.radio.__main__ import DOCUMENT
from benchmarks.runs import digits, origin, quiet, setup
from docs.tables import put, table
from transport.coordinator import air
from transport.flight import memory
from transport.protocol.scenario.setup import Setup
from transport.protocol.scenario.team_radio import TeamRadio

UAVS = (4, 16)
TICKS = {4: 200, 16: 60}
TURNS = 30
HEADINGS = (
    "UAVs",
    "tick without a radio, ms",
    "computation, share of a tick",
    "with all messages of the radio",
)
News = list[dict[str, Any]]


def main() -> None:
    """Measure all team sizes, print the table and renew it in the document."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.radio.computation", description=__doc__
    )
    parser.add_argument("--turns", type=int, default=TURNS, help="runs of each kind")
    parser.add_argument("--dry", action="store_true", help="write nothing")
    given = parser.parse_args()

    content = table(HEADINGS, [row(uavs, given.turns) for uavs in UAVS])
    sys.stdout.write(f"{content}\n")
    if not given.dry:
        text = (
            "`resilient` resized to N UAVs, 6 Mb/s, slots. Processor time in memory, "
            f"medians (quartiles) over {given.turns} turns. {origin()}."
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
    recorded = news_of(radio)

    times_ms: dict[str, list[float]] = {"without": [], "computed": [], "recorded": []}
    for turn in range(turns + 1):
        found = {
            "without": lambda: run_ms(without),
            "computed": lambda: run_ms(radio),
            "recorded": lambda: with_recorded_ms(radio, recorded),
        }
        # Each comes first, second and third equally often.
        for name in list(itertools.permutations(found))[turn % 6]:
            times_ms[name].append(found[name]())

    # The first turn fills caches.
    without_ms, computed_ms, recorded_ms = [np.array(ms[1:]) for ms in times_ms.values()]
    return (
        str(uavs),
        digits(float(np.median(without_ms)) / without.ticks),
        percent((computed_ms - recorded_ms) / computed_ms),
        percent((computed_ms - without_ms) / without_ms),
    )


def percent(shares: Any) -> str:
    """Return median and quartiles of shares."""
    low, middle, high = 100.0 * np.percentile(shares, (25.0, 50.0, 75.0))
    return f"{middle:.1f} % ({low:.1f} to {high:.1f})"


def run_ms(run: Setup) -> float:
    """Return the processor time of a run, ms."""
    with quiet():
        begin_ns = time.thread_time_ns()
        memory.simulate(run)
        return (time.thread_time_ns() - begin_ns) / 1e6


def news_of(run: Setup) -> News:
    """Return what the radio tells in a run, window by window."""
    news: News = []
    advance = TeamRadio.advance

    def observed(radio: TeamRadio, *arguments: Any, **options: Any) -> Mapping[str, Any]:
        news.append(advance(radio, *arguments, **options))
        return news[-1]

    with patch.object(TeamRadio, "advance", observed):
        memory.simulate(run)
    return news


def with_recorded_ms(run: Setup, news: News) -> float:
    """Return the processor time of a run whose radio tells what was recorded, ms."""
    with recorded_radio(iter(news)):
        return run_ms(run)


@contextmanager
def recorded_radio(news: Iterator[dict[str, Any]]) -> Iterator[None]:
    """Replace the computation of the radio by its recorded news."""

    class Recorded:
        """Radio without computation."""

        def __init__(self, *_: Any) -> None:
            pass

        def send(self, *_: Any) -> None:
            """Take in a plan."""

        def advance(self, *_: Any, **__: Any) -> dict[str, Any]:
            """Return the next news."""
            return dict(next(news))

    with patch.object(air, "TeamRadio", Recorded):
        yield


if __name__ == "__main__":
    main()
