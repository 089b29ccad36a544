"""Estimate of external forces.

It converges at the rate of its filter, under any delay of plans.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support.runs import measurement, plan, setup
from transport.agent.communication.announced_inputs import AnnouncedInputs
from transport.agent.estimation.disturbance import DisturbanceEstimator, MeasuredTeam
from transport.agent.estimation.predicted_motion import PredictedMotion
from transport.agent.estimation.state_estimator import StateEstimator
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Measurement, Plan

TICKS = 60
PERIOD_S, TIME_CONSTANT_S = 0.05, 0.4

# N. The truth takes ten integration steps per period, the estimator two: 1e-7 m/s apart, and 180 N
# to the m/s.
NO_FORCE = 2e-5
# Share of the force. The gain is that of hover; on this flight UAVs and rods lean by up to 20
# degrees.
GAIN_ERROR = 0.05

# N: a payload 15 % too heavy in a wind that pushes the UAVs, too. Nothing pushes them up or down.
HEAVY_IN_WIND = np.array([1.5, -0.7, 4.4, *[0.4, 0.2, 0.0] * 4])
NOTHING = np.zeros(15)


@dataclass(frozen=True, slots=True)
class Flight:
    """Ground truth: states at ticks 0..TICKS, and the inputs between them."""

    run: Setup
    X: Array
    U: Array

    def plan(self, agent: int, k: int, steps: int = 1) -> Plan:
        """Return an agent's plan of tick k.

        Its true state, and its true inputs for that many steps.
        """
        own = state.input_indices(self.run.owned[agent - 1])
        return plan(self.run, agent, k, x=self.X[k], inputs=self.U[k : k + steps][:, own])

    def measurement(self, k: int) -> Measurement:
        """Return agent 1's measurement at tick k, with the inputs of its actuators until then."""
        seen = measurement(self.run, 1, k, x=self.X[k])
        return (
            seen
            if k == 0
            else replace(seen, inputs=self.U[k - 1].reshape(4, 4)[list(self.run.owned[0])])
        )


@lru_cache
def flight(forces: tuple[float, ...], *settings: str, size: float = 1.0) -> Flight:
    """Simulate random inputs of some size about hover, under constant forces."""
    run = setup(*settings)
    rng = np.random.default_rng(21)
    U = run.hover.u + size * np.tile([1.0, 0.02, 0.02, 0.02], 4) * rng.uniform(
        -1.0, 1.0, (TICKS, run.system.m)
    )
    X = [run.initial_state()]
    for u in U:
        X.append(run.model.integrate(X[-1], u, PERIOD_S, 10, forces=np.array(forces))[0])
    return Flight(run, np.array(X), U)


def disturbance_of(run: Setup) -> DisturbanceEstimator:
    """Return agent 1's estimator of forces."""
    team = MeasuredTeam(model=run.model, hover=run.hover, owned=run.owned[0])
    return DisturbanceEstimator(team, PERIOD_S, TIME_CONSTANT_S)


def estimator_of(run: Setup, disturbance: DisturbanceEstimator) -> StateEstimator:
    """Return agent 1's estimator of states, from the start of the run on."""
    motion = PredictedMotion(
        model=run.model, reference=lambda _: run.initial_state(), period_s=PERIOD_S
    )
    return StateEstimator(motion, run.owned[0], disturbance)


def estimates(
    flown: Flight,
    plans_at: Callable[[int], int] = lambda k: k + 1,
    steps: int = 1,
) -> Array:
    """Return agent 1's estimates of the forces at every tick, (TICKS + 1, 15).

    Args:
        flown: What happens.
        plans_at: When others' plans of a tick arrive.
        steps: How far plans reach.
    """
    run = flown.run
    disturbance = disturbance_of(run)
    estimator = estimator_of(run, disturbance)
    announced = AnnouncedInputs(run.owned, run.hover.u)
    forces_N = []
    for k in range(TICKS + 1):
        for agent in run.agents[1:]:
            for made in range(k):
                if plans_at(made) == k:
                    announced.add(flown.plan(agent, made, steps))
                    estimator.take(flown.plan(agent, made, steps))
        estimator.measure(flown.measurement(k))
        estimator.estimate(k, announced)
        forces_N.append(disturbance.forces)
        if k < TICKS:
            announced.add(flown.plan(1, k))
    return np.array(forces_N)


