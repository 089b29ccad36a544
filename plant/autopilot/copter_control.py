"""Control of the stand-in autopilot: modes, arming, and outputs of its motors.

It does what ArduCopter was measured to do, and no more:

    DISARMED --arm, checks passed, GUIDED--> ARMED --disarm--> DISARMED
    GUIDED    thrust and body rates of the newest setpoint; the rates change by ATC_ACCEL at most and
              are integrated into a desired attitude, so a step of a rate overshoots by a fifth
              without one for GUID_TIMEOUT: level, at a vertical speed of zero, wherever it drifts
              before the first one: holds its place
    BRAKE     holds its place
    LAND      sinks at 0.5 m/s over its place
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

# Modes by their numbers.
STABILIZE, GUIDED, LAND, BRAKE = 0, 4, 9, 17
MODES = (STABILIZE, GUIDED, LAND, BRAKE)

_GRAVITY = 9.80665
_SINKS_MPS = 0.5
# Loop of place and height: 1/s^2 and 1/s, and the steepest tilt that it asks for.
_PLACE, _SPEED, _CLIMB = 1.0, 2.0, 4.0
_STEEPEST = 0.35
_AXES = ("RLL", "PIT", "YAW")  # in the names of parameters
_MOST_INTEGRAL = 0.3
# Signs of roll, pitch and yaw at front right, rear left, front left, rear right.
_MIX = ((-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, -1, -1))

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
_NONE: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class CopterEstimate:
    """What the autopilot takes for its motion, in its own frame with z down, SI."""

    position: Vector
    velocity: Vector
    attitude: Quaternion  # world from body
    gyro: Vector


@dataclass(frozen=True, slots=True)
class CopterSetpoint:
    """Thrust as a share of the largest, body rates, rad/s, and the time of its arrival, s."""

    thrust: float
    rates: Vector
    at_s: float


@dataclass(slots=True)
class CopterControl:
    """State of the control; `outputs` is called once for each step of the physics.

    Attributes:
        parameters: By name; those that this control knows are read at each step.
        mode: Number of the mode.
        is_armed: Whether the motors run.
    """

    parameters: Mapping[str, float]
    mode: int = STABILIZE
    is_armed: bool = False
    _setpoint: CopterSetpoint | None = None
    _desired: Quaternion | None = None
    _place: Vector | None = None
    _rates: Vector = _NONE  # desired, on their way to those of the setpoint
    _integral: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def arm(self, problem: str) -> str:
        """Arm unless there is a problem; return why not, empty if it does."""
        if not problem and self.mode != GUIDED:
            problem = "mode not armable"
        if not problem:
            self.is_armed = True
            self._setpoint = self._desired = self._place = None
            self._rates = _NONE
            self._integral = [0.0, 0.0, 0.0]
        return problem

    def change_mode(self, mode: int) -> bool:
        """Take a mode; return whether there is such a mode."""
        if mode not in MODES:
            return False
        if mode != self.mode:
            self.mode = mode
            self._setpoint = self._desired = self._place = None
        return True

    def take(self, setpoint: CopterSetpoint) -> bool:
        """Take a setpoint; return whether this mode obeys it."""
        if self.mode != GUIDED or not self.is_armed:
            return False
        self._setpoint = setpoint
        return True

    def outputs(self, time_s: float, step_s: float, estimate: CopterEstimate) -> tuple[float, ...]:
        """Return the thrust of each rotor as a share of its largest, four numbers."""
        if not self.is_armed:
            return 0.0, 0.0, 0.0, 0.0
        given = self._setpoint
        timeout_s = self.parameters["GUID_TIMEOUT"]
        if self.mode == GUIDED and given is not None:
            if time_s - given.at_s <= timeout_s:
                return self._turn(step_s, estimate, given.thrust, given.rates)
            return self._level(step_s, estimate)
        return self._hold(step_s, estimate)

    def _level(self, step_s: float, estimate: CopterEstimate) -> tuple[float, ...]:
        """Keep level, without climbing or sinking."""
        self._desired = _level(estimate.attitude)
        thrust = self._lift(estimate, _CLIMB * estimate.velocity[2])
        return self._turn(step_s, estimate, thrust, _NONE)

    def _hold(self, step_s: float, estimate: CopterEstimate) -> tuple[float, ...]:
        """Keep the place, and the height unless the mode lands."""
        if self._place is None:
            self._place = estimate.position
        sinks = _SINKS_MPS if self.mode == LAND else 0.0
        x, y, z = self._place
        self._place = x, y, z + sinks * step_s

        north, east = (
            _PLACE * (self._place[i] - estimate.position[i]) - _SPEED * estimate.velocity[i]
            for i in (0, 1)
        )
        up = _PLACE * (estimate.position[2] - self._place[2])
        up += _CLIMB * (estimate.velocity[2] - sinks)
        self._desired = _tilted(estimate.attitude, north / _GRAVITY, east / _GRAVITY)
        return self._turn(step_s, estimate, self._lift(estimate, up), _NONE)

    def _lift(self, estimate: CopterEstimate, up_mps2: float) -> float:
        """Return the share of thrust that accelerates upwards at any tilt."""
        _, x, y, _ = estimate.attitude
        upright = max(1.0 - 2.0 * (x * x + y * y), 0.5)
        return self.parameters["MOT_THST_HOVER"] * (1.0 + up_mps2 / _GRAVITY) / upright

    def _turn(
        self, step_s: float, estimate: CopterEstimate, thrust: float, rates: Vector
    ) -> tuple[float, ...]:
        """Return the outputs that turn at body rates, by way of a desired attitude."""
        rates = self._shaped(step_s, rates)
        # q_d' = q_d * rates / 2
        desired = self._desired or estimate.attitude
        desired = _normalised(_product(desired, _turned(rates, step_s)))
        self._desired = desired
        error = _rotation_vector(_product(_conjugate(estimate.attitude), desired))

        moments = [
            self._moment(step_s, i, rates[i], error[i], estimate.gyro[i]) for i in range(len(_AXES))
        ]
        shares = [
            thrust + 0.5 * sum(sign * moment for sign, moment in zip(signs, moments, strict=True))
            for signs in _MIX
        ]
        return tuple(min(max(share, 0.0), 1.0) for share in shares)

    def _moment(self, step_s: float, i: int, rate: float, error: float, gyro: float) -> float:
        """Return the moment about an axis after a step: proportional to the error of the rate, and its integral."""
        axis = _AXES[i]
        angle = self.parameters[f"ATC_ANG_{axis}_P"]
        p, integral = (self.parameters[f"ATC_RAT_{axis}_{gain}"] for gain in "PI")
        off = rate + angle * error - gyro
        held = self._integral[i] + integral * off * step_s
        self._integral[i] = min(max(held, -_MOST_INTEGRAL), _MOST_INTEGRAL)
        return float(p * off + self._integral[i])

    def _shaped(self, step_s: float, rates: Vector) -> Vector:
        """Return the desired rates after a step towards those of a setpoint."""
        shaped = []
        for axis, before, wanted in zip("RPY", self._rates, rates, strict=True):
            # Hundredths of a degree/s^2.
            most = math.radians(self.parameters[f"ATC_ACCEL_{axis}_MAX"] / 100.0) * step_s
            shaped.append(min(max(wanted, before - most), before + most))
        self._rates = shaped[0], shaped[1], shaped[2]
        return self._rates


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation b followed by a."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


def _conjugate(q: Quaternion) -> Quaternion:
    return q[0], -q[1], -q[2], -q[3]


def _normalised(q: Quaternion) -> Quaternion:
    size = math.sqrt(sum(part * part for part in q))
    w, x, y, z = (part / size for part in q)
    return w, x, y, z


def _turned(rates: Vector, step_s: float) -> Quaternion:
    """Return the small rotation by body rates over a step, to first order."""
    return 1.0, rates[0] * step_s / 2, rates[1] * step_s / 2, rates[2] * step_s / 2


def _rotation_vector(q: Quaternion) -> Vector:
    """Return the axis of a rotation of less than half a turn, as long as its angle."""
    if q[0] < 0.0:
        q = -q[0], -q[1], -q[2], -q[3]
    sine = math.sqrt(q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    scale = 2.0 if sine < 1e-9 else 2.0 * math.atan2(sine, q[0]) / sine
    return scale * q[1], scale * q[2], scale * q[3]


def yaw_of(q: Quaternion) -> float:
    """Return the heading of an attitude, rad."""
    w, x, y, z = q
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _level(q: Quaternion) -> Quaternion:
    yaw = yaw_of(q)
    return math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)


def _tilted(q: Quaternion, north: float, east: float) -> Quaternion:
    """Return an attitude of the same heading whose thrust accelerates by shares of gravity."""
    yaw = yaw_of(q)
    forward = math.cos(yaw) * north + math.sin(yaw) * east
    right = -math.sin(yaw) * north + math.cos(yaw) * east
    pitch = -min(max(forward, -_STEEPEST), _STEEPEST)
    roll = min(max(right, -_STEEPEST), _STEEPEST)
    turned = _product(_level(q), (math.cos(pitch / 2), 0.0, math.sin(pitch / 2), 0.0))
    return _product(turned, (math.cos(roll / 2), math.sin(roll / 2), 0.0, 0.0))
