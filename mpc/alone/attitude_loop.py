"""The attitude loop of a UAV without a plan: feedback of attitude and body rates to moments or commanded body rates.

A UAV that keeps level and a UAV alone have the same loop on moments. Around an inner loop on body
rates the UAV alone has the faster one, as it turns the thrust that holds its position.
Source: docs/equations.md (31), (31b), (58).
"""

from dataclasses import dataclass

import numpy as np

from transport.model.arrays import Array
from transport.model.physics.parameters import System

# The loop on moments of a UAV that keeps level: slow enough for the moment limits of small quadrotors,
# faster than the pendulum of a rod.
LEVELLING_RAD_S = 6.0
_DAMPING_RATIO = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class OuterGain:
    """Gain from an attitude error to commanded body rates, around an inner loop of gain K.

    The damping ratio of both loops together is sqrt(1 / share) / 2.
    """

    share: float  # of K
    largest: float  # 1/s


# Critical damping, as autopilots usually have it.
LEVELLING = OuterGain(share=0.25, largest=6.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class AttitudeLoop:
    """Feedback -stiffness dTheta - damping domega to what turns a UAV: G_Theta and G_omega of (31c)."""

    stiffness: Array  # (3, 3), N m/rad, or 1/s for commanded body rates
    damping: Array  # (3, 3), N m s/rad; zero for commanded body rates, which the inner loop damps


def attitude_loop(
    system: System, uav: int, outer: OuterGain, *, frequency_rad_s: float, heading: float
) -> AttitudeLoop:
    """Return the attitude loop of a UAV, 0-based; `heading` is its stiffness about yaw over that about roll and pitch.

    `outer` holds where the inputs are body rates, the frequency where they are moments.
    """
    weights = np.diag([1.0, 1.0, heading])
    if system.rate_gains is not None:
        by_axis = np.minimum(outer.share * system.rate_gains, outer.largest)
        return AttitudeLoop(stiffness=np.diag(by_axis) @ weights, damping=np.zeros((3, 3)))

    inertia = system.uavs[uav].inertia
    return AttitudeLoop(
        stiffness=frequency_rad_s**2 * inertia @ weights,
        damping=2.0 * _DAMPING_RATIO * frequency_rad_s * inertia,
    )
