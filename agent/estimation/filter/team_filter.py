"""Error-state Kalman filter over the whole team, from the measurements of the UAVs' own sensors.

No sensor sees the payload or the rods: they follow from where all UAVs are and how they move. The
error of an estimate lives on the manifold of states, in 12 + 10 N coordinates about the estimate.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from transport.agent.estimation.filter import kalman
from transport.agent.estimation.filter.assumed_noise import (
    FirstErrors,
    ForceNoise,
    LeastSensorNoise,
    ModelNoise,
)
from transport.agent.estimation.filter.belief import Belief, Covariance, Postponed, SavedGain
from transport.agent.estimation.filter.error_growth import ErrorGrowth
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
from transport.agent.estimation.filter.unknown_forces import COUNT, UnknownForces
from transport.model import state
from transport.model.arrays import Array
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
        growth: How errors grow over a sampling period.
    """

    def __init__(self, setup: TeamRun, noise: ModelNoise | None = None) -> None:
        system = setup.system
        self.N = system.N
        is_estimating = setup.settings.disturbance.estimate
        self._system = system
        self._u_hover = setup.hover.u
        self._period_s = setup.settings.sampling_period_s
        self._R = LeastSensorNoise().variances(setup.sensors)
        self._rule: LevelRule = WIND if is_estimating else EXACT

        # Coordinates: of the state, of the actual inputs with motor lag, of unknown forces.
        lagging = system.m if setup.settings.motor_lag_s > 0.0 else 0
        self._force_coordinates = COUNT if is_estimating else 0
        self._unknown_forces = UnknownForces(setup.model) if is_estimating else None
        self.manifold = Manifold(self.N, lagging)

        model_noise = ModelNoise() if noise is None else noise
        self.growth = ErrorGrowth(setup, model_noise, self.manifold, self._unknown_forces)
        self._P0 = self._first_covariance(lagging)

    def _first_covariance(self, lagging: int) -> Array:
        """Return the covariance before any measurement."""
        deviations = [FirstErrors().by_coordinate(self.N), np.zeros(lagging)]
        if self._force_coordinates:
            deviations.append(ForceNoise().first(self._system))
        return np.diag(np.concatenate(deviations) ** 2)

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

    def predict(self, belief: Belief, period: FilterPeriod) -> Belief:
        """Return the belief at the end of a sampling period.

        Source: docs/equations.md (63).
        """
        covariance = self.growth.after(belief, period)
        unknowns = self.unknowns_ahead(belief, period)
        return replace(belief, x=period.end, unknowns=unknowns, u=period.u, source=covariance)

    def unknowns_ahead(self, belief: Belief, period: FilterPeriod) -> Array:
        """Return the unknown forces at the end of a period: as before, or nearer to zero, (63d)."""
        if not period.is_alone:
            return belief.unknowns
        return self.growth.kept_forces(period) * belief.unknowns

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
        place = self.growth.situation(belief, model, belief.u, self.forces(belief))
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
