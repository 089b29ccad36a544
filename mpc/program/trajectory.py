"""Trajectories that a decision changes: the form in which constraints see a prediction.

A signal s(k) of the team, such as a distance or a tension, is affine in the scaled decision z:

    s(k) = s_0(k) + sum_j S(k, j) z(j)

Two kinds: time-invariant about the present state, where S(k, j) depends on k - j alone, and
time-varying along a reference.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import msgspec
import numpy as np
import numpy.typing as npt

from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.mpc.program.decision import Decision
from transport.mpc.program.feedback_law import FeedbackLaw, Gains
from transport.mpc.program.prediction import Linear, Prediction, stacked

# Value, (s,), and slope, (s, length of the point), of some functions at a point.
Expansion = Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True, kw_only=True)
class Signals:
    """Signals over the horizon, affine in the scaled decision."""

    values: Array  # without a decision, (steps, s)
    by_decision: Callable[[], Array]  # computes `effect`, for which there is not always a need

    @cached_property
    def effect(self) -> Array:
        """Effect of the scaled decision, (steps s, size): the signals of the first step first."""
        return self.by_decision()


class Trajectory(Protocol):
    """States and inputs over the horizon, and signals of them.

    States at step 0 are given, so signals of states are those at steps 1..N_p; signals of inputs,
    and of both, are those at steps 0..N_p - 1.
    """

    @property
    def decision(self) -> Decision:
        """The decision that changes the trajectory."""

    def own_inputs(self) -> Signals:
        """Return the owned inputs, s = m_own."""

    def states(self, places: npt.NDArray[np.intp]) -> Signals:
        """Return some entries of the state."""

    def of_states(self, expand: Expansion) -> Signals:
        """Return functions of the state, expanded in x, (n,), without actual inputs."""

    def of_positions(self, expand: Expansion) -> Signals:
        """Return functions of the UAVs' positions, expanded in r = [r_1, .., r_N], m.

        `expand` takes positions of one or of several instants, (..., 3 N).
        """

    def of_inputs(self, expand: Expansion) -> Signals:
        """Return functions of the inputs, expanded in u, (m,); the decision acts through owned ones."""

    def of_states_and_inputs(self, expand: Expansion) -> Signals:
        """Return functions of state and inputs, expanded in [x, u], (n + m,)."""


class Announced(msgspec.Struct, frozen=True, kw_only=True):
    """Inputs by the law with the corrections that all agents have announced, and those corrections."""

    U: Array  # (N_p, m)
    c: Array  # (N_p, m)


class TimeInvariant(msgspec.Struct, frozen=True, kw_only=True, dict=True):
    """Trajectory about the present state x0 and input u0: docs/equations.md (22)-(24), (35).

    All expansions are those at x0, u0; the effect of a decision is an impulse response.
    """

    decision: Decision
    linear: Linear
    # dX_free, (N_p + 1, n), and effect, (n, N_p, m_own), where n counts actual inputs of known motors;
    # U_all, (N_p, m), and feedback, (m, N_p, m_own), of the others to the state.
    prediction: Prediction
    announced: Announced | None = None  # with a law, along its trajectory

    def own_inputs(self) -> Signals:
        """Return the owned inputs: the decision itself."""
        scale = np.tile(self.decision.scale, self.decision.shape[0])
        return Signals(values=self.prediction.U_free, by_decision=lambda: np.diag(scale))

    def states(self, places: npt.NDArray[np.intp]) -> Signals:
        """Return some entries of the state."""
        values = self.linear.x0[places] + self.prediction.dX_free[1:, places]
        return self._signals(values, lambda: self.prediction.effect[places])

    def of_states(self, expand: Expansion) -> Signals:
        """Return functions of the state at x0 + dX."""
        value, slope = expand(self.linear.x0)
        n = slope.shape[1]  # further states, of motors, are in no expression

        def impulse() -> Array:
            effect = self.prediction.effect[:n].reshape(n, -1)
            on_signals: Array = slope @ effect
            return on_signals.reshape(len(slope), *self.decision.shape)

        values = value + self.prediction.dX_free[1:, :n] @ slope.T
        return self._signals(values, impulse)

    def of_positions(self, expand: Expansion) -> Signals:
        """Return functions of the UAVs' positions r0 + C_r dX."""
        positions = 3 * self.decision.system.N
        value, slope = expand(self.linear.model.y[:positions])
        by_state = slope @ self.linear.model.C[:positions]
        values = value + self.prediction.dX_free[1:] @ by_state.T

        def impulse() -> Array:
            on_signals: Array = np.tensordot(by_state, self.prediction.effect, 1)
            return on_signals

        return self._signals(values, impulse)

    def of_inputs(self, expand: Expansion) -> Signals:
        """Return functions of the inputs u0 + dU."""
        value, slope = expand(self.linear.u0)
        at_once = slope[:, self.decision.own] * self.decision.scale
        values = value + (self.prediction.U_all - self.linear.u0) @ slope.T

        def effect() -> Array:
            each_step = np.eye(self.decision.shape[0])
            return np.asarray(np.kron(each_step, at_once), dtype=np.float64)

        return Signals(values=values, by_decision=effect)

    def of_states_and_inputs(self, expand: Expansion) -> Signals:
        """Return functions of state and inputs; the others respond to the state by the law.

        Without motor lag: the constraint that asks for them, `controller.tension`, refuses it.
        """
        linear = self.linear
        prediction = self.prediction
        own = self.decision.own
        n = len(linear.x0)
        value, slope = expand(np.concatenate([linear.x0, linear.u0]))
        by_state = slope[:, :n]
        by_input = slope[:, n:]

        def impulse() -> Array:
            at_once = by_input[:, own]
            by_others = by_input.copy()
            by_others[:, own] = 0.0
            later = np.tensordot(by_state, prediction.effect, 1)
            if len(prediction.feedback):
                later += np.tensordot(by_others, prediction.feedback, 1)
            return np.concatenate([at_once[:, None], later[:, :-1]], axis=1)

        values = (
            value
            + prediction.dX_free[:-1] @ by_state.T
            + (prediction.U_all - linear.u0) @ by_input.T
        )
        return self._signals(values, impulse)

    def _signals(self, values: Array, impulse: Callable[[], Array]) -> Signals:
        """Return signals by their response to a decision in SI units, (s, N_p, m_own)."""
        return Signals(values=values, by_decision=lambda: stacked(impulse() * self.decision.scale))


