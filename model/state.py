"""The layout of the state and input vectors.

Indices are 0-based, the ids UAV1..UAVN in scenarios 1-based.

x = [r0, v0, Theta0, omega0, (e_i, Omega_i, Theta_i, omega_i) for i = 1..N],   12 + 12 N
u = [(thrust_i, tau_i) for i = 1..N],  or three commanded body rates,          4 N
"""

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from transport.model.arrays import Array, Rows

PAYLOAD = 12  # states of the payload
PER_UAV = 12  # states of each UAV with its rod
INPUTS = 4  # thrust and three moments, or three commanded body rates

R0 = slice(0, 3)  # payload position, inertial frame, m
V0 = slice(3, 6)  # payload velocity, payload frame, m/s
THETA0 = slice(6, 9)  # payload attitude, rad
OMEGA0 = slice(9, 12)  # payload angular velocity, payload frame, rad/s

# Offsets within one UAV's block.
E = slice(0, 3)  # rod direction from UAV to attachment point, payload frame, unit
ROD_RATE = slice(3, 6)  # Omega_i, absolute angular velocity of the rod, payload frame, rad/s
THETA = slice(6, 9)  # UAV attitude, rad
OMEGA = slice(9, 12)  # UAV angular velocity, UAV body frame, rad/s

# Measurements of one UAV's own sensors; the attitude and its rate are where a UAV's block has them.
SENSED = 15
POSITION = slice(0, 3)  # inertial frame, m
VELOCITY = slice(3, 6)  # inertial frame, m/s
SPECIFIC_FORCE = slice(12, 15)  # acceleration minus gravity, UAV body frame, m/s^2
# Its sensors, three numbers each. Sensors without a measurement are a set of bits: 1 stands for the
# first, 2 for the second, 4 for the third.
SENSORS = ("position", "velocity", "attitude", "rate", "specific_force")
ALL_SENSORS = 2 ** len(SENSORS) - 1
# Numbers that a plan reports of a tick: 0 if it is not known, else 1 and the bits of the sensors
# without a measurement; measurements; inputs until then.
REPORTED = 1 + SENSED + INPUTS
IS_KNOWN = 0
SENSED_VALUES = slice(1, 1 + SENSED)
REPORTED_INPUTS = slice(1 + SENSED, REPORTED)
REPORTS = 4  # of the last ticks, the newest first

# Largest plausible state, input or correction, SI; results computed from such numbers stay far
# below the float64 range.
LARGEST = 1e6


def is_measured(sensor: int, missing: int) -> bool:
    """Return whether a sensor, by its place in `SENSORS`, is not among the missing ones."""
    return not missing >> sensor & 1


def uav_slice(i: int) -> slice:
    """Return the states of UAV i (0-based) in x."""
    return slice(PAYLOAD + PER_UAV * i, PAYLOAD + PER_UAV * (i + 1))


def input_slice(i: int) -> slice:
    """Return the inputs of UAV i (0-based) in u."""
    return slice(INPUTS * i, INPUTS * (i + 1))


def input_indices(uavs: Iterable[int]) -> npt.NDArray[np.intp]:
    """Return the positions in u of the inputs of several UAVs (0-based), (4 len(uavs),).

    In the given order.
    """
    return np.array([INPUTS * i + j for i in uavs for j in range(INPUTS)], dtype=np.intp)


def input_places(uavs: Sequence[int]) -> Rows:
    """Return the positions in u of the inputs of UAVs: a slice if they are consecutive, which is faster."""
    if uavs and list(uavs) == list(range(uavs[0], uavs[0] + len(uavs))):
        return slice(INPUTS * uavs[0], INPUTS * (uavs[-1] + 1))
    return input_indices(uavs)


def tilt_indices(N: int) -> npt.NDArray[np.intp]:
    """Return the positions in x of roll and pitch of the payload, then of each UAV, (2 + 2 N,)."""
    bodies = [THETA0.start, *(uav_slice(i).start + THETA.start for i in range(N))]
    return np.array([roll + axis for roll in bodies for axis in (0, 1)], dtype=np.intp)


def uav_blocks(x: Array) -> Array:
    """Return the blocks of all UAVs in state(s) x, (..., 12 + 12 N), without a copy: (..., N, 12)."""
    return x[..., PAYLOAD:].reshape(*x.shape[:-1], -1, PER_UAV)


class StateView:
    """Named views, without copies, into state(s) x, (..., 12 + 12 N)."""

    def __init__(self, x: Array) -> None:
        self.x = x
        self.r0_I = x[..., R0]  # payload position, (..., 3), inertial frame, m
        self.v0_P = x[..., V0]  # payload velocity, (..., 3), payload frame, m/s
        self.Theta0 = x[..., THETA0]  # payload roll, pitch, yaw, (..., 3), rad
        self.omega0_P = x[..., OMEGA0]  # payload angular velocity, (..., 3), payload frame, rad/s

        # UAV blocks, (..., N, 12): rod directions, unit, and angular velocities, rad/s, in the
        # payload frame; UAV roll, pitch, yaw, rad, and angular velocities in the body frame, rad/s;
        # (..., N, 3) each.
        self.uavs = uav_blocks(x)
        self.e_P = self.uavs[..., E]
        self.Omega_P = self.uavs[..., ROD_RATE]
        self.Theta = self.uavs[..., THETA]
        self.omega_B = self.uavs[..., OMEGA]
