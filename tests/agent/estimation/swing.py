"""A team in an unknown swing, its measurements and messages, and agent 1's filter of them."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from msgspec import structs

from tests.support.runs import VEHICLE, measurement, plan, setup
from transport.agent.communication.announced_inputs import AnnouncedInputs
from transport.agent.estimation.estimator import sensor_estimator
from transport.agent.estimation.filter.belief import Belief
from transport.agent.estimation.filter.filter_interface import Sensed
from transport.agent.estimation.filter.gain_reuse import MOST_TICKS
from transport.agent.estimation.filter.team_filter import TeamFilter
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Measurement, Plan

PERIOD_S = 0.05
TICKS = 24
ALL_SENSORS = (0, 1, 2, 3, 4)
# Inputs of agent 1 about hover, N and N m; the others' stay those of hover.
OWN_NOISE = np.array([0.5, 0.02, 0.02, 0.02] + [0.0] * 12)


@lru_cache  # a flight by seed and doubt
def moving(seed: int, doubt: float = 1.0) -> tuple[Setup, list[Array], list[Array], list[Array]]:
    """Return a run, true states, inputs until then and measurements.

    The first state is drawn by (a share of) the filter's doubt.
    """
    run = setup(*VEHICLE)
    rng = np.random.default_rng(seed)
    team = TeamFilter(run.run)
    first = team.first(run.X_ref[0])
    T = team.manifold.basis(first.x).T
    deviations = np.sqrt(np.diag(first.covariance.P))[: T.shape[1]]
    xi = doubt * deviations * rng.standard_normal(T.shape[1])

    X = [team.manifold.moved(first.x, T @ xi)]
    U = [run.hover.u]
    Z: list[Array] = []
    for _ in range(TICKS):
        sense = run.model.sense(X[-1], U[-1])[0].reshape(-1, state.SENSED)
        noise = np.repeat(run.sensors.noise, 3) * rng.standard_normal(sense.shape)
        Z.append(sense + noise)
        U.append(run.hover.u + OWN_NOISE * rng.standard_normal(run.system.m))
        X.append(run.model.integrate(X[-1], U[-1], PERIOD_S, 5)[0])
    return run, X, U, Z


def sensed(z: Array) -> list[Sensed]:
    """Return the measurements of all UAVs, (N, 15)."""
    return [Sensed(uav=uav, sensors=ALL_SENSORS, values=values) for uav, values in enumerate(z)]


def measured(run: Setup, k: int, u: Array, z: Array) -> Measurement:
    """Return agent 1's measurement of a tick, with the inputs until then."""
    return structs.replace(
        measurement(run, 1, k),
        payload=np.zeros(0),
        uav_states=z[:1],
        inputs=u.reshape(-1, state.INPUTS)[:1],
    )


def reported(run: Setup, agent: int, k: int, U: list[Array], Z: list[Array]) -> Plan:
    """Return another agent's plan of a tick, with its reports of the last ticks and true inputs."""
    rows = np.zeros((state.REPORTS, state.REPORTED))
    for age in range(min(k + 1, state.REPORTS)):
        inputs = U[k - age][state.input_slice(agent - 1)]
        rows[age] = np.concatenate([[1.0], Z[k - age][agent - 1], inputs])
    inputs = np.tile(U[k + 1][state.input_slice(agent - 1)], (run.settings.horizon, 1))
    return structs.replace(
        plan(run, agent, k, inputs=inputs), uav_states=rows.reshape(1, -1), corrections=0.0 * inputs
    )


def in_time(seed: int, late: int, doubt: float = 1.0) -> dict[int, list[Plan]]:
    """Return the others' plans of all ticks by tick of arrival."""
    run, _, U, Z = moving(seed, doubt)
    return {
        k + late: [reported(run, agent, k, U, Z) for agent in (2, 3, 4)]
        for k in range(TICKS - late)
    }


def no_feedback(run: Setup) -> Callable[[int], Array]:
    """Return the gain of others that do not answer to their estimates."""
    return lambda _tick: np.zeros((run.system.m, run.system.n))


def filtered(
    arrivals: dict[int, list[Plan]],
    seed: int,
    until: int,
    doubt: float = 1.0,
    most_ticks: int = MOST_TICKS,
) -> list[Belief]:
    """Return agent 1's beliefs at all ticks as they were then.

    The plans of a tick arrive before its estimate; a gain is used again for `most_ticks`.
    """
    run, _, U, Z = moving(seed, doubt)
    estimator = sensor_estimator(
        run.run, 1, lambda k: run.X_ref[k].copy(), no_feedback(run), most_ticks
    )
    announced = AnnouncedInputs(run.owned, run.hover.u, own=1)
    beliefs = []
    for k in range(until + 1):
        for one in arrivals.get(k, []):
            announced.add(one)
            estimator.take(one)
        estimator.measure(measured(run, k, U[k], Z[k]))
        estimator.estimate(k, announced)
        assert estimator.belief is not None
        beliefs.append(estimator.belief)
    return beliefs


def error(run: Setup, belief: Belief, x: Array) -> Array:
    """Return the error of a belief in its coordinates."""
    basis = TeamFilter(run.run).manifold.basis(belief.x)
    xi: Array = basis.L.T @ (x - belief.x)
    return xi
