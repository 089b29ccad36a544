"""Less work for the newest ticks, outside the filter: gains used again, covariances deferred.

With a network some ticks late, an agent repeats its newest ticks, in which it has nothing but own
measurements, at every tick. Their gain hardly differs from that of the tick before: they take the
gain of the last correction that had more, and their covariance is computed when it is asked for,
which is exact for any gain. A tick that has the others' measurements has a gain of its own.
With `most_ticks` = 0 no gain is used again, and the bits are those of `TeamFilter`.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from transport.agent.estimation.filter import kalman
from transport.agent.estimation.filter.belief import Belief, Covariance, SavedGain
from transport.agent.estimation.filter.filter_interface import FilterPeriod, Sensed
from transport.agent.estimation.filter.innovations import Innovation
from transport.agent.estimation.filter.kalman import Correction
from transport.agent.estimation.filter.team_filter import TeamFilter
from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model

# Ticks after a correction with more than own measurements at which its gain is still used.
MOST_TICKS = 8


class Deferred:
    """A covariance that is computed when it is first asked for, and once."""

    def __init__(self, compute: Callable[[], Covariance]) -> None:
        self._compute = compute
        self._value: Covariance | None = None

    @property
    def value(self) -> Covariance:
        """The covariance."""
        if self._value is None:
            self._value = self._compute()
            del self._compute  # and with it the beliefs that it was computed from
        return self._value


class GainReuse:
    """A team filter that spares work at ticks with own measurements alone.

    Args:
        team: The filter.
        owned: UAVs, 0-based, ascending, that are measured at once.
        most_ticks: Ticks at which a gain is used again; 0 switches it off.
    """

    def __init__(
        self, team: TeamFilter, owned: Sequence[int], most_ticks: int = MOST_TICKS
    ) -> None:
        self._team = team
        self._owned = tuple(owned)
        self._most_ticks = most_ticks
        is_owned = np.isin(np.arange(team.N), self._owned)
        self._is_own_entry = np.repeat(is_owned, state.SENSED)  # of all measurements of the team

    def first(self, x: Array) -> Belief:
        """Return the belief without any measurement, about a state."""
        return self._team.first(x)

    def forces(self, belief: Belief) -> Array | None:
        """Return the estimated forces and mass error; None where they are not estimated."""
        return self._team.forces(belief)

    def certain(self, belief: Belief, entries: npt.NDArray[np.intp]) -> Belief:
        """Return the belief with some entries of the state certain."""
        return self._team.certain(belief, entries)

    def predict(self, belief: Belief, period: FilterPeriod) -> Belief:
        """Return the belief at the end of a sampling period, its covariance on demand."""
        covariance = Deferred(lambda: self._team.growth.after(belief, period))
        saved = belief.saved
        if saved is not None:
            saved = SavedGain(gain=saved.gain, ticks=saved.ticks + 1)
        return replace(
            belief,
            x=period.end,
            unknowns=self._team.unknowns_ahead(belief, period),
            u=period.u,
            source=covariance,
            saved=saved,
        )

    def is_plausible(self, belief: Belief) -> bool:
        """Return whether a belief can be that of a team in flight."""
        return self._team.is_plausible(belief)

    def correct(self, belief: Belief, model: Model, sensed: Sequence[Sensed]) -> Belief:
        """Return the belief with measurements of its tick, by the saved gain where that is due."""
        innovation = self._team.innovation(belief, model, sensed)
        if innovation is None:
            return belief

        saved = belief.saved
        if saved is not None and saved.ticks <= self._most_ticks and self._is_own(innovation):
            return self._corrected(belief, innovation, saved.gain)

        observation = self._team.observation(belief, innovation)
        correction = kalman.correct(belief.covariance.P, observation)
        saved = self._saved(belief, innovation, correction)
        return self._team.corrected(belief, innovation, observation, correction, saved)

    def _is_own(self, innovation: Innovation) -> bool:
        """Return whether the innovation is that of all own measurements and of nothing else."""
        is_complete = len(innovation.error) == state.SENSED * len(self._owned)
        return innovation.uavs == self._owned and is_complete

    def _corrected(self, belief: Belief, innovation: Innovation, gain: Array) -> Belief:
        """Return the belief after a correction by a given gain, its covariance on demand."""

        def covariance() -> Covariance:
            before = belief.covariance
            observation = self._team.observation(belief, innovation)
            G = self._team.in_coordinates(before, gain)

            #   S = H P H' + R
            S = observation.H @ before.P @ observation.H.T + np.diag(observation.R)
            error = observation.error
            return replace(
                before,
                P=kalman.corrected(before.P, G, observation),
                squared_error=float(error @ np.linalg.solve(S, error)),
                measurements=len(error),
            )

        deviation = gain @ innovation.error
        deferred = Deferred(covariance)
        return self._team.moved(belief, deviation, deferred, belief.level, belief.saved)

    def _saved(
        self, belief: Belief, innovation: Innovation, correction: Correction
    ) -> SavedGain | None:
        """Return the gain for own measurements alone; the one before if some are missing."""
        rows = np.flatnonzero(self._is_own_entry[innovation.entries.all])
        if not self._most_ticks or not len(rows) == state.SENSED * len(self._owned) > 0:
            return belief.saved

        #   G' = S^-1 H P, of these rows
        S = correction.S[rows[:, None], rows]
        G = np.asarray(np.linalg.solve(S, correction.H_P[rows]).T, dtype=np.float64)
        return SavedGain(gain=self._team.in_state(belief.covariance, G), ticks=0)
