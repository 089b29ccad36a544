"""Inputs of an agent between those of the team and those of its UAVs alone, smooth both ways: (32d), (32e)."""

from collections.abc import Callable, Sequence

import numpy as np

from transport.agent.estimation.sensor_estimator import SensorEstimator
from transport.agent.estimation.team_estimate import TeamEstimate
from transport.agent.silence.silence_thresholds import TO_TEAM_S
from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.rotations import rotation
from transport.mpc.alone.alone_law import steps_alone
from transport.mpc.alone.motion_by_own_sensors import OwnSensors
from transport.mpc.alone.uav_motion import UavMotion, ahead, motion_of
from transport.mpc.program.prediction import Linear
from transport.protocol.scenario.setup.team_run import TeamRun

# Time from the team's law to the law alone, s: others hear of the change meanwhile, and come along.
_TO_ALONE_S = 1.0
# The same of an agent that has never heard one of the others, s: it does not know where the UAVs of that
# one are, and the team's law counts on them.
_UNHEARD_S = 0.5
# Time over which the thrust of the team, that the integral begins with, is averaged, s.
_PRELOAD_S = 1.0
# Time constant with which a deviation alone fades in the later steps of a plan, s.
_FADES_S = 0.2


class Mixture:
    """Share of the law alone in an agent's inputs.

    It begins with the share that the rule wants first, and follows the rule at a limited rate.
    Source: (32d).
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._has_begun = False
        self.share = 0.0

    def advance(self, wanted: float, *, has_heard_all: bool = True) -> float:
        """Return the share one tick later, where the rule wants another one."""
        if not self._has_begun:
            self._has_begun = True
            self.share = wanted
        up = self._period_s / (_TO_ALONE_S if has_heard_all else _UNHEARD_S)
        down = self._period_s / TO_TEAM_S
        self.share += min(max(wanted - self.share, -down), up)
        return self.share


class HandOver:
    """Hand-over of the UAVs of one agent, 0-based, between the team's control law and the law alone."""

    def __init__(self, setup: TeamRun, team: TeamEstimate, owned: Sequence[int]) -> None:
        self._setup, self._team, self._owned = setup, team, owned
        self._period_s = setup.settings.sampling_period_s
        self._mixture = Mixture(self._period_s)
        # While UAVs act alone: force of the integral of each, N, and its sensors.
        self._integral_I: dict[int, Array] = {}
        self._sensors: dict[int, OwnSensors] = {}
        self._faded: Array = np.zeros((0, 1))

        # Places of the own inputs in u, their limits, and those of their change over a period.
        settings = setup.settings
        self._places = state.input_indices(owned)
        self._lower = settings.lower(len(owned))
        self._upper = settings.upper(len(owned))
        self._largest_step = settings.largest_step(len(owned))

    @property
    def share(self) -> float:
        """Share of the law alone in the newest inputs."""
        return self._mixture.share

    def advance(self, k: int) -> None:
        """Follow the rule to tick k: information about the others is in."""
        wanted = self._team.share_alone(k)
        # Of effect only on the way to the law alone.
        is_rising = wanted > self._mixture.share
        has_heard_all = not is_rising or self._team.announced.heard.has_heard_all(before=k)
        self._mixture.advance(wanted, has_heard_all=has_heard_all)

    def inputs(self, k: int, start: int, linear: Linear, team: Array) -> Array:
        """Return the inputs to announce and to apply from tick `start` on, for those of the team, (N_p, 4 owned).

        Wholly alone they are fewer, as a plan of UAVs alone covers less time.
        """
        share = self._mixture.share
        if share == 0.0:
            self._integral_I.clear()
            self._sensors.clear()
            return team

        if share == 1.0:
            team = team[: steps_alone(self._period_s)]
        alone = np.hstack([self._alone(uav, k, start, linear, len(team)) for uav in self._owned])
        before = linear.u0[self._places]
        inputs = mixed(team, alone, share, before, self._largest_step)
        return np.minimum(np.maximum(inputs, self._lower), self._upper)

    def _alone(self, uav: int, k: int, start: int, linear: Linear, steps: int) -> Array:
        """Return the inputs of a UAV alone over a plan, (steps, 4).

        Those of the setpoints, and a deviation that fades.
        """
        law, setpoint = self._team.alone(uav, start)
        if uav not in self._integral_I:
            self._integral_I[uav] = self._preload(uav, k)
        integral_I = self._integral_I[uav]
        motion = self._motion(uav, k, start, linear)
        deviation = law.inputs(motion, setpoint, integral_I) - setpoint.inputs
        self._integral_I[uav] = law.integral_after(integral_I, motion, setpoint, self._period_s)

        ahead = self._team.alone_ahead(uav, start, steps)
        return np.asarray(ahead + self._fading(steps) * deviation)

    def _fading(self, steps: int) -> Array:
        """Return the part of a deviation that is left at each step, (steps, 1), computed once for a length."""
        if len(self._faded) != steps:
            self._faded = np.exp(-self._period_s / _FADES_S * np.arange(steps))[:, None]
        return self._faded

    def _motion(self, uav: int, k: int, start: int, linear: Linear) -> UavMotion:
        """Return the motion of a UAV at tick `start` by its own sensors: (31d), (31e).

        Without all measurements of tick k: by the estimate. The inputs in force until `start` are those
        before it. The estimate at a later tick is a prediction with the others, whose motion is not known
        in silence: at periods of 0.1 s its errors make the payload turn ever further.
        """
        system, estimator = self._setup.system, self._team.estimator

        def reference(tick: int) -> UavMotion:
            return self._team.alone(uav, tick)[1].motion

        if isinstance(estimator, SensorEstimator):
            motion = self._by_sensors(uav, k, start, estimator, reference)
        else:
            x = estimator.past(k)
            now = None if x is None else motion_of(system, uav, x)
            motion = None if now is None else ahead(now, k, start, reference, self._period_s)
        if motion is None:
            return motion_of(system, uav, linear.x0)
        if start == k:
            return motion
        before = linear.u0[state.input_slice(uav)]
        law, here = self._team.alone(uav, k)
        return law.driven(motion, here, reference(start), before, self._period_s)

    def _by_sensors(
        self,
        uav: int,
        k: int,
        start: int,
        estimator: SensorEstimator,
        reference: Callable[[int], UavMotion],
    ) -> UavMotion | None:
        """Return the motion at tick `start` by the vehicle's sensors, observed to tick k.

        What the inputs until then do is left out. None without all measurements of tick k.
        """
        since = k
        if uav not in self._sensors:
            tension_N = float(self._setup.hover.tensions[uav])
            ages = self._setup.sensors.ages
            self._sensors[uav] = OwnSensors(
                self._setup.system, uav, tension_N, ages, self._period_s
            )
            since = max(0, k - round(_PRELOAD_S / self._period_s))
        sensors = self._sensors[uav]
        for tick in range(since, k + 1):
            told = estimator.told(tick, uav)
            if told is None or told.inputs is None or told.missing:
                continue
            sensors.observe(told.values, float(told.inputs[0]), tick, reference)
            if tick == k:
                return sensors.motion(told.values, k, start, reference)
        return None

    def _preload(self, uav: int, k: int) -> Array:
        """Return the force with which the integral begins: the mean by which the team's thrust differs from the law."""
        differences = []
        for tick in range(max(0, k - round(_PRELOAD_S / self._period_s)), k):
            x = self._team.estimator.past(tick)
            if x is None:
                continue
            law, setpoint = self._team.alone(uav, tick)
            motion = motion_of(self._setup.system, uav, x)
            thrust_N = self._team.announced.in_force(tick, before=k)[state.input_slice(uav)][0]
            applied_I = -thrust_N * rotation(motion.Theta)[:, 2]
            differences.append(applied_I - law.force(motion, setpoint))
        law, _ = self._team.alone(uav, k)
        return law.within(np.mean(differences, axis=0)) if differences else np.zeros(3)


def mixed(team: Array, alone: Array, share: float, before: Array, step: Array) -> Array:
    """Return inputs between those of the team and alone, (steps, 4 owned).

    They change by a step per period at most.
    """
    inputs = (1.0 - share) * team + share * alone
    for k in range(len(inputs)):
        previous = before if k == 0 else inputs[k - 1]
        inputs[k] = np.minimum(np.maximum(inputs[k], previous - step), previous + step)
    return inputs
