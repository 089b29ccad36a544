"""Growth of the error of an estimate over a sampling period: transition and noise of the filter, (63)-(63e).

The other agents act by the shared control law from their own estimates. Where an input of theirs is
not told, the error of the estimate acts on it through the gain of that law, and so do the errors of
their own estimates.
"""

from dataclasses import dataclass

import numpy as np

from transport.agent.communication.unannounced_inputs import Silent
from transport.agent.estimation.filter import kalman
from transport.agent.estimation.filter.assumed_noise import ForceNoise, ModelNoise
from transport.agent.estimation.filter.belief import Belief, Covariance
from transport.agent.estimation.filter.filter_interface import FilterPeriod
from transport.agent.estimation.filter.manifold import Manifold
from transport.agent.estimation.filter.silent_agents import SilentTeam
from transport.agent.estimation.filter.unknown_forces import COUNT, Situation, UnknownForces
from transport.model.arrays import Array
from transport.model.linear import motor_lag as motors
from transport.model.linear.discretisation import Discrete, zero_order_hold
from transport.model.linear.linearisation import Model
from transport.protocol.scenario.setup.team_run import TeamRun


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearPeriod:
    """A sampling period linearised about a belief at its beginning."""

    belief: Belief
    period: FilterPeriod
    place: Situation  # of the linearisation
    discrete: Discrete  # of the state, with motor lag [x, a]
    L: Array  # from deviations at its end to coordinates, transposed, (n, s)

    @property
    def B_xi(self) -> Array:
        """Effect of the inputs on the coordinates at the end, (s, m)."""
        return np.asarray(self.L.T @ self.discrete.B)