@pytest.mark.parametrize("owned", ["agents.owned=[[1],[2],[3],[4]]", "agents.owned=[[1,2],[3,4]]"])
def test_forces_are_found_at_the_filters_pace(owned: str) -> None:
    """The error decays as exp(-t / time constant), docs/equations.md (41)."""
    forces_N = estimates(flight(tuple(HEAVY_IN_WIND), owned))
    times_s = PERIOD_S * np.arange(TICKS + 1)
    expected = (1.0 - np.exp(-times_s / TIME_CONSTANT_S))[:, None] * HEAVY_IN_WIND
    assert np.abs(forces_N - expected).max() < GAIN_ERROR * np.abs(HEAVY_IN_WIND).max()


@pytest.mark.parametrize("delay", [1, 4])
def test_what_happens_as_predicted_is_no_force(delay: int) -> None:
    """The estimate converges for any delay of the others' plans.

    Errors before the first plan are forgotten.
    """
    forces_N = estimates(flight(tuple(NOTHING)), lambda k: k + delay, steps=delay)
    forgotten = np.exp(-PERIOD_S / TIME_CONSTANT_S) * forces_N[:-1]
    learned = np.abs(forces_N[1:] - forgotten).max(axis=1)
    assert learned[delay:].max() < NO_FORCE
    if delay == 1:
        assert np.abs(forces_N).max() < NO_FORCE


def test_what_pushes_uavs_up_or_down_is_the_payloads() -> None:
    """Vertical forces on UAVs pass through the rods.

    The estimate has the sum of all, as a force on the payload.
    """
    forces = np.array([0.0, 0.0, 2.0, *[0.0, 0.0, 0.5] * 4])
    last = estimates(flight(tuple(forces), size=0.0))[-1]
    assert last[2] == pytest.approx(4.0, rel=GAIN_ERROR)
    assert np.abs(np.delete(last, 2)).max() < GAIN_ERROR * 4.0


@pytest.mark.parametrize("wrong", [1e3, 1e150, np.nan])
def test_wrong_predictions_are_no_forces(wrong: float) -> None:
    """An implausible prediction error changes no bit of the estimate; a plausible one does."""
    run = setup()
    disturbance = disturbance_of(run)
    predicted = run.initial_state()
    predicted[state.V0] = 0.01
    disturbance.learn(predicted, run.initial_state())
    forces_N = disturbance.forces
    assert forces_N.any()
    predicted[state.V0] = wrong
    disturbance.learn(predicted, run.initial_state())
    np.testing.assert_array_equal(disturbance.forces, forces_N)


def test_actuators_are_believed() -> None:
    """Reported inputs that differ from announced ones do not count as a force."""
    flown = flight(tuple(NOTHING))
    run = flown.run
    forces_N = []
    for reported in (flown.U, np.tile(run.hover.u, (TICKS, 1))):
        disturbance = disturbance_of(run)
        estimator = estimator_of(run, disturbance)
        announced = AnnouncedInputs(run.owned, run.hover.u)
        for agent in (2, 3, 4):
            announced.add(flown.plan(agent, 0))
        estimator.measure(flown.measurement(0))
        estimator.estimate(0, announced)
        estimator.measure(replace(flown.measurement(1), inputs=reported[0].reshape(4, 4)[:1]))
        estimator.estimate(1, announced)
        forces_N.append(np.abs(disturbance.forces).max())
    assert forces_N[0] < NO_FORCE
    assert forces_N[1] > 1e3 * NO_FORCE
