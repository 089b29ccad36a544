"""Honest estimates: `python -m benchmarks.estimates` compares the agents' Kalman filters with the ground truth.

It renews the table of docs/vehicles.md in a quarter of an hour. The squared error of an estimate in
units of its covariance (NEES) has as many degrees of freedom as the state if the covariance is
right. Means are over agents and
ticks, which are correlated: the band is that of a single instant.
"""

import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

import transport
from benchmarks.runs import origin, quiet, step_times
from docs.tables import ROOT, place, put, table
from transport.agent.kalman import Belief
from transport.agent.node import AgentNode
from transport.flight.memory import InMemoryRun
from transport.model import state
from transport.model.arrays import Array
from transport.model.compiled import compile_functions
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.messages import STAGES, Message, Plan, PlantState

# The sensors of a small autopilot with satellite navigation.
SENSORS: Mapping[str, Any] = {
    "plant.sensors": "vehicle",
    "controller.estimator": "kalman",
    "plant.noise.position_m": 0.01,
    "plant.noise.velocity_mps": 0.02,
    "plant.noise.attitude_rad": 0.00873,
    "plant.noise.rate_rads": 0.01745,
    "plant.noise.specific_force_mps2": 0.3,
}
LATE: Mapping[str, Any] = {"links.delay_s": 0.2, "links.loss": 0.3}
FORCES: Mapping[str, Any] = {**LATE, "controller.disturbance.estimate": True}
WIND: Mapping[str, Any] = {
    **FORCES,
    "plant.payload_mass_factor": 1.2,
    "plant.wind.gust_mps": [1.0, 1.0, 1.0],
}
LOST: Mapping[str, Any] = {**LATE, "clock.on_agent_loss": "continue"}
DEATH: Mapping[str, Any] = {"at_s": 7.0, "do": "kill", "target": "agent3"}
RETURN: Mapping[str, Any] = {"at_s": 9.0, "do": "restart", "target": "agent3"}
# Changes and seeds of each row.
CASES: Mapping[str, tuple[Mapping[str, Any], int]] = {
    "perfect network": ({}, 10),
    "200 ms and 30 % loss": (LATE, 10),
    "the same, payload 20 % heavier, gusts of 1 m/s, forces estimated": (WIND, 3),
    "200 ms and 30 % loss, forces estimated": (FORCES, 3),
    "the same, 30 ms of motor lag that no agent knows": ({**LATE, "plant.motors.lag_s": 0.03}, 2),
    "the same, sensors as told but 100 ms old": ({**LATE, "plant.noise.delay.position_s": 0.1}, 2),
    "agent 3 ends at 7 s": ({**LOST, "faults.event": [DEATH]}, 2),
    "agent 3 ends at 7 s, returns at 9 s": ({**LOST, "faults.event": [DEATH, RETURN]}, 2),
}
MARKER = "bench: estimates"
COLUMNS = (
    "`precise`",
    "completed",
    "payload error, cm",
    "largest attitude, deg",
    "estimate's error, cm",
    "NEES of 52",
    "within its band",
    "payload error with measured states, cm",
)


def compared(setup: Setup) -> tuple[bool, tuple[float, float, float, float], bool]:
    """Return whether a run completed, its four numbers in the order of the columns, whether NEES is in its band.

    Errors are root mean squares over ticks, and over agents for the estimate; the attitude is the
    largest.
    """
    truth: dict[int, Array] = {}
    beliefs: list[tuple[int, Belief]] = []

    def record(message: Message) -> None:
        if isinstance(message, PlantState):
            truth[message.tick] = message.x
        elif isinstance(message, Plan) and message.negotiation == 0:
            node = run.nodes.get(message.sender)
            if isinstance(node, AgentNode) and node.belief is not None:
                beliefs.append((message.tick, node.belief))

    run = InMemoryRun(setup, record)
    with quiet():
        completed = run.run().outcome == "completed"
    ticks = sorted(truth)
    path, _ = setup.maneuver.path(
        setup.settings.sampling_period_s * np.array(ticks, dtype=np.float64)
    )
    x = np.array([truth[tick] for tick in ticks])
    errors = [(_error(belief, truth[tick]), belief) for tick, belief in beliefs if tick in truth]
    n = len(errors[0][0])
    nees = float(
        np.mean([xi @ np.linalg.solve(belief.covariance.P[:n, :n], xi) for xi, belief in errors])
    )
    low, high = chi2.ppf([0.025, 0.975], n)
    numbers = (
        100.0 * math.sqrt(np.mean(np.sum((x[:, state.R0] - path) ** 2, axis=1))),
        float(np.degrees(np.abs(x[:, state.THETA0]).max())),
        100.0 * math.sqrt(np.mean([np.sum(xi[state.R0] ** 2) for xi, _ in errors])),
        nees,
    )
    return completed, numbers, bool(low < nees < high)


def _error(belief: Belief, x: Array) -> Array:
    """Return the error of an estimate in its coordinates, without actual inputs and forces."""
    n = len(x)
    found: Array = belief.covariance.L[:n].T @ (x - belief.x[:n])
    return found[: state.PAYLOAD + (n - state.PAYLOAD) // state.PER_UAV * 10]


def row(name: str, changes: Mapping[str, Any], seeds: int) -> list[str]:
    """Simulate a case with and without the filter and return its row."""
    base = transport.Scenario("precise")
    runs = [
        compared(base.copy({**SENSORS, **changes, "seed": seed}).setup) for seed in range(seeds)
    ]
    ranges = [
        f"{min(of):.2f} - {max(of):.2f}"
        for of in zip(*(numbers for _, numbers, _ in runs), strict=True)
    ]
    counts = [
        f"{sum(of)} of {seeds}" for of in ([run[0] for run in runs], [run[2] for run in runs])
    ]
    beside = {key: value for key, value in changes.items() if not key.startswith("plant.noise")}
    measured = transport.fly(base.copy(beside), progress=False).summary["payload_tracking"]["rms_m"]
    return [name, counts[0], *ranges, counts[1], f"{100.0 * measured:.2f}"]


def step_ratio(uavs: int, turns: int = 3) -> float:
    """Return the processor time of a step with the filter over one without it, with 200 ms of delay, in turns."""
    climb = {
        "maneuver.phase": [{"name": "climb", "duration_s": 6.0, "displacement_m": [1.0, 2.0, -3.0]}]
    }
    base = transport.Scenario("precise", {**climb, "links.delay_s": 0.2}).resized(uavs)
    total, ratios = STAGES.index("total"), []
    compile_functions(uavs)
    for _ in range(turns):
        without, beside = (
            np.median(step_times(base.copy(more).setup)[:, total]) for more in ({}, SENSORS)
        )
        ratios.append(beside / without)
    return float(np.median(ratios))


def main(document: Path = ROOT / "docs" / "vehicles.md") -> None:
    """Measure all rows and the time of a step, and renew the table of a document."""
    place(document, MARKER)  # refused before minutes are spent
    steps = " and ".join(f"{step_ratio(uavs):.2f} (N = {uavs})" for uavs in (4, 8))
    rows = []
    for name, (changes, seeds) in CASES.items():
        rows.append(row(name, changes, seeds))
        sys.stderr.write(" | ".join(rows[-1]) + "\n")
    text = f"With 200 ms of delay a step takes {steps} times as long as without the filter."
    put(document, MARKER, f"{table(COLUMNS, rows)}\n\n{text}\n\n*{origin()}.*")


if __name__ == "__main__":
    main()