class ErrorGrowth:
    """Growth of errors over sampling periods.

    Coordinates of an error are those of the state, of the actual inputs with motor lag, and of unknown
    forces if `unknown_forces` estimates them.

    Attributes:
        lagging: Number of coordinates of actual inputs.
        Q: Covariance of the model's errors per period that the level scales, at level 1.
    """

    def __init__(
        self,
        setup: TeamRun,
        noise: ModelNoise,
        manifold: Manifold,
        unknown_forces: UnknownForces | None,
    ) -> None:
        self._system = setup.system
        self._period_s = setup.settings.sampling_period_s
        self._lag_s = setup.settings.motor_lag_s
        self._noise = noise
        self._manifold = manifold
        self._unknown_forces = unknown_forces
        self._silent = SilentTeam(setup)
        self.lagging = setup.system.m if self._lag_s > 0.0 else 0
        self._force_coordinates = 0 if unknown_forces is None else COUNT
        self._set_process_noise()

    def _set_process_noise(self) -> None:
        """Set the covariance of the model's errors: the part that the level scales, the rest."""
        noise = self._noise
        others = np.zeros(self.lagging + self._force_coordinates)

        def diagonal(deviation: float) -> Array:
            variances = noise.acceleration_variances(deviation, self._period_s, self._system.N)
            return np.diag(np.concatenate([variances, others]))

        if not self._force_coordinates:
            self.Q = diagonal(noise.acceleration_alone)
            self._Q_beside = np.zeros_like(self.Q)
            self._kept_alone = np.ones(0)
            return

        self._Q_beside = diagonal(noise.acceleration_beside_forces)
        self.Q = np.zeros_like(self._Q_beside)
        self.Q[-self._force_coordinates :, -self._force_coordinates :] = ForceNoise().change(
            self._system, self._period_s
        )
        # Share of a variance that is left after a period without any information: (63d).
        #   1 - q / p_0
        change = self.Q.diagonal()[-self._force_coordinates :]
        first = ForceNoise().first(self._system) ** 2
        self._kept_alone = 1.0 - change / first

    def process_noise(self, level: float) -> Array:
        """Return the covariance of the model's errors per period at a level of them."""
        return level * self.Q + self._Q_beside

    def kept_forces(self, period: FilterPeriod) -> Array:
        """Return the share of forces that is left after a period without information, (7,) or (0,).

        As random walks, forces that own sensors do not tell apart have no bound. With information about all
        others they are such walks; without any they return to zero, and their variance to that
        before the first measurement. Source: docs/equations.md (63d).
        """
        return np.asarray(self._kept_alone ** (0.5 * period.alone))

    def situation(self, belief: Belief, model: Model, u: Array, forces: Array | None) -> Situation:
        """Return the situation that a belief describes under inputs u, or lagging actual inputs."""
        n = model.system.n
        actual = belief.x[n:] if self.lagging else u
        return Situation(model=model, x=belief.x[:n], actual=actual, forces=forces)

    def after(self, belief: Belief, period: FilterPeriod) -> Covariance:
        """Return the covariance at the end of a sampling period. Source: docs/equations.md (63)."""
        basis = self._manifold.basis(period.end)
        place = self.situation(belief, period.model, period.u, period.forces)
        linear = LinearPeriod(
            belief=belief,
            period=period,
            place=place,
            discrete=self._discrete(place, period.u),
            L=basis.L,
        )
        P = kalman.predict(
            belief.covariance.P, self._transition(linear), self._period_noise(linear)
        )
        return Covariance(P=P, basis=basis)

    def _discrete(self, place: Situation, u: Array) -> Discrete:
        """Return the discrete linearisation about a place, (16), with motor lag (55)."""
        model = place.model
        linear = model.linearise(place.x, place.actual, forces=place.forces)
        if self.lagging:
            is_rates = model.system.commands_rates
            linear = motors.with_lag(linear, place.actual, u, self._lag_s, is_rates)
        return zero_order_hold(linear, self._period_s, remainder=self._noise.remainder)

    def _transition(self, linear: LinearPeriod) -> Array:
        """Return the transition of all error coordinates over a period, A_xi of (63), (r, r)."""
        period = linear.period
        discrete = linear.discrete
        unannounced = period.unannounced
        T = linear.belief.covariance.basis.T
        by_forces = np.zeros((len(T), 0))
        if self._unknown_forces is not None:
            by_forces = self._unknown_forces.over_a_period(linear.place, discrete.A, self._period_s)

        # The others answer to their own estimates: the part c of their errors is the own one, and
        # cancels. A fail-safe answers to the actual state.
        #   dx(k+1) = (A + (1 - c) B_o K_o) T xi
        ahead = discrete.A @ T
        if period.silent is not None and period.K is not None:
            ahead = ahead + discrete.B @ (self._silent.gain(period.silent, period) @ T)
        elif period.K is not None:
            closed = unannounced.by_law | unannounced.by_fail_safe
            answered = np.where(unannounced.by_law, 1.0 - period.correlation, 1.0)
            ahead = ahead + (discrete.B * answered)[:, closed] @ (period.K[closed] @ T)

        s = T.shape[1]
        A = np.eye(s + self._force_coordinates)
        A[:s, :s] = linear.L.T @ ahead
        A[:s, s:] = linear.L.T @ by_forces
        if period.silent is not None and period.is_alone:
            A[s:, s:] = np.diag(self.kept_forces(period))
        return A

    def _by_integrals(self, linear: LinearPeriod, silent: Silent) -> Array:
        """Return the effect of the integrals of UAVs alone on the state over a period, (n, 2).

        Source: docs/equations.md (63e).
        """
        x = linear.place.x
        A = linear.discrete.A
        deviations = self._silent.integral_deviations(silent, linear.period.unannounced)
        along_x, along_y = deviations.T
        inputs = [np.zeros_like(along_x), along_x, along_y]
        f, *by_axis = linear.place.model.derivatives(x, linear.place.actual, inputs)
        E = np.zeros((len(A), 2))
        E[: len(x)] = (by_axis - f).T
        #   integral of exp(A_c t) E  =  T_s / 2 (E + A E) + O(T_s^3)
        return np.asarray(self._period_s / 2.0 * (E + A @ E))

    def _period_noise(self, linear: LinearPeriod) -> Array:
        """Return the covariance of all that errs in a period, (r, r): the last terms of (63), (63c)."""
        period = linear.period
        s = linear.L.shape[1]
        Q = self.process_noise(_level(linear))
        Q[:s, :s] += self._noise_of_late_motors(linear)
        if period.K is None:
            return Q

        if period.silent is None:
            Q[:s, :s] += _noise_of_others(linear, period.K)
            return Q
        T = linear.belief.covariance.basis.T
        P = linear.belief.covariance.P[:s, :s]
        Q[:s, :s] += self._silent.noise(period.silent, period, linear.B_xi, T, P)
        if period.is_alone and self._silent.has_integrals:
            integrals = linear.L.T @ self._by_integrals(linear, period.silent)
            Q[:s, :s] += integrals @ integrals.T
        return Q

    def _noise_of_late_motors(self, linear: LinearPeriod) -> Array:
        """Return the covariance of inputs that act late by the unknown lag of the motors, (s, s)."""
        #   B_xi diag(lag / T_s du)^2 B_xi'
        share = self._noise.unknown_lag_s / self._period_s
        late = linear.B_xi * (share * (linear.period.u - linear.belief.u))
        return np.asarray(late @ late.T)


def _level(linear: LinearPeriod) -> float:
    """Return the level of the model's errors in a period: that of the innovations (63b), or 1.

    Past innovations do not tell how large the errors are while a UAV follows its fail-safe, since it is
    not known exactly when it took over and at what thrust, (63), or while UAVs act alone, (63c).
    """
    period = linear.period
    is_known_roughly = period.unannounced.by_fail_safe.any() or period.is_alone
    return 1.0 if is_known_roughly else linear.belief.level.value


def _noise_of_others(linear: LinearPeriod, K: Array) -> Array:
    """Return the covariance of the others' inputs by errors that the own one does not share, (s, s).

    That is (63), with one correlation and no agent alone; `SilentTeam.noise` is (63c), with both by
    input, and is equal to this one where no agent is alone.
    """
    by_law = linear.period.unannounced.by_law
    covariance = linear.belief.covariance
    s = linear.L.shape[1]
    P = covariance.P[:s, :s]

    #   (1 - c^2) B_xi K_o T P T' K_o' B_xi'
    B_xi = linear.L.T @ linear.discrete.B[:, by_law]
    K_T = K[by_law] @ covariance.basis.T
    unshared = 1.0 - linear.period.correlation**2
    return np.asarray(unshared * B_xi @ (K_T @ P @ K_T.T) @ B_xi.T)
