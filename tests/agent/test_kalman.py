"""Kalman filter over the team.

A dense filter with numerical Jacobians, any order of arrival, honest covariance.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from msgspec import structs

from tests.support.runs import VEHICLE, measurement, plan, setup
from transport.agent.announced import AnnouncedInputs
from transport.agent.estimator import STEPS, StateEstimator
from transport.agent.kalman import TOLD, UNKNOWN_LAG_S, Belief, KalmanFilter, told, understood
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.messages import Measurement, Plan

PERIOD_S, TICKS, DELAY = 0.05, 24, 4
# The filter's covariance takes the linearisation at the beginning of a period, the oracle the
# derivative of the whole period: relative to the largest standard deviations they differ by a few
# percent, with rods in motion.
SAME_DEVIATION = 0.05
SAME_MEAN = 0.2  # through the gains, in standard deviations
SMALL = 0.1  # share of the first doubt: corrections small enough to be linear
HALF = 0.5  # share of it at which the first corrections are linear enough for an honest covariance
EXACT = 1e-3  # level below which a model counts as exact
FOUND_M = 0.02  # standard deviation of the payload's position after half a second
# 99.8 % band of the mean over 48 of a squared error with 52 degrees of freedom, over 52, as if
# ticks were independent; they are correlated over a second, so this is the band of about ten of
# them.
HONEST = (0.75, 1.3)


@lru_cache
def moving(seed: int, doubt: float = 1.0) -> tuple[Setup, list[Array], list[Array], list[Array]]:
    """Return a run, true states from one drawn by (a share of) the filter's doubt, inputs until then, measurements."""
    run, rng = setup(*VEHICLE), np.random.default_rng(seed)
    kalman = KalmanFilter(run, lambda _: np.zeros((run.system.m, run.system.n)))
    first = kalman.first(run.X_ref[0])
    T, _ = kalman.basis(first.x)
    xi = (
        doubt * np.sqrt(np.diag(first.covariance.P))[: T.shape[1]] * rng.standard_normal(T.shape[1])
    )
    X, U, Z = [kalman.moved(first.x, T @ xi)], [run.hover.u], []
    own = np.array(
        [0.5, 0.02, 0.02, 0.02] + [0.0] * 12
    )  # of agent 1; the others' stay those of hover
    for _ in range(TICKS):
        sense = run.model.sense(X[-1], U[-1])[0].reshape(-1, state.SENSED)
        noise = np.repeat(run.sensors.noise, 3) * rng.standard_normal(sense.shape)
        Z.append(sense + noise)
        U.append(run.hover.u + own * rng.standard_normal(run.system.m))
        X.append(run.model.integrate(X[-1], U[-1], PERIOD_S, 5)[0])
    return run, X, U, Z


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


def estimators(run: Setup) -> tuple[StateEstimator, AnnouncedInputs, KalmanFilter]:
    """Return a new estimator of agent 1 with its filter."""
    kalman = KalmanFilter(run, lambda _: np.zeros((run.system.m, run.system.n)), [0])
    estimator = StateEstimator(run.model, lambda k: run.X_ref[k].copy(), PERIOD_S, kalman=kalman)
    return estimator, AnnouncedInputs(run.owned, run.hover.u, own=1), kalman


def filtered(
    arrivals: dict[int, list[Plan]], seed: int, until: int, doubt: float = 1.0
) -> tuple[list[Belief], KalmanFilter]:
    """Return the beliefs at all ticks as they were then, with the plans that arrive before each tick's estimate."""
    run, _, U, Z = moving(seed, doubt)
    estimator, announced, kalman = estimators(run)
    beliefs = []
    for k in range(until + 1):
        for one in arrivals.get(k, []):
            announced.add(one)
            estimator.take(one)
        estimator.measure(measured(run, k, U[k], Z[k]))
        estimator.estimate(k, announced)
        assert estimator.belief is not None
        beliefs.append(estimator.belief)
    return beliefs, kalman


def in_time(seed: int, late: int, doubt: float = 1.0) -> dict[int, list[Plan]]:
    """Return the others' plans of all ticks by tick of arrival."""
    run, _, U, Z = moving(seed, doubt)
    return {
        k + late: [reported(run, agent, k, U, Z) for agent in (2, 3, 4)]
        for k in range(TICKS - late)
    }


