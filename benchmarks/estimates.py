"""Honest estimates: `python -m benchmarks.estimates` compares the agents' Kalman filters with the ground truth.

The squared error of an estimate in units of its covariance (NEES) has as many degrees of freedom as the state, and that
of the measurements against their prediction (NIS) as many as there are measurements, if the covariance is right. Means
are over agents and ticks, which are correlated: the band is that of a single instant.
"""

import argparse
import math
import sys
import tomllib
from collections.abc import Sequence
from typing import Any

import numpy as np
import threadpoolctl
from scipy.stats import chi2

import transport
from agent.kalman import Belief
from agent.node import AgentNode
from benchmarks.runs import step_times
from model import state
from model.arrays import Array
from model.compiled import compile_functions
from protocol.scenario.setup import Setup
from protocol.wire.messages import STAGES, Message, Plan, PlantState
from transport.flight.memory import InMemoryRun

# The sensors of a small autopilot with satellite navigation.
SENSORS: dict[str, Any] = {
    "plant.sensors": "vehicle",
    "controller.estimator": "kalman",
    "plant.noise.position_m": 0.01,
    "plant.noise.velocity_mps": 0.02,
    "plant.noise.attitude_rad": 0.00873,
    "plant.noise.rate_rads": 0.01745,
    "plant.noise.specific_force_mps2": 0.3,
}


def compared(setup: Setup) -> dict[str, float | str]:
    """Return how a run in memory ended, its errors, and those of the estimates against their covariance."""
    truth: dict[int, Array] = {}
    beliefs: list[tuple[int, Belief]] = []

    def record(message: Message) -> None:
        if isinstance(message, PlantState):
            truth[message.tick] = message.x
        elif isinstance(message, Plan) and message.negotiation == 0:
            node = run.nodes.get(message.sender)
            belief = node.belief if isinstance(node, AgentNode) else None
            if belief is not None:
                beliefs.append((message.tick, belief))

    run = InMemoryRun(setup, record)
    with threadpoolctl.threadpool_limits(1):
        outcome = run.run().outcome
    ticks = sorted(truth)
    path, _ = setup.maneuver.path(setup.settings.sampling_period_s * np.array(ticks, dtype=np.float64))
    x = np.array([truth[tick] for tick in ticks])
    errors = [(_error(belief, truth[tick]), belief) for tick, belief in beliefs if tick in truth]
    n = len(errors[0][0])
    nees = np.array([xi @ np.linalg.solve(belief.covariance.P[:n, :n], xi) for xi, belief in errors])
    low, high = chi2.ppf([0.025, 0.975], n)
    nis, count = np.array([belief.covariance.surprise for _, belief in errors]).sum(axis=0)
    places = np.array([xi[state.R0] for xi, _ in errors])
    return {
        "outcome": outcome,
        "payload_cm": 100.0 * math.sqrt(np.mean(np.sum((x[:, state.R0] - path) ** 2, axis=1))),
        "attitude_deg": float(np.degrees(np.abs(x[:, state.THETA0]).max())),
        "estimate_cm": 100.0 * math.sqrt(np.mean(np.sum(places**2, axis=1))),
        "nees": float(nees.mean()),
        "low": float(low),
        "high": float(high),
        "within": float(np.mean((nees > low) & (nees < high))),
        "nis": float(nis / count),
    }


