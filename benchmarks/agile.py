"""Agile flight: `python -m benchmarks.agile` flies the scenario `eight` with many seeds and writes docs/results.md.

The error is the distance of the payload from its path. Seeds draw noise, delays and losses.
"""

import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import transport
from benchmarks.campaign import say, tabulate

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
COLUMNS = ("Case", "Completed", "Error rms, mean, cm", "Worst rms, cm", "Largest error, cm", "Attitude, deg")


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


def cells(flown: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return mean and largest root mean square of the error, its maximum and that of the attitude."""
    rms_cm, most_cm, attitude_deg = (
        factor * np.array([run[name] for run in flown])
        for name, factor in (("payload_rms_m", 100.0), ("payload_max_m", 100.0), ("attitude_max_deg", 1.0))
    )
    return [f"{rms_cm.mean():.2f}", f"{rms_cm.max():.2f}", f"{most_cm.max():.1f}", f"{attitude_deg.max():.1f}"]


def text() -> str:
    """Return the text above the table."""
    command = "`eight`, 10 seeds of each case (`python -m benchmarks.agile --seeds N --case NAME`):"
    return f"A step along the path takes {step_ratio():.2f} times as long as one by the law about hover.\n\n{command}"


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


if __name__ == "__main__":
    if "--steps" in sys.argv:
        say(f"{step_ratio():.2f}")
        sys.exit()
    tabulate(
        "agile", __doc__, "eight", {case: (settings, 10) for case, settings in CASES.items()}, COLUMNS, cells, text
    )
