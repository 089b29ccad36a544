"""Error-state Kalman filter over the whole team, from the measurements of the UAVs' own sensors.

No sensor sees the payload or the rods: they follow from where all UAVs are and how they move. The error of an estimate
lives on the manifold |e_i| = 1, e_i . Omega_i = 0, in 12 + 10 N coordinates about the estimate, so that positions do
not correct the lengths of the rods.

The other agents act by the shared control law from their own estimates. Where an input of theirs is not known, the
error of the estimate acts on it through the gain of that law, and so do the errors of their own estimates.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.handover import SHARED
from model import motors, state
from model.arrays import Array, padded
from model.discretisation import zero_order_hold
from model.linearisation import Model
from model.rotations import rotation
from mpc.fail_safe import FailSafe
from protocol.scenario.setup import Setup

# Gain of the shared control law at a tick, (m, n), with motor lag (m, n + m); of UAVs without agents their fail-safe's.
Feedback = Callable[[int], Array]

# Standard deviations before the first measurement, about the reference: r0, v0, Theta0, omega0; e, Omega, Theta, omega;
# and of the payload's yaw and its rate: a formation at rest turns its load with it.
_PAYLOAD, _UAV, _YAW = (0.3, 0.2, 0.06, 0.1), (0.06, 0.1, 0.1, 0.2), (0.015, 0.02)
# Those of the accelerations that the model lacks, white, m/s^2 and rad/s^2: at most, and beside unknown forces.
_ACCELERATION, _BESIDE_FORCES = 0.01, 1e-3
# Smallest standard deviations assumed of sensors, in the order of the sensors: errors of the model show in them.
_FLOOR = (1e-3, 5e-3, 1e-3, 2e-3, 0.1)
# Horizontal forces on the payload over its weight, its mass error over its mass, horizontal and equal forces on the
# UAVs over the weight, and drag of payload and UAVs over mass and speed, 1/s: standard deviations at first, and of the
# change over a second. Gusts of 1 m/s are slow.
_FORCE = (0.03, 0.03, 0.2, 0.03, 0.03, 0.3, 0.3)
_FORCE_CHANGE = (0.045, 0.045, 0.015, 0.036, 0.036, 0.015, 0.015)
_DRAG = [5, 6]
# Lag of motors that agents do not know, s: what it does after a change of the inputs must not count as a force.
UNKNOWN_LAG_S = 0.03
# Correlation of the changes on payload and UAVs: the same air moves all of them.
_SAME_AIR = 0.8
# Roll and pitch beyond which an estimate is that of no team in flight, rad: Euler angles become singular. A variance that
# no measurement of a UAV's own sensors leaves, SI.
_STEEPEST, _LARGEST_VARIANCE = 1.4, 1e4
# Remainder of the difference equation for the covariance, far below what the model lacks.
_REMAINDER = 1e-4


class _Level(NamedTuple):
    """How the variance of what the model lacks follows the innovations, as a share of its largest.

    Innovations are white if the level is right; their slow part is larger if it is too low, smaller if it is too high.
    """

    first: float  # at the beginning
    least: float
    white: float  # squared slow part, in units of that of white innovations, at which the level stays
    predicted: bool  # whether entries count as much as the prediction, not the sensor, errs
    rate: float  # change of the level's logarithm in a tick per excess of the slow part


# Most excess of the slow part that counts, and the time over which that part is taken, s.
_EXCESS, _SLOW_S = 3.0, 1.0
# A model without unknown forces is exact until innovations deny it. Wind must be found quickly while it blows.
_EXACT = _Level(first=1e-4, least=1e-6, white=1.15, predicted=False, rate=0.2)
_WIND = _Level(first=1.0, least=1e-4, white=0.5, predicted=True, rate=0.1)

# Ticks in a row, with nothing but own measurements, whose gain is that of the last correction with more: of the newest
# ticks, the others' are on their way. A tick that has them has its own covariance and gain. Without external forces.
_SAME_GAIN = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Covariance:
    """Covariance of the error of an estimate."""

    P: Array  # (r, r), of the coordinates of the state, the actual inputs with motor lag, and the forces
    T: Array  # basis of these coordinates, without the forces
    L: Array  # the same about the state before its correction
    # Squared innovation of the last measurements in units of its covariance, and how many they were.
    surprise: tuple[float, int] = (0.0, 0)


@dataclass(slots=True, kw_only=True)
class Belief:
    """Estimate at a tick and the covariance of its error, which is computed when it is asked for."""

    x: Array  # state, (n,); with motor lag [x, a], (n + m,)
    # Horizontal forces on the payload (2), N, its mass error, kg, horizontal force on each UAV (2), N, and drag of
    # payload and each UAV (2), kg/s; or none.
    forces: Array
    u: Array  # inputs until the tick, (m,)
    found: Covariance | Callable[[], Covariance]
    slow: Array  # slow part of the innovations in units of their deviations, (15 N,)
    level: float  # variance of what the model lacks, as a share of its largest
    # Gain of own measurements from the last correction that had a gain of its own, (n + forces, own), and ticks since.
    own: tuple[Array, int] | None = None

    @property
    def covariance(self) -> Covariance:
        """The covariance, computed once."""
        if not isinstance(self.found, Covariance):
            self.found = self.found()
        return self.found


# What an agent knows of the payload in numbers: estimate, upper triangle of its covariance, surprise.
POSE = ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad")
_PLACES, _UPPER = np.r_[state.R0, state.THETA0], np.triu_indices(len(POSE))
TOLD = (*POSE, *(f"covariance_{POSE[i]}_{POSE[j]}" for i, j in zip(*_UPPER, strict=True)), "surprise", "measurements")


def told(belief: Belief) -> Array:
    """Return the numbers named by `TOLD`."""
    found = belief.covariance
    P = found.P[np.ix_(_PLACES, _PLACES)]
    return np.concatenate([belief.x[_PLACES], P[_UPPER], found.surprise])


def understood(numbers: Array) -> tuple[Array, Array]:
    """Return estimates of the payload's pose, (k, 6), and their covariances, (k, 6, 6), from rows of such numbers."""
    P = np.empty((len(numbers), len(POSE), len(POSE)))
    P[:, _UPPER[0], _UPPER[1]] = P[:, _UPPER[1], _UPPER[0]] = numbers[:, len(POSE) : -2]
    return numbers[:, : len(POSE)], P