@pytest.mark.parametrize("forces", ["false", "true"])
def test_against_a_dense_filter_with_numerical_jacobians(forces: str) -> None:
    """Means and covariances are those of the textbook filter with differences of the nonlinear model as Jacobians."""
    _, _, U, Z = moving(1, SMALL)
    run = setup(*VEHICLE, f"controller.disturbance.estimate={forces}")
    model, kalman = run.model, KalmanFilter(run, lambda _: np.zeros((16, 60)))
    belief = kalman.first(run.X_ref[0])
    first = belief.covariance
    belief = replace(belief, found=replace(first, P=SMALL**2 * first.P))
    n, r, P = len(belief.x), first.T.shape[1], belief.covariance.P
    z = np.concatenate([belief.x, belief.forces])
    R = np.diag(np.tile(np.repeat(run.sensors.noise**2, 3), 4))
    every = [(uav, (0, 1, 2, 3, 4)) for uav in range(4)]

    def unknown(z: Array) -> Array | None:
        return kalman.forces(replace(belief, x=z[:n], forces=z[n:]))

    def moved(z: Array, xi: Array) -> Array:
        T, _ = kalman.basis(z[:n])
        return np.concatenate([kalman.moved(z[:n], T @ xi[:r]), z[n:] + xi[r:]])

    def jacobian(f, z: Array) -> Array:  # type: ignore[no-untyped-def]
        return np.column_stack(
            [(f(moved(z, d)) - f(moved(z, -d))) / 2e-6 for d in 1e-6 * np.eye(len(P))]
        )

    for k in range(12):

        def sensed(z: Array, k: int = k) -> Array:
            return model.sense(z[:n], U[k], forces=unknown(z))[0]

        def step(z: Array, k: int = k, delayed: Array | None = None) -> Array:
            u = U[k + 1] if delayed is None else U[k + 1] + delayed
            return model.integrate(z[:n], u, PERIOD_S, STEPS, forces=unknown(z))[0]

        H = jacobian(sensed, z)
        G = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        z, P = moved(z, G @ (Z[k].reshape(-1) - sensed(z))), (np.eye(len(P)) - G @ H) @ P
        belief = kalman.correct(
            belief, model, [(uav, sensors, Z[k][uav]) for uav, sensors in every]
        )
        A = np.eye(len(P))
        A[:r] = kalman.basis(step(z))[1].T @ jacobian(step, z)
        Q = kalman.lacking(belief.level)
        # Each input may act as late as the unknown lag.
        late = np.diag(UNKNOWN_LAG_S / PERIOD_S * (U[k + 1] - (U[k] if k else run.hover.u)))
        effects = (
            kalman.basis(step(z))[1].T @ np.array([step(z, delayed=u) - step(z) for u in late]).T
        )
        Q[:r, :r] += effects @ effects.T
        z, P = np.concatenate([step(z), z[n:]]), A @ P @ A.T + Q
        none, ahead = np.zeros(16, dtype=bool), step(np.concatenate([belief.x, belief.forces]))
        belief = kalman.predict(belief, model, k, ahead, U[k + 1], none, none)
    deviation = np.sqrt(np.diag(P))
    np.testing.assert_allclose(
        np.sqrt(np.diag(belief.covariance.P)), deviation, rtol=SAME_DEVIATION, atol=1e-3
    )
    xi = np.concatenate([kalman.basis(z[:n])[1].T @ (belief.x - z[:n]), belief.forces - z[n:]])
    assert np.abs(xi / deviation).max() < SAME_MEAN
    assert deviation[:3].max() < FOUND_M


def test_messages_in_any_order_give_the_same_belief() -> None:
    """Late messages, shuffled and lost but for the repeats of later ones, end in the same bits as those in time."""
    last = TICKS - 1
    together = [one for plans in in_time(2, 1).values() for one in plans if one.tick < last - 1]
    rng = np.random.default_rng(0)
    kept = [one for one in together if one.tick % state.REPORTS == 1 or one.tick == last - 2]
    rng.shuffle(kept)
    straight, _ = filtered(
        {one.tick + 1: [p for p in together if p.tick == one.tick] for one in together}, 2, last
    )
    # The inputs of the last period are those of the newest plans, which both have.
    late, _ = filtered({last - 1: kept}, 2, last)
    np.testing.assert_allclose(late[-1].x, straight[-1].x, atol=1e-12)
    np.testing.assert_allclose(late[-1].covariance.P, straight[-1].covariance.P, atol=1e-12)


