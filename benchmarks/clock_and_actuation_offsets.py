"""How far apart the times of the agents may be: when their commands act, and what their clocks show.

The spread of actuation is linear (`transport margins`): commands reach the last UAV late by so much, and
the others by less in equal steps. A flight of each scenario shows what comes of commands that are up to
60 ms late, and further ones how far the clock of the last agent may be ahead. Writes docs/record/guarantees.md;
takes some minutes.

    python -m benchmarks.clock_and_actuation_offsets --write
"""

import argparse
import sys
from collections.abc import Sequence
from typing import Any

from benchmarks.runs import origin
from docs.tables import ROOT, put, table
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.summary_assembly import summarise
from transport.experiments.simulation import run_in_memory
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.setup.run_setup import Setup
from transport.report.laws import ACTUATIONS
from transport.report.margins import HoverMargins, hover_margins, range_text

SCENARIOS = "resilient", "precise", "windy", "eight", "gap", "alone"
LATEST_S = 0.06  # largest delay of the commands in the flights
SPREAD = "spread_s"
OFFSETS_S = (0.04, 0.03, 0.02, 0.015, 0.01, 0.005)
SPREAD_HEADINGS = (
    "scenario", *(f"spread, `{actuation}`" for actuation in ACTUATIONS),
    "flight with commands up to 60 ms late", "attitude", "UAVs apart",
)  # fmt: skip


CLOCK_HEADINGS = "scenario", "one clock ahead", "attitude", "UAVs apart", "as without it"


def of(name: str, *settings: str) -> Setup:
    """Return the run of a ready scenario with some settings."""
    path = find_scenario(name)
    return Setup.of(read_scenario(path, settings), path.name)


def late_commands(run: Setup) -> str:
    """Return the links over which the commands of UAV i of N are i/N of the largest delay late."""
    N = run.system.N
    links = [
        f"{{from='agent{agent}',to='plant',delay_s={LATEST_S * (owned[0] + 1) / N:g}}}"
        for agent, owned in enumerate(run.owned, start=1)
    ]
    return f"links.override=[{','.join(links)}]"


def flown(run: Setup) -> dict[str, Any]:
    """Return the summary of a run."""
    return summarise(AnalysedRun.of(run, run_in_memory(run)))


def spread_cells(run: Setup) -> list[str]:
    """Return the margins of a scenario to the spread of actuation."""
    try:
        found: HoverMargins | None = hover_margins(run)
    except ScenarioError:
        found = None
    if found is None:
        return ["-" for _ in ACTUATIONS]
    return [range_text(SPREAD, found.margins[one].get(SPREAD)) + " ms" for one in ACTUATIONS]


def spread_row(name: str) -> list[str]:
    """Return what commands at different times do to a scenario."""
    run = of(name)
    summary = flown(of(name, late_commands(run)))
    return [f"`{name}`", *spread_cells(run), summary["outcome"], *said(summary)]


def clock_row(name: str) -> list[str]:
    """Return how far the clock of the last agent of a scenario may be ahead."""
    run = of(name)
    without = flown(run)
    separation = run.settings.separation
    least_m = 0.0 if separation is None else separation.minimum_m
    borne_s = 0.0
    borne = without
    shorter = [one for one in OFFSETS_S if one < run.settings.sampling_period_s]
    for offset_s in shorter:
        offsets_s = [0.0] * (len(run.agents) - 1) + [offset_s]
        summary = flown(of(name, f"clock.offsets_s={offsets_s}"))
        if summary["outcome"] == "completed" and summary["separation_min_m"] >= least_m:
            borne_s, borne = offset_s, summary
            break
    return [f"`{name}`", f"{1e3 * borne_s:g} ms", *said(borne), ", ".join(said(without))]


def said(summary: dict[str, Any]) -> list[str]:
    """Return attitude and distance of a flight."""
    return [f"{summary['attitude_max_deg']:.2f} deg", f"{summary['separation_min_m']:.3f} m"]


def main(given: Sequence[str] | None = None) -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.clock_and_actuation_offsets", description=__doc__
    )
    parser.add_argument("--write", action="store_true", help="renew the table of the page")
    parser.add_argument("--table", choices=("spread", "clocks"), help="one table alone")
    options = parser.parse_args(given)
    names = [name for name in SCENARIOS if len(of(name).agents) > 1]
    for place, headings, row in (
        ("bench: spread", SPREAD_HEADINGS, spread_row),
        ("bench: clocks", CLOCK_HEADINGS, clock_row),
    ):
        if options.table is not None and not place.endswith(options.table):
            continue
        rows = []
        for name in names:
            rows.append(row(name))
            sys.stdout.write(", ".join(rows[-1]) + "\n")
            sys.stdout.flush()
        if options.write:
            content = f"{table(headings, rows)}\n\n*{origin()}.*"
            put(ROOT / "docs" / "record" / "guarantees.md", place, content)


if __name__ == "__main__":
    main(sys.argv[1:])
