"""Kalman filter over the team: against a dense filter, honest covariance, level of errors."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from tests.agent.estimation.swing import PERIOD_S, TICKS, error, filtered, in_time, moving, sensed
from tests.support.runs import VEHICLE, setup
from transport.agent.communication.unannounced_inputs import Silent, Unannounced
from transport.agent.estimation.estimate_notes import NAMES, pose_numbers, poses
from transport.agent.estimation.filter.assumed_noise import ModelNoise
from transport.agent.estimation.filter.belief import Belief
from transport.agent.estimation.filter.filter_interface import FilterPeriod
from transport.agent.estimation.filter.team_filter import TeamFilter
from transport.agent.estimation.predicted_motion import STEPS
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.scenario.setup.run_setup import Setup

DELAY = 4  # ticks
# The filter's covariance takes the linearisation at the beginning of a period, the oracle the
# derivative of the whole period: relative to the largest standard deviations they differ by a few
# percent, with rods in motion.
SAME_DEVIATION = 0.05
SAME_MEAN = 0.2  # through the gains, in standard deviations
SMALL = 0.1  # share of the first doubt: corrections small enough to be linear
HALF = 0.5  # share of it at which the first corrections are linear enough for an honest covariance
EXACT = 1e-3  # level below which a model counts as exact
LOCATED_M = 0.02  # standard deviation of the payload's position after half a second
DIFFERENCE = 1e-6  # of central differences: their error is some 1e-9 of the second derivatives
# 99.8 % band of the mean over 48 of a squared error with 52 degrees of freedom, over 52, as if
# ticks were independent; they are correlated over a second, so this is the band of about ten of
# them.
HONEST = (0.75, 1.3)


def told_period(run: Setup, end: Array, u: Array, forces: Array | None) -> FilterPeriod:
    """Return a period all of whose inputs are told, under forces estimated at its beginning."""
    told = np.zeros(run.system.m, dtype=bool)
    return FilterPeriod(
        model=run.model,
        end=end,
        u=u,
        forces=forces,
        unannounced=Unannounced(by_law=told, by_fail_safe=told),
        K=None,
        correlation=0.0,
    )


def jacobian(function: Callable[[Array], Array], xi: int) -> Array:
    """Return the derivative of a function of coordinates at zero, by central differences."""
    steps = DIFFERENCE * np.eye(xi)
    return np.column_stack(
        [(function(step) - function(-step)) / (2.0 * DIFFERENCE) for step in steps]
    )


@dataclass
class Dense:
    """The textbook filter with differences of the nonlinear model as Jacobians.

    Its mean z holds the state and the unknown forces, and P is in the coordinates of a belief.
    """

    run: Setup
    team: TeamFilter
    z: Array
    P: Array

    @property
    def n(self) -> int:
        """States."""
        return self.run.system.n

    @property
    def r(self) -> int:
        """Coordinates of a state."""
        return self.team.manifold.r

    def moved(self, xi: Array) -> Array:
        """Return the mean moved by coordinates."""
        T = self.team.manifold.basis(self.z[: self.n]).T
        x = self.team.manifold.moved(self.z[: self.n], T @ xi[: self.r])
        return np.concatenate([x, self.z[self.n :] + xi[self.r :]])

    def forces(self, z: Array) -> Array | None:
        """Return the external forces of a mean."""
        belief = replace(self.team.first(z[: self.n]), unknowns=z[self.n :])
        return self.team.forces(belief)

    def step(self, z: Array, u: Array) -> Array:
        """Return the state one period later."""
        forces = self.forces(z)
        return self.run.model.integrate(z[: self.n], u, PERIOD_S, STEPS, forces=forces)[0]

    def correct(self, measurements: Array, u: Array) -> None:
        """Correct by the measurements of all UAVs."""
        R = np.diag(np.tile(np.repeat(self.run.sensors.noise**2, 3), self.run.system.N))

        def sense(xi: Array) -> Array:
            z = self.moved(xi)
            return self.run.model.sense(z[: self.n], u, forces=self.forces(z))[0]

        H = jacobian(sense, len(self.P))
        G = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + R)
        innovation = measurements.reshape(-1) - sense(np.zeros(len(self.P)))
        self.z = self.moved(G @ innovation)
        self.P = (np.eye(len(self.P)) - G @ H) @ self.P

    def predict(self, u: Array, du: Array, level: float) -> None:
        """Predict one period under inputs that have changed by du."""
        end = self.step(self.z, u)
        L = self.team.manifold.basis(end).L
        A = np.eye(len(self.P))
        A[: self.r] = L.T @ jacobian(lambda xi: self.step(self.moved(xi), u), len(self.P))

        # Each input may act as late as the unknown lag.
        late = np.diag(ModelNoise().unknown_lag_s / PERIOD_S * du)
        effects = L.T @ np.array([self.step(self.z, u + one) - end for one in late]).T
        Q = self.team.growth.process_noise(level)
        Q[: self.r, : self.r] += effects @ effects.T

        self.P = A @ self.P @ A.T + Q
        self.z = np.concatenate([end, self.z[self.n :]])


@pytest.mark.parametrize("forces", ["false", "true"])
def test_against_a_dense_filter_with_numerical_jacobians(forces: str) -> None:
    """Means and covariances are those of the textbook filter with numerical Jacobians."""
    _, _, U, Z = moving(1, SMALL)
    run = setup(*VEHICLE, f"controller.disturbance.estimate={forces}")
    team = TeamFilter(run.run)
    belief = team.first(run.X_ref[0])
    first = belief.covariance
    belief = replace(belief, source=replace(first, P=SMALL**2 * first.P))
    dense = Dense(run, team, np.concatenate([belief.x, belief.unknowns]), belief.covariance.P)

    for k in range(12):
        dense.correct(Z[k], U[k])
        belief = team.correct(belief, run.model, sensed(Z[k]))

        before = U[k] if k else run.hover.u
        dense.predict(U[k + 1], U[k + 1] - before, belief.level.value)
        end = dense.step(np.concatenate([belief.x, belief.unknowns]), U[k + 1])
        belief = team.predict(belief, told_period(run, end, U[k + 1], team.forces(belief)))

    deviation = np.sqrt(np.diag(dense.P))
    np.testing.assert_allclose(
        np.sqrt(np.diag(belief.covariance.P)), deviation, rtol=SAME_DEVIATION, atol=1e-3
    )
    L = team.manifold.basis(dense.z[: dense.n]).L
    unknowns = belief.unknowns - dense.z[dense.n :]
    xi = np.concatenate([L.T @ (belief.x - dense.z[: dense.n]), unknowns])
    assert np.abs(xi / deviation).max() < SAME_MEAN
    assert deviation[:3].max() < LOCATED_M


@pytest.mark.parametrize("is_overdue", [False, True])
@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_others_that_follow_the_law_against_a_dense_computation(
    correlation: float, is_overdue: bool
) -> None:
    """The others answer to their own estimates, whose errors e share c with the own error xi, (63).

    With e = c xi + (1 - c^2)^(1/2) w and w as uncertain as xi, their inputs deviate by K T (xi - e). Information
    that is overdue, of which no agent acts alone yet, gives the same by (63c).
    """
    run = setup(*VEHICLE)
    team = TeamFilter(run.run)
    belief = team.first(run.X_ref[0])
    P = belief.covariance.P
    T = belief.covariance.basis.T
    dense = Dense(run, team, np.concatenate([belief.x, belief.unknowns]), P)
    K = np.random.default_rng(3).normal(size=(run.system.m, run.system.n))
    by_law = np.arange(run.system.m) >= state.INPUTS  # of all UAVs but the first
    end = dense.step(dense.z, run.hover.u)
    period = replace(
        told_period(run, end, run.hover.u, team.forces(belief)),
        unannounced=Unannounced(by_law=by_law, by_fail_safe=np.zeros_like(by_law)),
        K=K,
        correlation=correlation,
        silent=Silent(alone=np.zeros(run.system.m), correlation=np.full(run.system.m, correlation))
        if is_overdue
        else None,
    )

    L = team.manifold.basis(end).L

    def answered(xi: Array) -> Array:
        return run.hover.u + np.where(by_law, K @ (T @ xi[: dense.r]), 0.0)

    by_own = jacobian(
        lambda xi: dense.step(dense.moved(xi), answered((1.0 - correlation) * xi)), len(P)
    )
    by_others = jacobian(lambda xi: dense.step(dense.z, answered(xi)), len(P))
    A = np.eye(len(P))
    A[: dense.r] = L.T @ by_own
    unshared = np.zeros_like(P)
    unshared[: dense.r] = (1.0 - correlation**2) ** 0.5 * L.T @ by_others
    expected = (
        A @ P @ A.T + unshared @ P @ unshared.T + team.growth.process_noise(belief.level.value)
    )

    predicted = team.predict(belief, period).covariance.P
    deviation = np.sqrt(expected.diagonal())
    different = (predicted - expected) / np.outer(deviation, deviation)
    assert np.abs(different).max() < SAME_DEVIATION


@pytest.mark.parametrize("late", [1, DELAY])
def test_errors_match_their_covariance(late: int) -> None:
    """The mean squared error in units of the covariance is the number of coordinates."""
    squared = []
    for seed in range(6):
        run, X, _, _ = moving(seed, HALF)
        beliefs = filtered(in_time(seed, late, HALF), seed, TICKS - 1, HALF)
        for k in range(DELAY + 4, TICKS, 5):
            xi = error(run, beliefs[k], X[k])
            squared.append(xi @ np.linalg.solve(beliefs[k].covariance.P, xi) / len(xi))
    assert HONEST[0] < np.mean(squared) < HONEST[1]


def level_after_flight(pull_N: float) -> tuple[TeamFilter, Belief]:
    """Return filter and belief after three seconds, under an unknown force on the payload."""
    run, X, U, _ = moving(5, SMALL)
    rng = np.random.default_rng(5)
    team = TeamFilter(run.run)
    x = X[0]
    belief = team.first(X[0])
    forces = np.zeros(3 + 3 * run.system.N)
    forces[2] = pull_N
    for _ in range(60):
        end, _ = run.model.integrate(belief.x, U[0], PERIOD_S, STEPS)
        x, _ = run.model.integrate(x, U[0], PERIOD_S, STEPS, forces=forces)
        sense = run.model.sense(x, U[0], forces=forces)[0].reshape(-1, state.SENSED)
        z = sense + np.repeat(run.sensors.noise, 3) * rng.standard_normal(sense.shape)
        belief = team.predict(belief, told_period(run, end, U[0], team.forces(belief)))
        belief = team.correct(belief, run.model, sensed(z))
    return team, belief


@pytest.mark.parametrize(("pull_N", "is_exact"), [(0.0, True), (3.0, False)])
def test_level_of_the_models_errors_follows_the_innovations(pull_N: float, is_exact: bool) -> None:
    """White innovations keep a model exact; those of a payload that falls faster deny it."""
    team, belief = level_after_flight(pull_N)
    level = belief.level.value
    assert (level < EXACT) is is_exact
    assert np.trace(team.growth.process_noise(level)) == level * np.trace(team.growth.Q)


@pytest.mark.parametrize(
    ("change", "is_plausible"),
    [
        ({}, True),
        ({"nis": 99.0}, True),  # docs/record/derivations.md: 100 per measurement
        ({"nis": 101.0}, False),
        ({"roll_rad": 1.39}, True),
        ({"roll_rad": -1.41}, False),
        ({"pitch_rad": 1.41}, False),
        ({"variance": 0.9e4}, True),
        ({"variance": 1.1e4}, False),
        ({"height_m": np.inf}, False),
    ],
    ids=str,
)
def test_a_belief_that_no_team_in_flight_has(change: dict[str, float], is_plausible: bool) -> None:
    """Measurements 10 standard deviations off deny it, as do bodies near Euler angles' singularity."""
    run = moving(5, SMALL)[0].run
    team = TeamFilter(run)
    belief = team.first(run.hover.x)
    x, P = belief.x.copy(), belief.covariance.P.copy()
    x[state.THETA0.start] += change.get("roll_rad", 0.0)
    x[state.THETA0.start + 1] += change.get("pitch_rad", 0.0)
    x[2] += change.get("height_m", 0.0)
    P[0, 0] = change.get("variance", P[0, 0])
    source = replace(
        belief.covariance, P=P, squared_error=15.0 * change.get("nis", 1.0), measurements=15
    )
    assert team.is_plausible(replace(belief, x=x, source=source)) is is_plausible


def test_pose_and_covariance_are_told_in_full() -> None:
    """The numbers for the log are pose, covariance, and innovation of the last tick."""
    belief = filtered(in_time(1, 1), 1, 3)[-1]
    numbers = pose_numbers(belief)
    pose, P = poses(numbers[None])
    places = [0, 1, 2, 6, 7, 8]
    np.testing.assert_array_equal(pose[0], belief.x[places])
    np.testing.assert_array_equal(P[0], belief.covariance.P[np.ix_(places, places)])
    assert numbers[-2:].tolist() == [
        belief.covariance.squared_error,
        belief.covariance.measurements,
    ]
    assert len(NAMES) == len(numbers)
