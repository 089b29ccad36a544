"""Honest estimates: `python -m benchmarks.estimates` compares the agents' Kalman filters with the ground truth.

The squared error of an estimate in units of its covariance (NEES) has as many degrees of freedom as the state if the
covariance is right. Means are over agents and ticks, which are correlated: the band is that of a single instant.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import threadpoolctl
from scipy.stats import chi2

import transport
from agent.kalman import Belief
from agent.node import AgentNode
from benchmarks.campaign import changes, options, say
from benchmarks.runs import step_times
from docs.tables import bar
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


def compared(setup: Setup) -> dict[str, float]:
    """Return whether a run in memory completed, its errors, and those of the estimates against their covariance."""
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
        completed = run.run().outcome == "completed"
    ticks = sorted(truth)
    path, _ = setup.maneuver.path(setup.settings.sampling_period_s * np.array(ticks, dtype=np.float64))
    x = np.array([truth[tick] for tick in ticks])
    errors = [(_error(belief, truth[tick]), belief) for tick, belief in beliefs if tick in truth]
    n = len(errors[0][0])
    nees = np.array([xi @ np.linalg.solve(belief.covariance.P[:n, :n], xi) for xi, belief in errors])
    low, high = chi2.ppf([0.025, 0.975], n)
    places = np.array([xi[state.R0] for xi, _ in errors])
    return {
        "completed": completed,
        "payload_cm": 100.0 * math.sqrt(np.mean(np.sum((x[:, state.R0] - path) ** 2, axis=1))),
        "attitude_deg": float(np.degrees(np.abs(x[:, state.THETA0]).max())),
        "estimate_cm": 100.0 * math.sqrt(np.mean(np.sum(places**2, axis=1))),
        "nees": float(nees.mean()),
        "low": float(low),
        "high": float(high),
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


COLUMNS = (
    "case",
    "seeds",
    "payload error, cm",
    "largest attitude, deg",
    "estimate's error, cm",
    "NEES of 52",
    "within its band",
    "payload error with measured states, cm",
)
_TOLD = ("payload_cm", "attitude_deg", "estimate_cm", "nees")


def cells(name: str, base: transport.Scenario, changes: dict[str, Any], seeds: int) -> list[str]:
    """Simulate a case and return its row."""
    rows = [compared(base.copy({**SENSORS, **changes, "seed": seed}).setup) for seed in range(seeds)]
    within = sum(row["low"] < row["nees"] < row["high"] for row in rows)
    told = [f"{min(of):.2f} - {max(of):.2f}" for of in ([row[key] for row in rows] for key in _TOLD)]
    beside = {key: value for key, value in changes.items() if not key.startswith("plant.noise")}
    state_m = transport.fly(base.copy(beside), progress=False).summary["payload_tracking"]["rms_m"]
    ended = "" if all(row["completed"] for row in rows) else " (not completed)"
    return [name + ended, str(seeds), *told, f"{within} of {seeds}", f"{100.0 * state_m:.2f}"]


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


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row for the scenario with the settings given, or for all cases."""
    parser = options("estimates", __doc__, changes=True)
    parser.add_argument("--scenario", default="precise")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--table", action="store_true", help="print a table of all cases instead")
    parser.add_argument("--steps", action="store_true", help="print the ratio of the times of a step instead")
    given = parser.parse_args(arguments)
    if given.steps:
        for uavs in (4, 8):
            say(f"{uavs} UAVs: a step takes {step_ratio(uavs):.2f} times as long as without the filter")
        return
    base, cases = transport.Scenario(given.scenario), CASES
    if not given.table:
        cases = [(", ".join([given.scenario, *given.changes]), changes(given.changes), given.seeds)]
    say(bar(COLUMNS) + "\n|" + "---|" * len(COLUMNS))
    for name, settings, most in cases:
        say(bar(cells(name, base, settings, min(given.seeds, most))))


if __name__ == "__main__":
    main()