def _error(belief: Belief, x: Array) -> Array:
    """Return the error of an estimate in its coordinates, without actual inputs and forces."""
    n = len(x)
    found: Array = belief.covariance.L[:n].T @ (x - belief.x[:n])
    return found[: state.PAYLOAD + (n - state.PAYLOAD) // state.PER_UAV * 10]


LATE: dict[str, Any] = {"links.delay_s": 0.2, "links.loss": 0.3}
WIND: dict[str, Any] = {
    "controller.disturbance.estimate": True,
    "plant.payload_mass_factor": 1.2,
    "plant.wind.gust_mps": [1.0, 1.0, 1.0],
}
_DEATH: dict[str, Any] = {"at_s": 7.0, "do": "kill", "target": "agent3"}
_LOST: dict[str, Any] = {"clock.on_agent_loss": "continue"}
# Rows of the table: name, changes, and the most seeds.
CASES: Sequence[tuple[str, dict[str, Any], int]] = (
    ("perfect network", {}, 10),
    ("200 ms and 30 % loss", LATE, 10),
    ("the same, payload 20 % heavier, gusts of 1 m/s, forces estimated", {**LATE, **WIND}, 3),
    ("200 ms and 30 % loss, forces estimated", {**LATE, "controller.disturbance.estimate": True}, 3),
    ("the same, 30 ms of motor lag that no agent knows", {**LATE, "plant.motors.lag_s": 0.03}, 2),
    ("the same, sensors as told but 100 ms old", {**LATE, "plant.noise.delay.position_s": 0.1}, 2),
    ("agent 3 ends at 7 s", {**LATE, **_LOST, "faults.event": [_DEATH]}, 2),
    (
        "agent 3 ends at 7 s, returns at 9 s",
        {**LATE, **_LOST, "faults.event": [_DEATH, {"at_s": 9.0, "do": "restart", "target": "agent3"}]},
        2,
    ),
)


def tabulate(seeds: int) -> int:
    """Print a Markdown table of all cases; return how many runs with seeds of the first two were not consistent."""
    columns = ("payload error, cm", "largest attitude, deg", "estimate's error, cm", "NEES of 52", "within its band")
    sys.stdout.write(f"| case | seeds | {' | '.join(columns)} | payload error with measured states, cm |\n")
    sys.stdout.write("|" + "---|" * (len(columns) + 3) + "\n")
    missed = 0
    for name, changes, most in CASES:
        base = transport.Scenario("precise")
        count = min(seeds, most)
        rows = [compared(base.copy({**SENSORS, **changes, "seed": seed}).setup) for seed in range(count)]
        within = sum(_honest(row) for row in rows)
        missed += count - within if most == max(row[2] for row in CASES) else 0
        told = [f"{min(of):.2f} - {max(of):.2f}" for of in ([row[key] for row in rows] for key in _TOLD)]
        beside = {key: value for key, value in changes.items() if not key.startswith("plant.noise")}
        state_m = transport.fly("precise", beside, progress=False).summary["payload_tracking"]["rms_m"]
        ended = "" if all(row["outcome"] == "completed" for row in rows) else " (not completed)"
        cells = (name + ended, count, *told, f"{within} of {count}", f"{100.0 * state_m:.2f}")
        sys.stdout.write(f"| {' | '.join(map(str, cells))} |\n")
        sys.stdout.flush()
    return missed


def step_ratio(uavs: int, turns: int = 3) -> float:
    """Return the processor time of a step with the filter over one without it, with 200 ms of delay, in turns."""
    climb = {"maneuver.phase": [{"name": "climb", "duration_s": 6.0, "displacement_m": [1.0, 2.0, -3.0]}]}
    base = transport.Scenario("precise", {**climb, "links.delay_s": 0.2}).resized(uavs)
    total, ratios = STAGES.index("total"), []
    compile_functions(uavs)
    for _ in range(turns):
        without, beside = (np.median(step_times(base.copy(more).setup)[:, total]) for more in ({}, SENSORS))
        ratios.append(beside / without)
    return float(np.median(ratios))


_TOLD = ("payload_cm", "attitude_deg", "estimate_cm", "nees")


def _honest(row: dict[str, Any]) -> bool:
    return bool(row["low"] < row["nees"] < row["high"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a row for each seed and how many of them are within the band; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.estimates", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--scenario", default="precise")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--set", dest="changes", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--table", action="store_true", help="print a table of all cases instead")
    parser.add_argument("--steps", action="store_true", help="print the ratio of the times of a step instead")
    options = parser.parse_args(arguments)
    if options.steps:
        for uavs in (4, 8):
            sys.stdout.write(f"{uavs} UAVs: a step takes {step_ratio(uavs):.2f} times as long as without the filter\n")
        return 0
    if options.table:
        return int(tabulate(options.seeds) > 0.1 * 2 * options.seeds)
    changes = {key: tomllib.loads(f"v={value}")["v"] for key, value in (c.split("=", 1) for c in options.changes)}
    honest = 0
    for seed in range(options.seeds):
        scenario = transport.Scenario(options.scenario).copy({**SENSORS, **changes, "seed": seed})
        row = compared(scenario.setup)
        honest += _honest(row)
        text = "payload {payload_cm:.2f} cm, {attitude_deg:.2f} deg; estimate {estimate_cm:.2f} cm; "
        text += "NEES {nees:.1f} in [{low:.1f}, {high:.1f}], {within:.0%} of instants; NIS {nis:.3f}\n"
        sys.stdout.write(f"seed {seed} {row['outcome']}: " + text.format(**row))
        sys.stdout.flush()
    sys.stdout.write(f"{honest} of {options.seeds} seeds have their mean NEES within the band of an instant\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
