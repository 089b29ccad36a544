"""UAVs that act alone, as one agent sees them: their laws, and the motion of the team that each follows its part of.

With a fail-safe that follows they follow what it does. With one that keeps level they follow the
undisturbed motion of the present team, as the others move UAVs without an agent. With a flat
reference it is that reference.
Source: docs/equations.md (31f).
"""

from collections.abc import Collection

import numpy as np

from transport.model.arrays import Array
from transport.model.kernels import native
from transport.model.linear.linearisation import Model
from transport.model.physics.hover import Hover
from transport.mpc.alone.alone_law import AloneLaw
from transport.mpc.alone.compiled_alone_law import CompiledAloneLaw
from transport.mpc.alone.fail_safe import FailSafe
from transport.mpc.alone.uav_motion import Setpoint, motion_of
from transport.mpc.alone.undisturbed_motion import UndisturbedMotion
from transport.mpc.law.present_law import Regulation
from transport.mpc.law.reconfiguration import undisturbed
from transport.mpc.reference import Sampled
from transport.mpc.settings_period_horizon_weights import ControllerSettings

_KEPT = 512  # ticks: more than estimators look back and horizons ahead
# Time before the first tick that is asked for, at which the motion of the present team starts from
# the reference: its start has decayed, s.
_LEAD_S = 10.0


class AloneTeam:
    """Control laws and setpoints of the UAVs of a team, alone, along a reference."""

    def __init__(
        self,
        model: Model,
        hover: Hover,
        settings: ControllerSettings,
        regulation: Regulation,
        reference: Sampled,
    ) -> None:
        self._system = model.system
        self._hover = hover
        self._settings = settings
        self._regulation = regulation
        self._off, self._released = frozenset[int](), frozenset[int]()
        self._further_drag: Array | None = None
        self.follow(reference)

    def assume_drag(self, further: Array) -> None:
        """Assume drag of payload and UAVs beyond the known one, (2,), kg/s, along a flat reference."""
        self._further_drag = further
        self._setpoints.clear()

    def follow(self, reference: Sampled) -> None:
        """Follow a reference; the regulation follows it already."""
        self._reference = reference
        self._motion: UndisturbedMotion | None = None  # of the present team
        self._version: object = None  # of its law
        gains = self._settings.alone_gains
        self._on_reference = FailSafe(
            self._system, self._hover.u, reference.X, reference.track, gains=gains
        )
        self.fail(self._off, self._released)

    def fail(self, off: Collection[int], released: Collection[int]) -> None:
        """Set the UAVs without motors, 0-based, and those of them that are released: the others carry their load."""
        self._off, self._released = frozenset(off), frozenset(released)
        # Those remaining follow the reference itself.
        self._remaining = self._on_reference.of_team(off, released)
        self._setpoints: dict[tuple[int, int], Setpoint] = {}
        self._compiled_laws: dict[int, CompiledAloneLaw] = {}

    def law(self, uav: int) -> AloneLaw:
        """Return the control law of a UAV, 0-based."""
        return self._remaining.law(uav)

    def setpoint(self, uav: int, tick: int) -> Setpoint:
        """Return the setpoint of a UAV, 0-based, at a tick."""
        tick = max(tick, 0)
        self._renew(tick)
        return self._kept_setpoint(uav, tick)

    def setpoint_inputs(self, uav: int, first: int, steps: int) -> Array:
        """Return the inputs of the setpoints of a UAV, 0-based, from a tick >= 0 on, (steps, 4)."""
        self._renew(first)
        ticks = range(first, first + steps)
        return np.array([self._kept_setpoint(uav, tick).inputs for tick in ticks])

    def inputs(self, uav: int, x: Array, tick: int, integral_I: Array | None = None) -> Array:
        """Return the inputs of a UAV, 0-based, alone at a state, (n,), before limits, (4,)."""
        setpoint = self.setpoint(uav, tick)
        if not native.AVAILABLE:
            return self.law(uav).inputs(motion_of(self._system, uav, x), setpoint, integral_I)
        if uav not in self._compiled_laws:
            self._compiled_laws[uav] = CompiledAloneLaw(self._system, uav, self.law(uav))
        return self._compiled_laws[uav].inputs(x, setpoint, integral_I)

    def _kept_setpoint(self, uav: int, tick: int) -> Setpoint:
        """Return the setpoint of a UAV at a tick >= 0 under the newest law, computed once."""
        if self._motion is not None and not self._off:
            return self._motion.setpoint(uav, tick)
        setpoint = self._setpoints.get((uav, tick))
        if setpoint is None:
            while len(self._setpoints) > _KEPT * self._system.N:
                del self._setpoints[next(iter(self._setpoints))]
            setpoint = self._remaining.setpoint(uav, tick, self._further_drag)
            self._setpoints[uav, tick] = setpoint
        return setpoint

    def _renew(self, tick: int) -> None:
        """Take the motion under the newest law, asked for at a tick first."""
        settings = self._settings
        if settings.fail_safe == "follow":
            self._motion = self._regulation.whole.fail_safe.motion
            return
        is_known = settings.prediction == "closed_loop" and not settings.motor_lag_s
        law = self._regulation.current
        if not is_known or self._reference.track is not None or law.gain_source is self._version:
            return
        self._version = law.gain_source
        first = max(0, tick - round(_LEAD_S / settings.sampling_period_s))
        self._motion = undisturbed(law, self._reference, first)