@pytest.mark.parametrize("late", [1, DELAY])
def test_errors_match_their_covariance(late: int) -> None:
    """The mean squared error in units of the covariance is the number of coordinates, from a swing that is unknown."""
    found = []
    for seed in range(6):
        _, X, _, _ = moving(seed, HALF)
        beliefs, kalman = filtered(in_time(seed, late, HALF), seed, TICKS - 1, HALF)
        for k in range(DELAY + 4, TICKS, 5):
            xi = kalman.basis(beliefs[k].x)[1].T @ (X[k] - beliefs[k].x)
            found.append(xi @ np.linalg.solve(beliefs[k].covariance.P, xi) / len(xi))
    assert HONEST[0] < np.mean(found) < HONEST[1]


def test_newest_ticks_are_nearly_as_exact_as_with_their_own_gains(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The gain of the last tick that others' messages reached costs a tenth of the error at most; P knows its part."""
    _, X, _, _ = moving(3, HALF)

    def errors() -> tuple[Array, list[Belief]]:
        beliefs, _ = filtered(in_time(3, DELAY, HALF), 3, TICKS - 1, HALF)
        return np.array([b.x - x for b, x in zip(beliefs, X, strict=False)])[
            2 * DELAY :, :3
        ], beliefs

    found, quick = errors()
    monkeypatch.setattr("transport.agent.kalman._SAME_GAIN", -1)
    best, exact = errors()
    assert not np.array_equal(quick[-1].x, exact[-1].x)
    assert np.sqrt((found**2).mean()) < 1.1 * np.sqrt((best**2).mean()) + 1e-3
    trace = [np.trace(beliefs[-1].covariance.P[:3, :3]) for beliefs in (quick, exact)]
    assert trace[1] < trace[0] < 1.2 * trace[1]


def test_level_of_what_the_model_lacks_follows_the_innovations() -> None:
    """White innovations keep a model exact.

    Those of a payload that falls faster than the model says deny it.
    """
    run, X, U, _ = moving(5, SMALL)
    rng = np.random.default_rng(5)
    for pull_N, exact in ((0.0, True), (3.0, False)):
        kalman = KalmanFilter(run, lambda _: np.zeros((run.system.m, run.system.n)))
        x, belief = X[0], kalman.first(X[0])
        forces = np.zeros(3 + 3 * run.system.N)
        forces[2] = pull_N
        none = np.zeros(run.system.m, dtype=bool)
        for k in range(60):
            ahead, _ = run.model.integrate(belief.x, U[0], PERIOD_S, STEPS)
            x, _ = run.model.integrate(x, U[0], PERIOD_S, STEPS, forces=forces)
            sense = run.model.sense(x, U[0], forces=forces)[0].reshape(-1, state.SENSED)
            z = sense + np.repeat(run.sensors.noise, 3) * rng.standard_normal(sense.shape)
            belief = kalman.predict(belief, run.model, k, ahead, U[0], none, none)
            belief = kalman.correct(
                belief, run.model, [(uav, (0, 1, 2, 3, 4), z[uav]) for uav in range(4)]
            )
        assert (belief.level < EXACT) is exact
        assert np.trace(kalman.lacking(belief.level)) == belief.level * np.trace(kalman.Q)


def test_pose_and_covariance_are_told_in_full() -> None:
    """What an agent tells of the payload is its pose, the covariance of that, and the surprise of the last tick."""
    beliefs, _ = filtered(in_time(1, 1), 1, 3)
    pose, P = understood(told(beliefs[-1])[None])
    places = [0, 1, 2, 6, 7, 8]
    np.testing.assert_array_equal(pose[0], beliefs[-1].x[places])
    np.testing.assert_array_equal(P[0], beliefs[-1].covariance.P[np.ix_(places, places)])
    assert len(TOLD) == len(told(beliefs[-1]))