@lru_cache
def _places(sensed: tuple[tuple[int, tuple[int, ...]], ...]) -> tuple[npt.NDArray[np.intp], ...]:
    """Return places within the UAV and within all, and parts, from UAV and sensors of each; which are angles."""
    found = [
        (3 * sensor + axis, uav, part)
        for part, (uav, sensors) in enumerate(sensed)
        for sensor, axis in product(sensors, range(3))
    ]
    of, uavs, part = np.array(found, dtype=np.intp).T
    return of, of + state.SENSED * uavs, part, np.flatnonzero((of >= state.THETA.start) & (of < state.THETA.stop))


def _rods(x: Array, N: int) -> tuple[Array, Array]:
    """Return views of rods and their rates, (N, 3) each, in a state."""
    uavs = x[state.PAYLOAD : state.PAYLOAD + state.PER_UAV * N].reshape(N, -1)
    return uavs[:, state.E], uavs[:, state.ROD_RATE]


class KalmanFilter:
    """Filter of one agent from a run, the gain of the shared control law, and UAVs, 0-based, measured at once.

    A pure function from belief to belief; `Q` is the largest covariance of what the model lacks, per period, in the
    coordinates of a belief, and `ages` are those of the sensors' quantities, ticks.
    """

    def __init__(self, setup: Setup, feedback: Feedback, owned: Sequence[int] = ()) -> None:
        system, sheet, self._feedback, self._model = setup.system, setup.sensors, feedback, setup.model
        alone = FailSafe(system, setup.hover.u, setup.hover.x[None])
        columns = system.n + (system.m if setup.settings.motor_lag_s > 0.0 else 0)
        # Of UAVs alone: their feedback about hover, and the variance of their inputs by the noise of their sensors.
        self._alone_gain = padded(np.vstack([alone.gain(uav) for uav in range(system.N)]), columns)
        slopes = np.vstack([alone.law(uav).by_sensors() for uav in range(system.N)])
        self._alone_variance = slopes**2 @ np.repeat(sheet.noise**2, 3)
        self._period_s, self._lag_s = setup.settings.sampling_period_s, setup.settings.motor_lag_s
        self._u_hover = setup.hover.u
        N = self._N = system.N
        self.ages = sheet.ages
        self._R = np.repeat(np.maximum(sheet.noise, _FLOOR) ** 2 + sheet.bias**2, 3)
        self._inputs = system.m if self._lag_s > 0.0 else 0
        self._lightest = -0.9 * system.payload.mass
        forces = len(_FORCE) if setup.scenario.controller.disturbance.estimate else 0
        # Unknown forces change within few ticks, and with them the gain.
        self._owned = list(owned) if len(owned) < N and not forces else []
        self._is_own = np.repeat(np.isin(np.arange(N), self._owned), state.SENSED)
        self._level = _WIND if forces else _EXACT
        # External forces and mass from those that are estimated.
        self._spread = np.zeros((4 + 3 * N, forces))
        if forces:
            self._spread[[0, 1, -1], [0, 1, 2]] = 1.0
            self._spread[3:-1] = np.tile(np.eye(3, forces, k=3) * (np.arange(forces) < _DRAG[0]), (N, 1))
        masses = [system.payload.mass, min(uav.mass for uav in system.uavs)]
        weights = np.append(system.gravity * np.repeat(masses, (3, 2)), masses)[:forces]
        weights[2:3] /= system.gravity
        payload = np.repeat(_PAYLOAD, 3)
        payload[[8, 11]] = _YAW
        deviations = [*payload, *np.tile(np.repeat(_UAV, (2, 2, 3, 3)), N), *[0.0] * self._inputs]
        self._P0 = np.diag(np.concatenate([deviations, weights * _FORCE[:forces]]) ** 2)
        # Coordinates that accelerations change: velocities and rates of the payload, then of each UAV.
        moving = [0.0, 1.0, 0.0, 1.0]
        rates = np.concatenate([np.repeat(moving, 3), np.tile(np.repeat(moving, (2, 2, 3, 3)), N)])
        steps = np.diag(np.concatenate([self._period_s**2 * rates, np.zeros(self._inputs + forces)]))
        self.Q, self._beside = _ACCELERATION**2 * steps, np.zeros_like(steps)
        if forces:
            self.Q, self._beside = self._beside, _BESIDE_FORCES**2 * steps
            together = np.eye(forces)
            together[[0, 1, 3, 4], [3, 4, 0, 1]] = _SAME_AIR
            change = np.sqrt(self._period_s) * weights * _FORCE_CHANGE
            self.Q[-forces:, -forces:] = together * np.outer(change, change)
        # The basis without the rods, and places of the rods in it: their rows, those of their rates, columns of both.
        n, r = state.PAYLOAD + state.PER_UAV * N, len(rates)
        self._frame = np.zeros((n + self._inputs, r + self._inputs))
        self._frame[: state.PAYLOAD, : state.PAYLOAD] = np.eye(state.PAYLOAD)
        self._frame[state.PAYLOAD : n, state.PAYLOAD : r] = np.kron(
            np.eye(N), np.vstack([np.zeros((6, 10)), np.eye(6, 10, k=4)])
        )
        self._frame[n:, r:] = np.eye(self._inputs)
        row = state.PAYLOAD + state.PER_UAV * np.arange(N)[:, None, None] + np.arange(3)[:, None]
        column = state.PAYLOAD + 10 * np.arange(N)[:, None, None] + np.arange(2)
        self._across = row + state.E.start, row + state.ROD_RATE.start, column, column + 2

    def first(self, x: Array) -> Belief:
        """Return the belief before any measurement, about a state."""
        T, L = self.basis(x)
        found = Covariance(P=self._P0, T=T, L=L)
        forces, slow = np.zeros(self._spread.shape[1]), np.zeros(state.SENSED * self._N)
        return Belief(x=x, forces=forces, u=self._u_hover, found=found, slow=slow, level=self._level.first)

    def is_plausible(self, belief: Belief) -> bool:
        """Return whether a belief can be that of a team in flight: no body far over, numbers in range."""
        x = belief.x[: self._model.system.n]
        view = state.StateView(x)
        if not np.abs(belief.x).max() < state.LARGEST or not np.isfinite(belief.forces).all():
            return False
        if max(np.abs(view.Theta0[:2]).max(), np.abs(view.Theta[:, :2]).max()) > _STEEPEST:
            return False
        found = belief.found
        return not isinstance(found, Covariance) or bool(found.P.diagonal().max() < _LARGEST_VARIANCE)

    def forces(self, belief: Belief) -> Array | None:
        """Return the estimated forces and mass error as `Model` takes them, (4 + 3 N,); None if not estimated."""
        if not len(belief.forces):
            return None
        found: Array = self._spread @ belief.forces
        found[:-1] += self._resistance(belief.x) @ belief.forces[_DRAG]
        found[-1] = max(found[-1], self._lightest)
        return found

    def _resistance(self, x: Array) -> Array:
        """Return the external forces per drag of payload and UAVs, (3 + 3 N, 2), at a state."""
        found = np.zeros((len(self._spread) - 1, 2))
        velocities = self._model.velocities(x[: self._model.system.n]).reshape(-1)
        found[:3, 0], found[3:, 1] = -velocities[:3], -velocities[3:]
        return found

    def _effects(self, model: Model, x: Array, u: Array, forces: Array) -> Array:
        """Return the external forces per estimated one, (3 + 3 N, 7).

        Gravity minus acceleration acts on a mass. Its inertia, which turns the payload, is left out.
        """
        rate, view, effects = model.derivative(x, u, forces=forces), state.StateView(x), self._spread[:-1].copy()
        effects[:3, 2] = -rotation(view.Theta0) @ (rate[state.V0] + np.cross(view.omega0_P, view.v0_P))
        effects[2, 2] += model.system.gravity
        effects[:, _DRAG] = self._resistance(x)
        return effects

    def basis(self, x: Array) -> tuple[Array, Array]:
        """Return T, dx = T xi, and L, xi = L' dx, (n, r); with lag (n + m, r + m). Source: equations.md (62)."""
        e, Omega = _rods(x, self._N)
        # Two unit vectors across each rod, by the reflection that maps e to the z axis: smooth around the hover.
        w = e.copy()
        w[:, 2] += np.where(e[:, 2] < 0.0, -1.0, 1.0)
        across = np.eye(3, 2) - (2.0 / np.einsum("ij,ij->i", w, w))[:, None, None] * w[:, :, None] * w[:, None, :2]
        L, (rods, rates, along, turning) = self._frame.copy(), self._across
        L[rods, along] = L[rates, turning] = across
        T = L.copy()
        T[rates, along] = -e[:, :, None] * np.einsum("ij,ijk->ik", Omega, across)[:, None, :]
        return T, L

    def lacking(self, level: float) -> Array:
        """Return the covariance of what the model lacks, per period, at a level of it."""
        return level * self.Q + self._beside

    def predict(
        self,
        belief: Belief,
        model: Model,
        tick: int,
        ahead: Array,
        u: Array,
        by_law: npt.NDArray[np.bool_],
        by_fail_safe: npt.NDArray[np.bool_],
        silent: tuple[Array, Array] | None = None,
    ) -> Belief:
        """Return the belief one tick later than `tick`, under equations of motion from then on.

        Given are the state one tick later, (n,), with motor lag (n + m,), SI; the inputs in between, (4 N,); and which
        of them follow the control law from estimates of their agents, or the fail-safe, which knows its UAV, (4 N,).
        Of those by the law `silent` has the share alone, which knows its UAV too, and the correlation of errors, (4 N,)
        each; None: no share, and as usual. Source: docs/equations.md (63), (63c).
        """
        # The law is that of now, whenever the covariance is computed.
        K = self._feedback(tick) if by_fail_safe.any() or by_law.any() else None
        is_alone = silent is not None and bool(silent[0][by_law].any())
        kept = self._kept(silent, by_law) if is_alone else np.ones(len(belief.forces))

        def found() -> Covariance:
            n = model.system.n
            x, forces, actual = belief.x[:n], self.forces(belief), belief.x[n:] if self._inputs else u
            linear = model.linearise(x, actual, forces=forces)
            if self._inputs:
                linear = motors.lagged(linear, actual, u, self._lag_s, model.system.commands_rates)
            discrete = zero_order_hold(linear, self._period_s, remainder=_REMAINDER)
            P, T = belief.covariance.P, belief.covariance.T
            T_ahead, L = self.basis(ahead)
            moved, s = discrete.A @ T, T.shape[1]
            pushed = np.zeros((len(T), 0)) if forces is None else self._pushed(model, x, actual, forces, discrete.A)
            # It is not known exactly when the fail-safe of another UAV took over, and at what thrust.
            Q = self.lacking(1.0 if by_fail_safe.any() or is_alone else belief.level)
            lagging = L.T @ discrete.B * (UNKNOWN_LAG_S / self._period_s * (u - belief.u))
            Q[:s, :s] += lagging @ lagging.T
            if K is not None:
                B, closed = discrete.B, by_law | by_fail_safe
                apart = np.where(by_law, 1.0 - SHARED, 1.0)
                unshared = 1.0 - SHARED**2
                if silent is not None:
                    alone, shared = silent
                    apart = np.where(by_law, (1.0 - alone) * (1.0 - shared), 1.0)
                    moved = moved + (B * (alone * by_law)) @ (self._alone_gain @ T)
                    sensing = L.T @ (discrete.B * (alone * by_law))
                    Q[:s, :s] += (sensing * self._alone_variance) @ sensing.T
                    B, unshared = B * ((1.0 - alone) * np.sqrt(1.0 - shared**2)), 1.0
                    moved = moved + (discrete.B * apart)[:, closed] @ (K[closed] @ T)
                else:
                    moved = moved + (B * apart)[:, closed] @ (K[closed] @ T)
                effect, K_T = L.T @ B[:, by_law], K[by_law] @ T
                Q[:s, :s] += unshared * effect @ (K_T @ P[:s, :s] @ K_T.T) @ effect.T
            A = np.eye(len(P))
            A[:s, :s], A[:s, s:] = L.T @ moved, L.T @ pushed
            if is_alone:
                A[s:, s:] = np.diag(kept)
            P = A @ P @ A.T + Q
            return Covariance(P=(P + P.T) / 2.0, T=T_ahead, L=L)

        own = None if belief.own is None else (belief.own[0], belief.own[1] + 1)
        forces_ahead = kept * belief.forces if is_alone else belief.forces
        return replace(belief, x=ahead, forces=forces_ahead, u=u, found=found, own=own)

    def _kept(self, silent: tuple[Array, Array] | None, by_law: npt.NDArray[np.bool_]) -> Array:
        """Return the share of forces that is left after a period without news, (forces,). Source: equations.md (63d).

        As random walks, forces that own sensors do not tell apart have no bound. With news of all others they are such
        walks, without any they return to zero, and their variance to that at first.
        """
        forces = self._spread.shape[1]
        if silent is None or not forces:
            return np.ones(forces)
        change, first = self.Q.diagonal()[-forces:], self._P0.diagonal()[-forces:]
        return np.asarray((1.0 - change / first) ** (0.5 * float(silent[0][by_law].mean())))

    def _pushed(self, model: Model, x: Array, u: Array, forces: Array, A: Array) -> Array:
        """Return the effect of the unknown forces over a period, (n, forces), to second order in it."""
        still = np.append(np.zeros(len(forces) - 1), forces[-1])
        f, effect = model.derivative(x, u, forces=still), np.zeros((len(A), self._spread.shape[1]))
        units = np.vstack([self._effects(model, x, u, forces), np.zeros((1, len(_FORCE)))])
        effect[: len(x)] = np.column_stack([model.derivative(x, u, forces=still + unit) - f for unit in units.T])
        return np.asarray(self._period_s / 2.0 * (effect + A @ effect))

    def correct(self, belief: Belief, model: Model, sensed: Sequence[tuple[int, tuple[int, ...], Array]]) -> Belief:
        """Return the belief with measurements of its tick; those of released UAVs are ignored.

        They are given as UAV, 0-based, sensors of it, and measurements of all its sensors, SI, in the layout of
        `model.state`, (15,); what stands behind these is ignored. Source: docs/equations.md (64).
        """
        sensed = [entry for entry in sensed if entry[0] not in model.released]
        if not sensed:
            return belief
        n = model.system.n
        of, within, part, angles = _places(tuple((uav, sensors) for uav, sensors, _ in sensed))
        z = np.array([values for _, _, values in sensed])[part, of]
        actual, known = belief.x[n:] if self._inputs else belief.u, self.forces(belief)
        own, slow, level = belief.own, belief.slow, belief.level
        is_own = [uav for uav, _, _ in sensed] == self._owned and len(of) == state.SENSED * len(sensed)
        error = z - model.sensed(belief.x[:n], actual, forces=known)[within]
        error[angles] -= 2.0 * np.pi * np.round(error[angles] / (2.0 * np.pi))
        R = self._R[of]

        def observed() -> Array:
            T, slopes = belief.covariance.T, model.sense(belief.x[:n], actual, forces=known)[1]
            H = np.empty((len(z), T.shape[1] + len(belief.forces)))
            H[:, : T.shape[1]] = slopes[within, :n] @ T[:n]
            if known is not None:
                H[:, T.shape[1] :] = slopes[within, n:] @ self._effects(model, belief.x[:n], actual, known)
            return H

        if is_own and own is not None and own[1] <= _SAME_GAIN:
            gain = own[0]
            step = gain @ error

            def later() -> Covariance:
                before, H = belief.covariance, observed()
                G = np.vstack([before.L.T @ gain[: len(belief.x)], gain[len(belief.x) :]])
                surprise = float(error @ np.linalg.solve(H @ before.P @ H.T + np.diag(R), error)), len(error)
                return self._joseph(before, G, H, R, surprise)

            found: Covariance | Callable[[], Covariance] = later
        else:
            before, H = belief.covariance, observed()
            H_P = H @ before.P
            S = H_P @ H.T
            S[np.diag_indices_from(S)] += R
            solved = np.linalg.solve(S, np.column_stack([H_P, error]))
            G, s = np.asarray(solved[:, :-1].T, dtype=np.float64), before.T.shape[1]
            xi = G @ error
            step = np.concatenate([before.T @ xi[:s], xi[s:]])
            slow, level = self._leveled(belief, within, error, S.diagonal(), R)
            found = self._joseph(before, G, H, R, (float(error @ solved[:, -1]), len(error)))
            rows = np.flatnonzero(self._is_own[within])
            if len(rows) == state.SENSED * len(self._owned) > 0:
                of_own = np.linalg.solve(S[rows[:, None], rows], H_P[rows]).T
                own = np.vstack([before.T @ of_own[:s], of_own[s:]]), 0
        x, forces = self.moved(belief.x, step[: len(belief.x)]), belief.forces + step[len(belief.x) :]
        return replace(belief, x=x, forces=forces, found=found, slow=slow, level=level, own=own)

    def _leveled(
        self, belief: Belief, within: npt.NDArray[np.intp], error: Array, variance: Array, R: Array
    ) -> tuple[Array, float]:
        """Return slow part and level after innovations of some measurements. Source: docs/equations.md (63b)."""
        of, slow, kept = self._level, belief.slow.copy(), math.exp(-self._period_s / _SLOW_S)
        slow[within] = kept * slow[within] + error * np.sqrt((1.0 - kept**2) / variance)
        weights = 1.0 - R / variance if of.predicted else np.ones(len(R))
        excess = float(weights @ (slow[within] ** 2 - of.white) / weights.sum())
        level = belief.level * math.exp(of.rate * min(max(excess, -1.0), _EXCESS))
        return slow, min(max(level, of.least), 1.0)

    @staticmethod
    def _joseph(before: Covariance, G: Array, H: Array, R: Array, surprise: tuple[float, int]) -> Covariance:
        """Return the covariance after a correction with any gain."""
        kept = np.eye(len(before.P)) - G @ H
        P = kept @ before.P @ kept.T + (G * R) @ G.T
        return replace(before, P=(P + P.T) / 2.0, surprise=surprise)

    def moved(self, x: Array, dx: Array) -> Array:
        """Return a state, (n,), SI, moved along the manifold by dx, (n,), with |e_i| = 1. Source: equations.md (62)."""
        x = x + dx
        e, Omega = _rods(x, self._N)
        e /= np.sqrt(np.einsum("ij,ij->i", e, e))[:, None]
        Omega -= e * np.einsum("ij,ij->i", e, Omega)[:, None]
        x.setflags(write=False)
        return x

    def certain(self, belief: Belief, entries: npt.NDArray[np.intp], deviation: float = 1e-3) -> Belief:
        """Return the belief with some entries of the state known, such as those that a failure sets."""
        covariance = belief.covariance
        known = np.flatnonzero(covariance.T[entries].any(axis=0))
        P = covariance.P.copy()
        P[known], P[:, known] = 0.0, 0.0
        P[known, known] = deviation**2
        return replace(belief, found=replace(covariance, P=P))
