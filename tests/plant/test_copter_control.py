"""The control of the stand-in autopilot does what ArduCopter was measured to do."""

import math

import pytest
from scipy.spatial.transform import Rotation

from transport.plant.autopilot.copter_control import (
    BRAKE,
    GUIDED,
    LAND,
    CopterControl,
    CopterEstimate,
    CopterSetpoint,
    Quaternion,
    Vector,
    _normalised,
    _product,
    _tilted,
    _turned,
)
from transport.plant.autopilot.stand_in import _DEFAULTS

STEP_S = 1 / 400
# Moments of an output of 1, rad/s^2, and gains of a loop of 50 ms with them.
PER_OUTPUT = (137.0, 137.0, 6.8)
TAU_S = 0.05
LAG_S = 0.0125  # of the motors
HOVER = 0.5


class Body:
    """A rigid body turned by a control about the axes of its body, without any load."""

    def __init__(self) -> None:
        self.parameters = dict(_DEFAULTS)
        self.parameters["GUID_TIMEOUT"] = 0.5
        self.parameters["MOT_THST_HOVER"] = HOVER
        for axis, most in zip(("RLL", "PIT", "YAW"), PER_OUTPUT, strict=True):
            self.parameters[f"ATC_RAT_{axis}_P"] = 1 / (TAU_S * most)
            self.parameters[f"ATC_RAT_{axis}_I"] = 0.5 / (TAU_S * most)
        self.control = CopterControl(self.parameters)
        assert self.control.change_mode(GUIDED)
        assert not self.control.arm("")
        self.time_s = 0.0
        self.attitude: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self.rates: Vector = (0.0, 0.0, 0.0)
        self.position = [0.0, 0.0, -10.0]
        self.velocity = [0.0, 0.0, 0.0]
        self.outputs = [HOVER] * 4

    def step(self) -> None:
        """Let the control act once, and the body move."""
        estimate = CopterEstimate(
            (self.position[0], self.position[1], self.position[2]),
            (self.velocity[0], self.velocity[1], self.velocity[2]),
            self.attitude,
            self.rates,
        )
        wanted = self.control.outputs(self.time_s, STEP_S, estimate)
        share = 1 - math.exp(-STEP_S / LAG_S)
        self.outputs = [
            now + share * (to - now) for now, to in zip(self.outputs, wanted, strict=True)
        ]
        fr, rl, fl, rr = self.outputs
        moments = (rl + fl - fr - rr, fr + fl - rl - rr, fr + rl - fl - rr)
        x, y, z = (
            rate + STEP_S * most * moment / 2.0
            for rate, most, moment in zip(self.rates, PER_OUTPUT, moments, strict=True)
        )
        self.rates = x, y, z
        self.attitude = _normalised(_product(self.attitude, _turned(self.rates, STEP_S)))
        w, x, y, z = self.attitude
        lift = 9.80665 * sum(self.outputs) / 4 / HOVER
        axis = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
        for i, part in enumerate(axis):
            self.velocity[i] += STEP_S * (-lift * part + (9.80665 if i == 2 else 0.0))
            self.position[i] += STEP_S * self.velocity[i]
        self.time_s += STEP_S

    def fly(self, seconds: float, rates: Vector | None = None) -> list[Vector]:
        """Body rates over a time, with a setpoint every 20 ms if rates are given."""
        seen = []
        for k in range(round(seconds / STEP_S)):
            if rates is not None and k % 8 == 0:
                self.control.take(CopterSetpoint(HOVER, rates, self.time_s))
            self.step()
            seen.append(self.rates)
        return seen


@pytest.mark.parametrize("axis", [0, 1])
def test_rates_follow_with_the_overshoot_of_guided(axis: int) -> None:
    """A step of roll or pitch rate reaches 63 % after 50 to 90 ms, and overshoots by 10 to 30 %.

    ArduCopter was measured at 68 ms and 20 %.
    """
    body = Body()
    body.fly(0.5, (0.0, 0.0, 0.0))
    rates: Vector = (0.6, 0.0, 0.0) if axis == 0 else (0.0, 0.6, 0.0)
    seen = [rate[axis] / 0.6 for rate in body.fly(0.4, rates)]
    reached_s = STEP_S * next(k for k, rate in enumerate(seen) if rate > 0.632)
    assert 0.05 < reached_s < 0.09
    assert 1.1 < max(seen) < 1.3


