"""The decision of one controller and all rows of its QP, row_lower <= A z <= row_upper; z: decision, then slacks."""

import math
from collections.abc import Sequence
from itertools import combinations, product

import casadi as ca
import numpy as np
import numpy.typing as npt

from model import state
from model.arrays import Array
from model.dynamics import Symbols, motion
from model.obstacles import Obstacle
from model.parameters import System, payload_half_size
from model.rotations import euler_rates, rotation
from mpc.expressions import Expressions, compile_constraints
from mpc.prediction import Linear, Prediction, stacked
from mpc.settings import ControllerSettings
from mpc.shared_rows import default_penalty, share


class Decision:
    """Positions, limits and scale of the owned inputs; owned UAVs are 0-based, ascending."""

    def __init__(self, system: System, settings: ControllerSettings, owned: Sequence[int]) -> None:
        self.system, self.settings, self.uavs = system, settings, tuple(owned)
        self.own = state.input_indices(self.uavs)  # positions in u, (m_own,)
        self.others = np.setdiff1d(np.arange(system.m), self.own)  # those of all other inputs, (m - m_own,)
        self.shape = settings.horizon, len(self.own)
        self.size = settings.horizon * len(self.own)
        self.lower, self.upper = settings.lower(len(self.uavs)), settings.upper(len(self.uavs))  # bounds, (m_own,)
        self.rate = settings.step(len(self.uavs))  # largest change over one sampling period, (m_own,)
        # Half the range, (m_own,): unit of the decision in the QP, so that newtons and newton metres weigh alike.
        self.scale = (self.upper - self.lower) / 2.0

    def clip(self, inputs: Array) -> Array:
        """Return owned inputs within their bounds, (..., m_own)."""
        return np.minimum(np.maximum(inputs, self.lower), self.upper)

    def inputs(self, z: Array) -> Array:
        """Return the decision in SI units, (N_p, m_own), from the QP's variables: scaled inputs, then slacks."""
        return np.asarray(z[: self.size].reshape(self.shape) * self.scale)

    def bounds(self, U_free: Array, u0: Array) -> tuple[Array, Array]:
        """Return bounds on the scaled decision about U_free, (N_p m_own,) each, with the first rate limit."""
        lower, upper = self.lower - U_free, self.upper - U_free
        first = u0[self.own] - U_free[0]  # inputs outside their bounds return at once: rates are a preference
        lower[0] = np.minimum(np.maximum(lower[0], first - self.rate), upper[0])
        upper[0] = np.maximum(np.minimum(upper[0], first + self.rate), lower[0])
        return (lower / self.scale).reshape(-1), (upper / self.scale).reshape(-1)


