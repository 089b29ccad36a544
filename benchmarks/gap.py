"""Passages through a gap: `python -m benchmarks.gap` flies `gap` with many seeds and writes docs/results.md.

Seeds draw noise, delays, losses and gusts.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import transport
from benchmarks.page import Table, write

DOCUMENT = Path(__file__).resolve().parent.parent / "docs" / "results.md"
SECTION = "gap"

# Cases with their settings and numbers of seeds.
CASES: dict[str, tuple[dict[str, Any], int]] = {
    "the scenario": ({}, 20),
    "perfect network": ({"links.delay_s": 0.0, "links.loss": 0.0}, 5),
    "gusts of 1.5 m/s, estimated": (
        {"plant.wind.gust_mps": [1.5, 1.5, 1.5], "controller.disturbance.estimate": True},
        5,
    ),
}


def flown(settings: dict[str, Any], seed: int) -> tuple[float, ...] | None:
    """Return distances of UAVs, rods and payload from the walls, and the payload's rms error, cm; None if diverged."""
    run = transport.fly("gap", {**settings, "seed": seed}, progress=False)
    clear_m, error_m = run.summary["clearance_min_m"], run.summary["payload_tracking"]["rms_m"]
    return (*(100.0 * clear_m[of] for of in ("uav", "rod", "payload")), 100.0 * error_m) if run.completed else None


def main(arguments: Sequence[str] | None = None) -> int:
    """Simulate all cases and write a row for each; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gap", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seeds", type=int, help="of each case (20 of the scenario, 5 of the others)")
    parser.add_argument("--case", action="append", choices=list(CASES), help="print this case; may be repeated")
    options = parser.parse_args(arguments)
    section, rows = transport.Scenario("gap").setup.obstacles[0], []
    margins_cm = 100.0 * np.array([section.margin_m, section.load_margin_m, section.load_margin_m])
    for case in options.case or CASES:
        settings, seeds = CASES[case][0], options.seeds or CASES[case][1]
        found = [flown(settings, seed) for seed in range(seeds)]
        passed = np.array([row for row in found if row is not None]).reshape(-1, 4)
        kept = int((passed[:, :3] >= margins_cm).all(axis=1).sum())
        row = [case, f"{len(passed)} of {seeds}", f"{kept} of {seeds}"]
        if len(passed):
            row += [*(f"{least:.1f}" for least in passed[:, :3].min(axis=0)), f"{passed[:, 3].max():.2f}"]
        rows.append(row + [""] * (7 - len(row)))
        sys.stdout.write(" | ".join(rows[-1]) + "\n")
        sys.stdout.flush()
    columns = ["Case", "Completed", "Margins kept", "UAVs, cm", "Rods, cm", "Payload, cm", "Worst error rms, cm"]
    text = "Smallest distances from the walls over all seeds; margins "
    text += f"{margins_cm[0]:g} cm for UAVs, {margins_cm[1]:g} cm for rods and payload; `python -m benchmarks.gap`:"
    if not options.case:
        write(DOCUMENT, {SECTION: str(Table(text=text, columns=columns, rows=rows))})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
