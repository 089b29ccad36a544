"""Consistency of the estimates: the agents' Kalman filters against the ground truth.

`python -m benchmarks.estimates` renews the table of docs/record/measured.md in a quarter of an hour. The
squared error of an estimate in units of its covariance (NEES) has as many degrees of freedom as the
state if the covariance is right. Means are over agents and ticks, which are correlated: the band is
that of a single instant.
"""

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

import transport
from benchmarks.runs import origin, quiet, step_times
from docs.tables import ROOT, place, put, table
from transport.agent.estimation.filter.belief import Belief
from transport.agent.estimation.filter.manifold import PER_UAV
from transport.agent.node import AgentNode
from transport.flight.memory import InMemoryRun
from transport.model import state
from transport.model.arrays import Array
from transport.model.kernels.casadi_functions import compile_functions
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.drawn_team import NOISE
from transport.protocol.wire.messages import STAGES, Message, Plan, PlantState

# The sensors of a small autopilot, with the filter that needs no others.
SENSORS: Mapping[str, Any] = {
    "plant.sensors": "vehicle",
    "controller.estimator": "kalman",
    **{f"plant.noise.{name}": value for name, value in NOISE.items()},
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
    "200 ms and 30 % loss, payload 20 % heavier, gusts of 1 m/s, forces estimated": (WIND, 3),
    "200 ms and 30 % loss, forces estimated": (FORCES, 3),
    "200 ms and 30 % loss, 30 ms of motor lag that no agent knows": (
        {**LATE, "plant.motors.lag_s": 0.03},
        2,
    ),
    "200 ms and 30 % loss, sensors as told but 100 ms old": (
        {**LATE, "plant.noise.delay.position_s": 0.1},
        2,
    ),
    "200 ms and 30 % loss, agent 3 ends at 7 s": ({**LOST, "faults.event": [DEATH]}, 2),
    "200 ms and 30 % loss, agent 3 ends at 7 s, returns at 9 s": (
        {**LOST, "faults.event": [DEATH, RETURN]},
        2,
    ),
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Estimates of a run against the ground truth.

    Errors are root mean squares over ticks, and over agents for the estimate.
    """

    is_completed: bool
    payload_error_cm: float  # of the flight, from its path
    largest_attitude_deg: float
    estimate_error_cm: float
    nees: float
    is_in_band: bool  # whether the NEES is in the band of a single instant

    @property
    def numbers(self) -> tuple[float, float, float, float]:
        """The numbers in the order of the columns."""
        return (
            self.payload_error_cm,
            self.largest_attitude_deg,
            self.estimate_error_cm,
            self.nees,
        )


def simulated(setup: Setup) -> tuple[bool, dict[int, Array], list[tuple[int, Belief]]]:
    """Return whether a run completed, its plant states by tick, and beliefs with ticks."""
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
        is_completed = run.run().outcome == "completed"
    return is_completed, truth, beliefs


def compared(setup: Setup) -> Comparison:
    """Return the estimates of a run against its ground truth."""
    is_completed, truth, beliefs = simulated(setup)
    ticks = sorted(truth)
    x = np.array([truth[tick] for tick in ticks])
    times_s = setup.settings.sampling_period_s * np.array(ticks, dtype=np.float64)
    path, _ = setup.maneuver.path(times_s)
    from_path = np.sum((x[:, state.R0] - path) ** 2, axis=1)

    errors = [(_error(belief, truth[tick]), belief) for tick, belief in beliefs if tick in truth]
    of_position = [np.sum(xi[state.R0] ** 2) for xi, _ in errors]
    nees = float(np.mean([_squared_error(xi, belief) for xi, belief in errors]))
    low, high = chi2.ppf([0.025, 0.975], len(errors[0][0]))
    return Comparison(
        is_completed=is_completed,
        payload_error_cm=100.0 * math.sqrt(np.mean(from_path)),
        largest_attitude_deg=float(np.degrees(np.abs(x[:, state.THETA0]).max())),
        estimate_error_cm=100.0 * math.sqrt(np.mean(of_position)),
        nees=nees,
        is_in_band=bool(low < nees < high),
    )


def _error(belief: Belief, x: Array) -> Array:
    """Return the error of an estimate in its coordinates, without actual inputs and forces."""
    n = len(x)
    N = (n - state.PAYLOAD) // state.PER_UAV
    xi: Array = belief.covariance.basis.L[:n].T @ (x - belief.x[:n])
    return xi[: state.PAYLOAD + PER_UAV * N]


def _squared_error(xi: Array, belief: Belief) -> float:
    """Return the squared error of an estimate in units of its covariance."""
    P = belief.covariance.P[: len(xi), : len(xi)]
    return float(xi @ np.linalg.solve(P, xi))


def row(name: str, changes: Mapping[str, Any], seeds: int) -> list[str]:
    """Simulate a case with and without the filter and return its row."""
    base = transport.Scenario("precise")
    runs = [
        compared(base.copy({**SENSORS, **changes, "seed": seed}).setup) for seed in range(seeds)
    ]
    columns = zip(*(run.numbers for run in runs), strict=True)
    ranges = [f"{min(column):.2f} - {max(column):.2f}" for column in columns]
    completed = f"{sum(run.is_completed for run in runs)} of {seeds}"
    in_band = f"{sum(run.is_in_band for run in runs)} of {seeds}"

    with_states = {k: value for k, value in changes.items() if not k.startswith("plant.noise")}
    summary = transport.fly(base.copy(with_states), progress=False).summary
    measured_cm = 100.0 * summary["payload_tracking"]["rms_m"]
    return [name, completed, *ranges, in_band, f"{measured_cm:.2f}"]


def step_ratio(uavs: int, turns: int = 3) -> float:
    """Return the processor time of a step with the filter over one without, with 200 ms of delay.

    Both are measured in turns.
    """
    phase = {"name": "climb", "duration_s": 6.0, "displacement_m": [1.0, 2.0, -3.0]}
    changes = {"maneuver.phase": [phase], "links.delay_s": 0.2}
    base = transport.Scenario("precise", changes).resized(uavs)
    compile_functions(uavs)

    ratios = []
    for _ in range(turns):
        without_ms = _step_ms(base.copy({}).setup)
        with_ms = _step_ms(base.copy(SENSORS).setup)
        ratios.append(with_ms / without_ms)
    return float(np.median(ratios))


def _step_ms(setup: Setup) -> float:
    """Return the median time of a step of a run."""
    total = STAGES.index("total")
    return float(np.median(step_times(setup)[:, total]))


def main(document: Path = ROOT / "docs" / "record" / "measured.md") -> None:
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