class Rows:
    """Rows of all constraints, (28)-(30b); slacks: separations, tilts, each soft constraint of the user, tensions."""

    def __init__(self, decision: Decision) -> None:
        self._decision, system, settings, (steps, _) = decision, decision.system, decision.settings, decision.shape
        size, separation, tilt, tension = decision.size, settings.separation, settings.tilt, settings.tension
        self.minimum_m = separation.minimum_m if separation else 0.0  # smallest distance of these pairs
        every = combinations(range(system.N), 2) if separation else ()
        # Pairs of UAVs, 0-based, with an owned one, (pairs, 2); the others' agents keep the rest.
        pairs = [pair for pair in every if not set(pair).isdisjoint(decision.uavs)]
        self.pairs = np.array(pairs, dtype=np.intp).reshape(-1, 2)
        self.limit = math.radians(tilt.limit_deg) if tilt else 0.0  # largest angle, rad
        starts = [state.uav_slice(uav).start + state.THETA.start for uav in decision.uavs if tilt]
        # Positions in x of the limited roll and pitch angles.
        self.angles = np.array([start + axis for start in starts for axis in (0, 1)], dtype=np.intp)
        penalty = default_penalty(settings.weights, system.N)
        self._on_state, self._on_input = compile_constraints(settings.constraint, system, penalty)
        self._kept = self._on_input.depends[:, decision.own].any(axis=1)
        self._share = share(self._on_input.depends, decision.own)
        self.are_shared = bool((self._share[self._kept] > 1.0).any())  # whether other agents keep rows of inputs too
        symbols, margins = Symbols.of(system.N, system.commands_rates), list[ca.SX]()
        if tension:  # minimum_N less the rod tensions of the owned UAVs: (30b)
            pulls = ca.substitute(motion(symbols).tensions, symbols.F, ca.SX.zeros(symbols.F.numel()))
            margins = [tension.minimum_N - pulls[uav] for uav in decision.uavs]
        # Of states and inputs, positive where a tension is too small.
        self.on_tensions = Expressions(margins, ca.vertcat(symbols.x, symbols.u), symbols.p, system.vector())
        soft = np.flatnonzero(~np.isnan(self._on_state.penalty))
        own_slacks = [separation.penalty] * min(1, len(self.pairs)) if separation else []
        own_slacks += [tilt.penalty] if tilt else []
        on_tension = [tension.penalty] if tension else []
        self.penalties = np.concatenate([own_slacks, self._on_state.penalty[soft], on_tension])  # of all slacks
        each, half, columns = len(self._on_state), steps * len(self.angles), size + len(own_slacks)
        user = [steps * each, steps * int(self._kept.sum()), steps * len(self.on_tensions)]
        ends = np.cumsum([size - len(decision.own), steps * len(self.pairs), half, half, *user]).tolist()
        parts = list(map(slice, [0, *ends[:-1]], ends))
        rate, self._apart, self._up, self._down, self._states, self._inputs, self._tensions = parts
        # Constant entries, zero where a step's are written, and bounds, infinite there.
        self.A = np.zeros((ends[-1], size + len(self.penalties)))
        self.lower, self.upper = np.full(len(self.A), -np.inf), np.full(len(self.A), np.inf)
        differences = np.eye(rate.stop, size, len(decision.own)) - np.eye(rate.stop, size)  # of decisions: (28a)
        self.A[rate, :size] = differences * np.tile(decision.scale, steps)
        self.upper[rate] = np.tile(decision.rate, steps - 1)
        self.lower[rate] = -self.upper[rate]
        self.A[self._apart, size : size + 1] = 1.0
        self.A[self._up, columns - 1], self.A[self._down, columns - 1] = -1.0, 1.0
        for column, constraint in enumerate(soft, start=columns):
            self.A[self._states.start + constraint : self._states.stop : each, column] = -1.0
        self.A[self._tensions, -1:] = -1.0

    def fill(self, linear: Linear, prediction: Prediction, free: Array, effect: Array) -> tuple[Array, Array, Array]:
        """Return A, lower, upper of one step by outputs, (N_p, outputs), and effects on them: the UAVs' are first."""
        A, lower, upper = self.A.copy(), self.lower.copy(), self.upper.copy()
        size, N = self._decision.size, self._decision.system.N
        _, direction = separation_rows(linear.model.y[: 3 * N], self.pairs)
        A[self._apart, :size] = stacked(np.tensordot(direction, effect[: 3 * N], 1))
        lower[self._apart] = self.minimum_m - (free[:, : 3 * N] @ direction.T).reshape(-1)
        angles = (linear.x0[self.angles] + prediction.dX_free[1:, self.angles]).reshape(-1)
        A[self._up, :size] = A[self._down, :size] = stacked(prediction.effect[self.angles] * self._decision.scale)
        upper[self._up], lower[self._down] = self.limit - angles, -self.limit - angles
        self.fill_user(linear, prediction, A, lower, upper)
        return A, lower, upper

    def fill_user(self, linear: Linear, prediction: Prediction, A: Array, lower: Array, upper: Array) -> None:
        """Write the rows of the user's constraints and of rod tensions."""
        size, own, u0, scale = self._decision.size, self._decision.own, linear.u0, self._decision.scale
        if len(self._on_state):
            value, slope = self._on_state.at(linear.x0)
            n = slope.shape[1]  # motors, which may be further states, are not in the expressions
            effect = (slope @ prediction.effect[:n].reshape(n, -1)).reshape(-1, *self._decision.shape)
            A[self._states, :size] = stacked(effect * scale)
            values = value + prediction.dX_free[1:, :n] @ slope.T
            lower[self._states] = np.where(self._on_state.equality, -values, -np.inf).reshape(-1)
            upper[self._states] = -values.reshape(-1)
        if self._kept.any():
            value, slope = (part[self._kept] for part in self._on_input.at(u0))
            effect = slope[:, own] * scale * self._share[self._kept, None]
            A[self._inputs, :size] = np.kron(np.eye(self._decision.settings.horizon), effect)
            values = value + (prediction.U_all - u0) @ slope.T
            lower[self._inputs] = np.where(self._on_input.equality[self._kept], -values, -np.inf).reshape(-1)
            upper[self._inputs] = -values.reshape(-1)
        if len(self.on_tensions):
            n = len(linear.x0)
            value, slope = self.on_tensions.at(np.concatenate([linear.x0, u0]))
            by_state, by_input = slope[:, :n], slope[:, n:].copy()
            at_once = by_input[:, own]
            by_input[:, own] = 0.0  # inputs of the others, which respond to the state
            later = np.tensordot(by_state, prediction.effect, 1)
            if len(prediction.feedback):
                later += np.tensordot(by_input, prediction.feedback, 1)
            effect = np.concatenate([at_once[:, None], later[:, :-1]], axis=1)
            A[self._tensions, :size] = stacked(effect * scale)
            values = value + prediction.dX_free[:-1] @ by_state.T + (prediction.U_all - u0) @ slope[:, n:].T
            upper[self._tensions] = -values.reshape(-1)


