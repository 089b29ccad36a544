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
from model import state
from model.arrays import Array
from protocol.scenario.setup import Setup
from protocol.wire.messages import Message, Plan, PlantState
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a row for each seed and how many of them are within the band; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.estimates", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--scenario", default="precise")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--set", dest="changes", action="append", default=[], metavar="KEY=VALUE")
    options = parser.parse_args(arguments)
    changes = {key: tomllib.loads(f"v={value}")["v"] for key, value in (c.split("=", 1) for c in options.changes)}
    honest = 0
    for seed in range(options.seeds):
        scenario = transport.Scenario(options.scenario).copy({**SENSORS, **changes, "seed": seed})
        row = compared(scenario.setup)
        honest += row["low"] < row["nees"] < row["high"]  # type: ignore[operator]
        text = "payload {payload_cm:.2f} cm, {attitude_deg:.2f} deg; estimate {estimate_cm:.2f} cm; "
        text += "NEES {nees:.1f} in [{low:.1f}, {high:.1f}], {within:.0%} of instants; NIS {nis:.3f}\n"
        sys.stdout.write(f"seed {seed} {row['outcome']}: " + text.format(**row))
        sys.stdout.flush()
    sys.stdout.write(f"{honest} of {options.seeds} seeds have their mean NEES within the band of an instant\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