def test_without_setpoints_it_levels_and_drifts() -> None:
    """After its time-out it levels and keeps its height, but not its place."""
    body = Body()
    body.fly(0.5, (0.0, 0.0, 0.0))
    body.fly(0.3, (0.0, -0.7, 0.0))
    body.fly(1.0, (0.0, 0.0, 0.0))
    before_m = body.position[0]
    body.fly(0.5)
    body.fly(3.0)
    _, x, y, _ = body.attitude
    assert math.hypot(x, y) < 0.01
    assert abs(body.velocity[2]) < 0.05
    assert body.position[0] - before_m > 3.0


@pytest.mark.parametrize(("mode", "sinks_mps"), [(GUIDED, 0.0), (BRAKE, 0.0), (LAND, 0.5)])
def test_it_holds_its_place_by_itself(mode: int, sinks_mps: float) -> None:
    """Before any setpoint, in BRAKE and in LAND it keeps its place; in LAND it sinks."""
    body = Body()
    assert body.control.change_mode(mode)
    body.velocity[0] = 0.5
    body.fly(6.0)
    start_m = list(body.position)
    body.fly(2.0)
    assert math.hypot(body.position[0] - start_m[0], body.position[1] - start_m[1]) < 0.05
    assert body.position[2] - start_m[2] == pytest.approx(2 * sinks_mps, abs=0.05)


def test_it_refuses() -> None:
    """It arms only without a problem and in GUIDED, and obeys setpoints only armed and there."""
    control = CopterControl(dict(_DEFAULTS))
    estimate = CopterEstimate((0.0,) * 3, (0.0,) * 3, (1.0, 0.0, 0.0, 0.0), (0.0,) * 3)
    assert control.arm("") == "mode not armable"
    assert not control.change_mode(99)
    assert not control.take(CopterSetpoint(0.5, (0.0, 0.0, 0.0), 0.0))
    assert control.change_mode(GUIDED)
    assert control.arm("Need Position Estimate") == "Need Position Estimate"
    assert control.outputs(0.0, STEP_S, estimate) == (0.0,) * 4
    assert not control.arm("")
    assert control.take(CopterSetpoint(0.5, (0.0, 0.0, 0.0), 0.0))
    assert control.outputs(0.0, STEP_S, estimate) == pytest.approx((0.5,) * 4)


@pytest.mark.parametrize(
    ("north", "east", "pitch", "roll"),
    [(0.1, 0.0, -0.1, 0.0), (0.0, 0.1, 0.0, 0.1), (5.0, -5.0, -0.35, -0.35)],
)
def test_it_tilts_towards_its_place_at_most_20_degrees(
    north: float, east: float, pitch: float, roll: float
) -> None:
    """Nose down to the front, right wing down to the right, at any heading; at most 0.35 rad each."""
    for yaw in (0.0, 0.7):
        c, s = math.cos(yaw), math.sin(yaw)
        level = math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)
        found = _tilted(level, c * north - s * east, s * north + c * east)
        expected = Rotation.from_euler("ZYX", [yaw, pitch, roll])
        assert Rotation.from_quat(found, scalar_first=True).approx_equal(expected, atol=1e-9)


def test_the_integral_of_a_rate_is_limited() -> None:
    """A turn that cannot be followed adds 0.3 of an output at most, either way."""
    control = CopterControl(dict(_DEFAULTS))
    p = _DEFAULTS["ATC_RAT_PIT_P"]
    for rate in (100.0, -100.0):
        for _ in range(2):
            moment = control._moment(1.0, 1, rate, 0.0, 0.0)
        assert moment == pytest.approx(p * rate + math.copysign(0.3, rate))