class Clearance:
    """Distances of owned UAVs and of the payload's corners from obstacles; a rod lies between them: (74a)."""

    def __init__(self, decision: Decision, obstacles: Sequence[Obstacle]) -> None:
        self._obstacles, self._own = obstacles, list(decision.uavs)
        self._corners = np.array(list(product((-1.0, 1.0), repeat=3))) * payload_half_size(decision.system)
        margins = [[obstacle.margin_m] * len(self._own) + [obstacle.load_margin_m] * 8 for obstacle in obstacles]
        self._margins = np.array(margins).reshape(len(obstacles), -1)
        self.penalties = np.array([obstacle.penalty for obstacle in obstacles])  # weight of the slack of each

    def excess(self, Z: Array, places: Array) -> tuple[Array, Array]:
        """Return distances beyond the margins, (obstacles, k, points), m, and gradients, at states and UAV places."""
        R = np.array([rotation(Theta) for Theta in Z[:, state.THETA0]])
        corners = Z[:, None, state.R0] + np.einsum("kij,cj->kci", R, self._corners)
        points = np.concatenate([places[:, self._own], corners], axis=1)
        distances, normals = zip(*(obstacle.from_points(points) for obstacle in self._obstacles), strict=True)
        return np.array(distances) - self._margins[:, None], np.array(normals)

    def rows(self, x: Array, normals: Array, effect: Array, on_places: Array) -> Array:
        """Return the effect on the distances at one state, (obstacles, points, size), by that on state and places."""
        R, omegas = rotation(x[state.THETA0]), np.linalg.inv(euler_rates(x[state.THETA0])).T
        turned = np.array([np.cross(omega, self._corners) @ R.T for omega in omegas])
        # All agents correct the payload's distance: each its share of what they do together.
        on_corners = effect[state.R0] + np.einsum("aci,as->cis", turned, effect[state.THETA0])
        on_corners *= len(on_places) // 3 / len(self._own)
        on_points = np.concatenate([on_places.reshape(-1, 3, effect.shape[1])[self._own], on_corners])
        return np.asarray(np.einsum("opi,pis->ops", normals, on_points))


def separation_rows(positions: Array, pairs: npt.NDArray[np.intp]) -> tuple[Array, Array]:
    """Return pairwise distances, m, and rows with distance = row . positions, (pairs, 3 N), along the present: (29)."""
    r = positions.reshape(-1, 3)
    apart = r[pairs[:, 0]] - r[pairs[:, 1]]
    distances = np.sqrt((apart * apart).sum(axis=1))
    # Two UAVs in one point have no direction; any direction separates them.
    together = distances == 0.0
    d = apart / np.where(together, 1.0, distances)[:, None]
    d[together] = [1.0, 0.0, 0.0]
    rows, each = np.zeros((len(pairs), len(r), 3)), np.arange(len(pairs))
    rows[each, pairs[:, 0]], rows[each, pairs[:, 1]] = d, -d
    return distances, rows.reshape(len(pairs), len(positions))
