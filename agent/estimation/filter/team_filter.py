"""Error-state Kalman filter over the whole team, from the measurements of the UAVs' own sensors.

No sensor sees the payload or the rods: they follow from where all UAVs are and how they move. The
error of an estimate lives on the manifold of states, in 12 + 10 N coordinates about the estimate.

The other agents act by the shared control law from their own estimates. Where an input of theirs is
not told, the error of the estimate acts on it through the gain of that law, and so do the errors of
their own estimates.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from transport.agent.communication.unannounced_inputs import Silent
from transport.agent.estimation.filter import kalman
from transport.agent.estimation.filter.assumed_noise import (
    FirstErrors,
    ForceNoise,
    LeastSensorNoise,
    ModelNoise,
)
from transport.agent.estimation.filter.belief import Belief, Covariance, Postponed, SavedGain
from transport.agent.estimation.filter.filter_interface import FilterPeriod, Sensed
from transport.agent.estimation.filter.innovations import (
    Innovation,
    deny_the_estimate,
    innovation_of,
    observation_of,
)
from transport.agent.estimation.filter.kalman import Correction, Observation
from transport.agent.estimation.filter.manifold import Manifold
from transport.agent.estimation.filter.model_error_level import (
    EXACT,
    WIND,
    Level,
    LevelRule,
    followed,
)
from transport.agent.estimation.filter.silent_agents import SilentTeam
from transport.agent.estimation.filter.unknown_forces import COUNT, Situation, UnknownForces
from transport.model import state
from transport.model.arrays import Array
from transport.model.linear import motor_lag as motors
from transport.model.linear.discretisation import Discrete, zero_order_hold
from transport.model.linear.linearisation import Model
from transport.protocol.scenario.setup.team_run import TeamRun

# Roll and pitch beyond which an estimate is that of no team in flight, rad: Euler angles become
# singular. A variance that no measurement of a UAV's own sensors leaves, SI.
_STEEPEST = 1.4
_LARGEST_VARIANCE = 1e4
_CERTAIN = 1e-3  # standard deviation of an entry that a failure sets, SI


class TeamFilter:
    """The filter as in a textbook: `predict` (63) and `correct` (64).

    Attributes:
        N: Number of UAVs.
        manifold: Coordinates of errors.
        Q: Covariance of the model's errors per period that the level scales, at level 1, in the
            coordinates of a belief.
    """

    def __init__(self, setup: TeamRun, noise: ModelNoise | None = None) -> None:
        system = setup.system
        self.N = system.N
        is_estimating = setup.settings.disturbance.estimate
        self._system = system
        self._u_hover = setup.hover.u
        self._period_s = setup.settings.sampling_period_s
        self._lag_s = setup.settings.motor_lag_s
        self._noise = ModelNoise() if noise is None else noise
        self._R = LeastSensorNoise().variances(setup.sensors)

        # Coordinates: of the state, of the actual inputs with motor lag, of unknown forces.
        self._lagging = system.m if self._lag_s > 0.0 else 0
        self._force_coordinates = COUNT if is_estimating else 0
        self._unknown_forces = UnknownForces(setup.model) if is_estimating else None
        self._rule: LevelRule = WIND if is_estimating else EXACT
        self.manifold = Manifold(self.N, self._lagging)

        self._silent = SilentTeam(setup)
        self._P0 = self._first_covariance()
        self._set_process_noise()

    def _first_covariance(self) -> Array:
        """Return the covariance before any measurement."""
        deviations = [FirstErrors().by_coordinate(self.N), np.zeros(self._lagging)]
        if self._force_coordinates:
            deviations.append(ForceNoise().first(self._system))
        return np.diag(np.concatenate(deviations) ** 2)

    def _set_process_noise(self) -> None:
        """Set the covariance of the model's errors: the part that the level scales, the rest."""
        noise = self._noise
        others = np.zeros(self._lagging + self._force_coordinates)

        def diagonal(deviation: float) -> Array:
            variances = noise.acceleration_variances(deviation, self._period_s, self.N)
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
        first = self._P0.diagonal()[-self._force_coordinates :]
        self._kept_alone = 1.0 - change / first

    def first(self, x: Array) -> Belief:
        """Return the belief without any measurement, about a state: the start, and a new start."""
        covariance = Covariance(P=self._P0, basis=self.manifold.basis(x))
        slow = np.zeros(state.SENSED * self.N)
        return Belief(
            x=x,
            unknowns=np.zeros(self._force_coordinates),
            u=self._u_hover,
            level=Level(value=self._rule.first, slow=slow),
            source=covariance,
        )

    def forces(self, belief: Belief) -> Array | None:
        """Return the estimated forces and mass error as `Model` takes them, (4 + 3 N,).

        None where they are not estimated.
        """
        if self._unknown_forces is None:
            return None
        return self._unknown_forces.on_bodies(belief.x, belief.unknowns)

    def process_noise(self, level: float) -> Array:
        """Return the covariance of the model's errors per period at a level of them."""
        return level * self.Q + self._Q_beside

    def predict(self, belief: Belief, period: FilterPeriod) -> Belief:
        """Return the belief at the end of a sampling period.

        Source: docs/equations.md (63).
        """
        covariance = self.predicted_covariance(belief, period)
        unknowns = self.unknowns_ahead(belief, period)
        return replace(belief, x=period.end, unknowns=unknowns, u=period.u, source=covariance)

    def unknowns_ahead(self, belief: Belief, period: FilterPeriod) -> Array:
        """Return the unknown forces at the end of a period: as before, or nearer to zero, (63d)."""
        if not period.is_alone:
            return belief.unknowns
        return self.kept_forces(period) * belief.unknowns

    def kept_forces(self, period: FilterPeriod) -> Array:
        """Return the share of forces that is left after a period without information, (7,) or (0,).

        As random walks, forces that own sensors do not tell apart have no bound. With information about all
        others they are such walks; without any they return to zero, and their variance to that
        before the first measurement. Source: docs/equations.md (63d).
        """
        return np.asarray(self._kept_alone ** (0.5 * period.alone))

    def is_plausible(self, belief: Belief) -> bool:
        """Return whether a belief can be that of a team in flight.

        Its numbers are in range, no body is over, and its measurements do not deny it.
        """
        view = state.StateView(belief.x[: self._system.n])
        tilts = np.concatenate([view.Theta0[:2], view.Theta[:, :2].reshape(-1)])
        in_range = np.abs(belief.x).max() < state.LARGEST and np.isfinite(belief.unknowns).all()
        if not in_range or np.abs(tilts).max() > _STEEPEST:
            return False
        source = belief.source
        if not isinstance(source, Covariance):
            return True
        is_denied = deny_the_estimate(source.squared_error, source.measurements)
        return bool(source.P.diagonal().max() < _LARGEST_VARIANCE) and not is_denied

    def predicted_covariance(self, belief: Belief, period: FilterPeriod) -> Covariance:
        """Return the covariance at the end of a sampling period. Source: docs/equations.md (63)."""
        after = self.manifold.basis(period.end)
        place = self._situation(belief, period.model, period.u, period.forces)
        discrete = self._discrete(place, period.u)

        A = self._transition(belief, period, place, discrete, after.L)
        Q = self._period_noise(belief, period, place, discrete, after.L)
        P = kalman.predict(belief.covariance.P, A, Q)
        return Covariance(P=P, basis=after)

    def _situation(self, belief: Belief, model: Model, u: Array, forces: Array | None) -> Situation:
        """Return the place that a belief describes under inputs u, or lagging actual inputs."""
        n = model.system.n
        actual = belief.x[n:] if self._lagging else u
        return Situation(model=model, x=belief.x[:n], actual=actual, forces=forces)

    def _discrete(self, place: Situation, u: Array) -> Discrete:
        """Return the discrete linearisation about a place, (16), with motor lag (55)."""
        model = place.model
        linear = model.linearise(place.x, place.actual, forces=place.forces)
        if self._lagging:
            is_rates = model.system.commands_rates
            linear = motors.with_lag(linear, place.actual, u, self._lag_s, is_rates)
        return zero_order_hold(linear, self._period_s, remainder=self._noise.remainder)

    def _transition(
        self, belief: Belief, period: FilterPeriod, place: Situation, discrete: Discrete, L: Array
    ) -> Array:
        """Return the transition of all error coordinates over a period, A_xi of (63), (r, r)."""
        T = belief.covariance.basis.T
        unannounced = period.unannounced
        by_forces = np.zeros((len(T), 0))
        if self._unknown_forces is not None:
            by_forces = self._unknown_forces.over_a_period(place, discrete.A, self._period_s)

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
        A[:s, :s] = L.T @ ahead
        A[:s, s:] = L.T @ by_forces
        if period.silent is not None and period.is_alone:
            A[s:, s:] = np.diag(self.kept_forces(period))
        return A

    def _by_integrals(
        self, silent: Silent, period: FilterPeriod, place: Situation, A: Array
    ) -> Array:
        """Return the effect of the integrals of UAVs alone on the state over a period, (n, 2).

        Source: docs/equations.md (63e).
        """
        model, x, u = place.model, place.x, place.actual
        along_x, along_y = self._silent.integral_deviations(silent, period.unannounced).T
        f, *by_axis = model.derivatives(x, u, [np.zeros_like(along_x), along_x, along_y])
        E = np.zeros((len(A), 2))
        E[: len(x)] = (by_axis - f).T
        #   integral of exp(A_c t) E  =  T_s / 2 (E + A E) + O(T_s^3)
        return np.asarray(self._period_s / 2.0 * (E + A @ E))

    def _period_noise(
        self, belief: Belief, period: FilterPeriod, place: Situation, discrete: Discrete, L: Array
    ) -> Array:
        """Return the covariance of all that errs in a period, (r, r): the last terms of (63), (63c)."""
        s = L.shape[1]
        B_xi = L.T @ discrete.B
        Q = self.process_noise(self._level(belief, period))
        Q[:s, :s] += self._noise_of_late_motors(belief, period, B_xi)
        if period.K is None:
            return Q

        if period.silent is None:
            Q[:s, :s] += self._noise_of_others(belief, period, period.K, L, discrete.B)
            return Q
        T, P = belief.covariance.basis.T, belief.covariance.P[:s, :s]
        Q[:s, :s] += self._silent.noise(period.silent, period, B_xi, T, P)
        if period.is_alone and self._silent.has_integrals:
            integrals = L.T @ self._by_integrals(period.silent, period, place, discrete.A)
            Q[:s, :s] += integrals @ integrals.T
        return Q

    @staticmethod
    def _level(belief: Belief, period: FilterPeriod) -> float:
        """Return the level of the model's errors in a period: that of the innovations (63b), or 1.

        Past innovations do not tell how large the errors are while a UAV follows its fail-safe, since it is
        not known exactly when it took over and at what thrust, (63), or while UAVs act alone, (63c).
        """
        is_known_roughly = period.unannounced.by_fail_safe.any() or period.is_alone
        return 1.0 if is_known_roughly else belief.level.value

    def _noise_of_late_motors(self, belief: Belief, period: FilterPeriod, B_xi: Array) -> Array:
        """Return the covariance of inputs that act late by the unknown lag of the motors, (s, s)."""
        #   B_xi diag(lag / T_s du)^2 B_xi'
        share = self._noise.unknown_lag_s / self._period_s
        late = B_xi * (share * (period.u - belief.u))
        return np.asarray(late @ late.T)

    @staticmethod
    def _noise_of_others(
        belief: Belief, period: FilterPeriod, K: Array, L: Array, B: Array
    ) -> Array:
        """Return the covariance of the others' inputs by errors that the own one does not share, (s, s).

        That is (63), with one correlation and no agent alone; `SilentTeam.noise` is (63c), with both by
        input, and is equal to this one where no agent is alone.
        """
        by_law = period.unannounced.by_law
        s = L.shape[1]
        P = belief.covariance.P[:s, :s]

        #   (1 - c^2) B_xi K_o T P T' K_o' B_xi'
        B_xi = L.T @ B[:, by_law]
        K_T = K[by_law] @ belief.covariance.basis.T
        unshared = 1.0 - period.correlation**2
        return np.asarray(unshared * B_xi @ (K_T @ P @ K_T.T) @ B_xi.T)

    def correct(self, belief: Belief, model: Model, sensed: Sequence[Sensed]) -> Belief:
        """Return the belief with measurements of its tick; those of released UAVs are ignored.

        Source: docs/equations.md (64).
        """
        innovation = self.innovation(belief, model, sensed)
        if innovation is None:
            return belief
        observation = self.observation(belief, innovation)
        correction = kalman.correct(belief.covariance.P, observation)
        return self.corrected(belief, innovation, observation, correction)

    def innovation(
        self, belief: Belief, model: Model, sensed: Sequence[Sensed]
    ) -> Innovation | None:
        """Return measurements against their prediction by a belief; None if there are none."""
        sensed = [one for one in sensed if one.uav not in model.released]
        if not sensed:
            return None
        place = self._situation(belief, model, belief.u, self.forces(belief))
        return innovation_of(sensed, place, self._R)

    def observation(self, belief: Belief, innovation: Innovation) -> Observation:
        """Return an innovation with the derivative H = dh/dxi of its measurements."""
        return observation_of(innovation, belief.covariance.basis.T, self._unknown_forces)

    def corrected(
        self,
        belief: Belief,
        innovation: Innovation,
        observation: Observation,
        correction: Correction,
        saved: SavedGain | None = None,
    ) -> Belief:
        """Return the belief after a correction of least variance, with a gain to be used again."""
        before = belief.covariance
        covariance = Covariance(
            P=kalman.corrected(before.P, correction.G, observation),
            basis=before.basis,
            squared_error=correction.squared_error,
            measurements=len(observation.error),
        )
        innovations = (innovation.error, correction.S.diagonal(), innovation.R)
        level = followed(
            belief.level, self._rule, self._period_s, innovation.entries.all, innovations
        )
        deviation = self.in_state(before, correction.step)
        return self.moved(belief, deviation, covariance, level, saved)

    def in_state(self, covariance: Covariance, coordinates: Array) -> Array:
        """Return coordinates, (r, ...), as deviations of the state and, if estimated, unknown forces."""
        T = covariance.basis.T
        s = T.shape[1]
        return np.concatenate([T @ coordinates[:s], coordinates[s:]])

    def in_coordinates(self, covariance: Covariance, deviations: Array) -> Array:
        """Return deviations of the state and, if estimated, unknown forces in coordinates, (r, ...)."""
        L = covariance.basis.L
        n = len(L)
        return np.concatenate([L.T @ deviations[:n], deviations[n:]])

    def moved(
        self,
        belief: Belief,
        deviation: Array,
        source: Covariance | Postponed,
        level: Level,
        saved: SavedGain | None,
    ) -> Belief:
        """Return the belief with its estimate moved by deviations of state and unknown forces."""
        n = len(belief.x)
        return Belief(
            x=self.manifold.moved(belief.x, deviation[:n]),
            unknowns=belief.unknowns + deviation[n:],
            u=belief.u,
            level=level,
            source=source,
            saved=saved,
        )

    def certain(
        self, belief: Belief, entries: npt.NDArray[np.intp], deviation: float = _CERTAIN
    ) -> Belief:
        """Return the belief with some entries of the state certain, as a failure sets them."""
        covariance = belief.covariance
        coordinates = np.flatnonzero(covariance.basis.T[entries].any(axis=0))
        P = covariance.P.copy()
        P[coordinates] = 0.0
        P[:, coordinates] = 0.0
        P[coordinates, coordinates] = deviation**2
        return replace(belief, source=replace(covariance, P=P))
