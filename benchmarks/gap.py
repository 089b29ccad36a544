"""Passages through a gap: `python -m benchmarks.gap` flies `gap` with many seeds and writes docs/results.md.

Seeds draw noise, delays, losses and gusts.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import transport
from benchmarks.campaign import tabulate
from protocol.scenario.setup import Setup
from transport.log.run_log import RunLog

# Cases with their settings and numbers of seeds.
CASES: dict[str, tuple[dict[str, Any], int]] = {
    "the scenario": ({}, 20),
    "perfect network": ({"links.delay_s": 0.0, "links.loss": 0.0}, 5),
    "gusts of 1.5 m/s, estimated": (
        {"plant.wind.gust_mps": [1.5, 1.5, 1.5], "controller.disturbance.estimate": True},
        5,
    ),
}
COLUMNS = ("Case", "Completed", "Margins kept", "UAVs, cm", "Rods, cm", "Payload, cm", "Worst error rms, cm")


def clearances(_: Setup, summary: Any, __: RunLog) -> dict[str, float | None]:
    """Return the smallest distances of UAVs, rods and payload from the walls."""
    return dict(summary["clearance_min_m"])


def margins_cm() -> list[float]:
    """Return the margins of UAVs, rods and payload."""
    section = transport.Scenario("gap").setup.obstacles[0]
    return [100.0 * margin_m for margin_m in (section.margin_m, section.load_margin_m, section.load_margin_m)]


def cells(flown: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the number of runs that keep the margins, the smallest distances and the largest error."""
    clear_cm = 100.0 * np.array([[run[of] for of in ("uav", "rod", "payload")] for run in flown])
    kept = (clear_cm >= margins_cm()).all(axis=1).sum()
    worst_cm = 100.0 * max(run["payload_rms_m"] for run in flown)
    return [f"{kept} of {len(flown)}", *(f"{least:.1f}" for least in clear_cm.min(axis=0)), f"{worst_cm:.2f}"]


def text() -> str:
    """Return the text above the table."""
    uav_cm, load_cm, _ = margins_cm()
    margins = f"margins {uav_cm:g} cm for UAVs, {load_cm:g} cm for rods and payload"
    return f"Smallest distances from the walls over all seeds; {margins}; `python -m benchmarks.gap`:"


if __name__ == "__main__":
    tabulate("gap", __doc__, "gap", CASES, COLUMNS, cells, text, clearances)