@dataclass(frozen=True, kw_only=True)
class TimeVarying:
    """Trajectory under the control law along a reference; the decision changes corrections.

    Each step has its own expansion. Source: docs/equations.md (73), (74).
    """

    decision: Decision
    model: Model
    law: FeedbackLaw
    gains: Sequence[Gains]  # the law's difference equation at each step
    Z: Array  # states at steps 0..N_p, (N_p + 1, n)
    U: Array  # inputs at steps 0..N_p - 1, (N_p, m)
    u0: Array  # inputs in force before the first step, (m,)

    @cached_property
    def positions(self) -> Array:
        """Positions of the UAVs at steps 1..N_p, (N_p, 3 N), m."""
        return self.model.outputs_along(self.Z[1:])[:, : 3 * self.model.system.N]

    @cached_property
    def position_slopes(self) -> list[Array]:
        """Derivatives of the positions by the state at steps 1..N_p, (3 N, n) each."""
        positions = 3 * self.model.system.N
        return [self.model.linearise(x, self.u0).C[:positions] for x in self.Z[1:]]

    @cached_property
    def effects(self) -> tuple[list[Array], list[Array]]:
        """Effect of the scaled decision on states at steps 0..N_p, (n, size), and on inputs.

        dx(k+1) = A_closed(k) dx(k) + B_own(k) dc(k),  du(k) = K(k) dx(k) + [dc(k) for owned inputs]
        """
        own = self.decision.own
        scale = self.decision.scale
        steps, m = self.decision.shape
        states = [np.zeros((len(self.Z[0]), self.decision.size))]
        inputs = []

        for k in range(steps):
            columns = slice(m * k, m * (k + 1))
            du = self.law.K[k] @ states[k]
            du[own, columns] += np.diag(scale)
            inputs.append(du)

            dx = self.gains[k].A_closed @ states[k]
            dx[:, columns] += self.gains[k].B[:, own] * scale
            states.append(dx)
        return states, inputs

    def own_inputs(self) -> Signals:
        """Return the owned inputs, by the corrections and by the feedback on what these change."""
        own = self.decision.own
        return Signals(
            values=self.U[:, own],
            by_decision=lambda: self._rows([du[own] for du in self.effects[1]]),
        )

    def states(self, places: npt.NDArray[np.intp]) -> Signals:
        """Return some entries of the state."""
        return Signals(
            values=self.Z[1:, places],
            by_decision=lambda: self._rows([dx[places] for dx in self.effects[0][1:]]),
        )

    def of_states(self, expand: Expansion) -> Signals:
        """Return functions of the state, expanded at each step."""
        values, slopes = _expanded(expand, self.Z[1:])

        def rows() -> Array:
            by_state = zip(slopes, self.effects[0][1:], strict=True)
            return self._rows([slope @ dx for slope, dx in by_state])

        return Signals(values=values, by_decision=rows)

    def of_positions(self, expand: Expansion) -> Signals:
        """Return functions of the UAVs' positions, expanded at each step."""
        values, slopes = expand(self.positions)

        def rows() -> Array:
            by_state = zip(slopes, self.position_slopes, self.effects[0][1:], strict=True)
            return self._rows([slope @ C @ dx for slope, C, dx in by_state])

        return Signals(values=values, by_decision=rows)

    def of_inputs(self, expand: Expansion) -> Signals:
        """Return functions of the inputs, expanded at each step."""
        values, slopes = _expanded(expand, self.U)
        own = self.decision.own

        def rows() -> Array:
            by_input = zip(slopes, self.effects[1], strict=True)
            return self._rows([slope[:, own] @ du[own] for slope, du in by_input])

        return Signals(values=values, by_decision=rows)

    def of_states_and_inputs(self, expand: Expansion) -> Signals:
        """Return functions of state and inputs, expanded at each step."""
        values, slopes = _expanded(expand, np.hstack([self.Z[:-1], self.U]))

        def rows() -> Array:
            states, inputs = self.effects
            changes = zip(slopes, states[:-1], inputs, strict=True)
            return self._rows([slope @ np.vstack([dx, du]) for slope, dx, du in changes])

        return Signals(values=values, by_decision=rows)

    def _rows(self, by_step: list[Array]) -> Array:
        """Return effects at each step, (s, size), one below the other."""
        return np.array(by_step).reshape(-1, self.decision.size)


def _expanded(expand: Expansion, points: Array) -> tuple[Array, list[Array]]:
    """Return values, (steps, s), and slopes of an expansion at the points of all steps."""
    values = []
    slopes = []
    for point in points:
        value, slope = expand(point)
        values.append(value)
        slopes.append(slope)
    return np.array(values), slopes
