"""Campaigns of many simulations: their options, their runs on all cores, and their rows."""

import argparse
import sys
import tomllib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import transport
from benchmarks.page import section
from docs.tables import ROOT, put
from transport.experiments.cases import More, cases_of_point
from transport.experiments.simulation import Result
from transport.experiments.sweep import simulated

RESULTS = ROOT / "docs" / "results.md"


def options(module: str, text: str | None, *, changes: bool = False) -> argparse.ArgumentParser:
    """Return the parser of a campaign, given its module's docstring; perhaps with the option for settings."""
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{module}", description=(text or "").split("\n")[0])
    if changes:
        parser.add_argument("--set", dest="changes", action="append", default=[], metavar="KEY=VALUE")
    return parser


def changes(given: Sequence[str]) -> dict[str, Any]:
    """Return settings given as KEY=VALUE."""
    return {key: tomllib.loads(f"v={value}")["v"] for key, value in (one.split("=", 1) for one in given)}


def runs(
    scenarios: Sequence[transport.Scenario], seeds: int | Sequence[int] = 1, more: More | None = None
) -> list[list[Result]]:
    """Simulate each scenario with its seeds 0, 1, ... on all cores; return the results of each."""
    counts = [seeds] * len(scenarios) if isinstance(seeds, int) else seeds
    found = zip(scenarios, counts, strict=True)
    return simulated("campaign", [cases_of_point(0, one.validated, one.file, count, more=more) for one, count in found])


def completed(results: Sequence[Result]) -> list[Mapping[str, Any]]:
    """Return the numbers of the completed runs."""
    return [result.numbers for result in results if result.outcome == "completed"]


def say(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def tabulate(
    module: str,
    text: str | None,
    scenario: str,
    cases: Mapping[str, tuple[dict[str, Any], int]],
    columns: Sequence[str],
    cells: Callable[[Sequence[Mapping[str, Any]]], list[str]],
    heading: Callable[[], str],
    more: More | None = None,
) -> None:
    """Simulate a scenario's cases, settings and number of seeds, and print a row for each; all make a table of results.

    A row has its case, the number of completed runs and the cells that follow from the numbers of these.
    """
    parser = options(module, text)
    parser.add_argument("--seeds", type=int, help="of each case (as many as in the document)")
    parser.add_argument("--case", action="append", choices=list(cases), help="print this case; may be repeated")
    given = parser.parse_args()
    rows = []
    for case in given.case or cases:
        settings, seeds = cases[case]
        (found,) = runs([transport.Scenario(scenario).copy(settings)], given.seeds or seeds, more)
        there = completed(found)
        row = [case, f"{len(there)} of {len(found)}", *(cells(there) if there else [])]
        rows.append([*row, *[""] * (len(columns) - len(row))])
        say(" | ".join(rows[-1]))
    if not given.case:
        put(RESULTS, f"bench: {module}", section(heading(), columns, rows))
