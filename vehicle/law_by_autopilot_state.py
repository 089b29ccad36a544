"""The control law of a UAV alone by the state of its autopilot, for when no fresh plan is there."""

import numpy as np

from transport.model.arrays import Array
from transport.mpc.alone.motion_by_own_sensors import OwnSensors
from transport.mpc.alone.uav_motion import UavMotion
from transport.mpc.law.laws_of_uavs_alone import AloneTeam
from transport.mpc.law.present_law import Regulation
from transport.protocol.scenario.setup.team_run import TeamRun


class OwnLaw:
    """Thrust and body rates of one UAV, 0-based, from measurements at the ticks.

    The rod is observed at every tick, so that the law can take over at any; its integral begins at
    zero whenever it does. Source: docs/equations.md (31a)-(31f).
    """

    def __init__(self, setup: TeamRun, uav: int) -> None:
        self._settings = setup.settings
        self._uav = uav
        reference = setup.reference.sampled
        self._regulation = Regulation(setup.model, setup.hover, setup.settings, reference)
        self._team = AloneTeam(
            setup.model, setup.hover, setup.settings, self._regulation, reference
        )
        self._sensors = OwnSensors(
            setup.system,
            uav,
            float(setup.hover.tensions[uav]),
            setup.sensors.ages,
            setup.settings.sampling_period_s,
        )
        self._integral_I = np.zeros(3)

    def warm_up(self) -> None:
        """Compute the motion that the UAV follows."""
        self._regulation.whole.fail_safe.warm_up()

    def follow(self, setup: TeamRun) -> None:
        """Follow the reference of the run with a further target."""
        self._regulation.follow(setup.reference.sampled)
        self._team.follow(setup.reference.sampled)

    def observe(self, sensed: Array, thrust_N: float, tick: int) -> None:
        """Take in measurements of a tick, (15,), with the thrust applied until then."""
        self._sensors.observe(sensed, thrust_N, tick, self._reference)

    def rest(self) -> None:
        """Forget the integral: a plan is followed."""
        self._integral_I = np.zeros(3)

    def inputs(self, sensed: Array, tick: int, before: Array) -> Array:
        """Return thrust and body rates from a tick on, (4,), within limits of the last ones."""
        settings = self._settings
        law = self._team.law(self._uav)
        setpoint = self._team.setpoint(self._uav, tick)
        motion = self._sensors.motion(sensed, tick, tick, self._reference)
        wanted = law.inputs(motion, setpoint, self._integral_I)
        self._integral_I = law.integral_after(
            self._integral_I, motion, setpoint, settings.sampling_period_s
        )

        step = settings.largest_step(1)
        inputs = np.clip(wanted, before - step, before + step)
        return np.clip(inputs, settings.lower(1), settings.upper(1))

    def _reference(self, tick: int) -> UavMotion:
        return self._team.setpoint(self._uav, tick).motion
