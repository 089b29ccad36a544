"""Campaigns search for defects by many random runs.

`python -m tests.campaigns NAME`, `make campaigns` for all.

  scenarios      mutates scenarios, validates and simulates them
  early-signals  interrupts commands within their first second
  signals        kills, freezes and interrupts every process of a run, also that of the report

`python -m tests.campaigns.wire` sends bad messages, and `python -m tests.campaigns.soak` watches
resources for long. Exit code 1 if any run has a problem; each run can be repeated by its number.
"""

import argparse
import sys
from pathlib import Path

from tests.campaigns import early_signals, harness, scenarios, signals

# Function of a run, runs by default, and runs at a time: a run of processes has eight of them.
CAMPAIGNS: dict[str, tuple[harness.Execute, int, int]] = {
    "scenarios": (scenarios.execute, 200, 1),
    "early-signals": (early_signals.execute, 300, 1),
    "signals": (signals.execute, 200, 2),
}


def main() -> int:
    """Conduct a campaign with the options of the command line; return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.campaigns",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", choices=CAMPAIGNS)
    parser.add_argument("--runs", type=int, help="number of runs")
    parser.add_argument(
        "--first", type=int, default=0, help="number of the first run, to repeat one"
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed of all runs")
    parser.add_argument("--jobs", type=int, help="runs at a time")
    parser.add_argument(
        "--out", type=Path, help="folder for runs with problems; runs/NAME-SEED by default"
    )
    options = parser.parse_args()
    execute, runs, jobs = CAMPAIGNS[options.name]
    options.runs = runs if options.runs is None else options.runs
    options.jobs = options.jobs or jobs
    return harness.conduct(options.name, execute, options)


if __name__ == "__main__":
    sys.exit(main())
