"""Agile flight: `python -m benchmarks.agile` flies the scenario `eight` with many seeds and writes docs/results.md.

The error is the distance of the payload from its path. Seeds draw noise, delays and losses.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import transport
from benchmarks.page import Table, write
from transport.analysis.series import series_of

DOCUMENT = Path(__file__).resolve().parent.parent / "docs" / "results.md"
SECTION = "agile"

LATE: dict[str, Any] = {"links.delay_s": 0.2, "links.loss": 0.3}
ESTIMATE = {"controller.disturbance.estimate": True}
# A fourth UAV above the payload, which the others can carry without it.
PLACES = [(0.4, 0.0), (-0.2, 0.35), (-0.2, -0.35), (0.0, 0.0)]
FOUR: dict[str, Any] = {
    "system.uav": [
        {"id": i, "mass_kg": 0.6, "inertia_kgm2": [3e-3, 3e-3, 5e-3], "rho_m": [*place, -0.05], "rod_length_m": 1.0}
        for i, place in enumerate(PLACES, start=1)
    ],
    "agents.owned": [[1], [2], [3], [4]],
}


def faults(**targets: str) -> dict[str, Any]:
    """Return settings of faults from the middle of the second lap on, a second apart."""
    events = [{"at_s": 8.0 + i, "do": do, "target": target} for i, (do, target) in enumerate(targets.items())]
    return {"faults.event": events, "clock.on_agent_loss": "continue"}


CASES: dict[str, dict[str, Any]] = {
    "200 ms delay, 30 % loss": LATE,
    "400 ms delay, 60 % loss": {"links.delay_s": 0.4, "links.loss": 0.6},
    "perfect network": {},
    "one agent for all UAVs": {"agents.owned": [[1, 2, 3]]},
    "5.5 m/s, 8.1 m/s², late": {**LATE, "maneuver.phase.2.speed_mps": 5.5},
    "payload 43 % heavier, estimated, late": {**LATE, **ESTIMATE, "plant.payload_mass_factor": 1.43},
    "wind of 5 m/s, estimated, late": {**LATE, **ESTIMATE, "plant.wind.speed_mps": [5.0, 0.0, 0.0]},
    "agent 3 dies, late": {**LATE, **faults(kill="agent3")},
    "agent 3 of four dies, late": {**LATE, **FOUR, **faults(kill="agent3")},
    "UAV 4 of four is released, late": {**LATE, **FOUR, **faults(release="uav4")},
    "the same, then agent 2 dies": {**LATE, **FOUR, **faults(release="uav4", kill="agent2")},
}


def flown(settings: dict[str, Any], seed: int) -> tuple[float, float, float] | None:
    """Return the error's root mean square and maximum, cm, and the largest attitude, deg; None if it diverged."""
    run = transport.fly("eight", {**settings, "seed": seed}, progress=False)
    if not run.completed:
        return None
    series = series_of(run.scenario.setup, run.log)
    errors_cm = 100.0 * np.linalg.norm(series.x[:, :3] - series.payload_reference_I, axis=1)
    return float(np.sqrt(np.mean(errors_cm**2))), float(errors_cm.max()), float(series.attitude_max_deg.max())


def step_ratio(turns: int = 3) -> float:
    """Return the time of a step along the path over that of one by the control law about hover, in alternating turns.

    Both fly a slow eight; the time is the quartile of the fastest turn, which other load of the host hardly changes.
    """
    slow = {**LATE, "maneuver.phase.2.speed_mps": 1.0, "maneuver.phase.2.laps": 0.5, "maneuver.phase.2.ramp_s": 2.0}
    found: dict[str, list[float]] = {"flat": [], "hover": []}
    for _ in range(turns):
        for reference, times_ms in found.items():
            run = transport.fly("eight", {**slow, "maneuver.reference": reference}, progress=False)
            times_ms.append(float(np.nanquantile(run.series["step_ms"], 0.25)))
    return min(found["flat"]) / min(found["hover"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Simulate all cases and write a row for each; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.agile", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seeds", type=int, default=10, help="of each case (10)")
    parser.add_argument("--case", action="append", choices=list(CASES), help="print this case; may be repeated")
    parser.add_argument("--steps", action="store_true", help="print only the ratio of the times of a step")
    options = parser.parse_args(arguments)
    if options.steps:
        sys.stdout.write(f"{step_ratio():.2f}\n")
        return 0
    rows = []
    for case in options.case or CASES:
        found = [flown(CASES[case], seed) for seed in range(options.seeds)]
        completed = np.array([row for row in found if row is not None]).reshape(-1, 3)
        row = [case, f"{len(completed)} of {options.seeds}"]
        if len(completed):
            mean, most = completed.mean(axis=0), completed.max(axis=0)
            row += [f"{mean[0]:.2f}", f"{most[0]:.2f}", f"{most[1]:.1f}", f"{most[2]:.1f}"]
        rows.append(row + [""] * (6 - len(row)))
        sys.stdout.write(" | ".join(rows[-1]) + "\n")
        sys.stdout.flush()
    columns = ["Case", "Completed", "Error rms, mean, cm", "Worst rms, cm", "Largest error, cm", "Attitude, deg"]
    text = f"`eight`, {options.seeds} seeds of each case (`python -m benchmarks.agile --seeds N --case NAME`):"
    if not options.case:
        text = f"A step along the path takes {step_ratio():.2f} times as long as one by the law about hover.\n\n{text}"
        write(DOCUMENT, {SECTION: str(Table(text=text, columns=columns, rows=rows))})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
