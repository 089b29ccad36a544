"""The motion of one UAV and its deviation from a reference (docs/equations.md (1), (31e), (39))."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from tests.model.path.test_flatness import unequal
from tests.support import runs
from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.hover import hover
from transport.model.physics.parameters import System, table_1
from transport.model.physics.rotations import rotation
from transport.mpc.alone.uav_motion import (
    UavMotion,
    ahead,
    hover_motion_slopes,
    motion_of,
    motion_slopes,
    setpoint_of,
    turn_by_inputs,
)

SYSTEM = table_1()
AT_REST = hover(SYSTEM)
UAV, PERIOD_S = 1, 0.05
ROUNDING = 1e-9
TEAM = unequal()
RATES = System(payload=TEAM.payload, uavs=TEAM.uavs, rate_gains=[25.0, 20.0, 10.0])
# Central differences of smooth functions of order one: their error is a hundredth of this.
STEP, SLOPE_TOLERANCE = 1e-5, 1e-8


def test_motion_is_that_of_the_model() -> None:
    """Position, velocity and attitude of a UAV are those that its sensors measure without noise, (1), (39), (61)."""
    rng = np.random.default_rng(3)
    run = runs.ready("precise")
    x = AT_REST.x + 0.05 * rng.standard_normal(len(AT_REST.x))
    rods = state.StateView(x).uavs
    rods[:, state.E] /= np.linalg.norm(rods[:, state.E], axis=1)[:, None]
    rods[:, state.ROD_RATE] -= (
        rods[:, state.E] * np.sum(rods[:, state.E] * rods[:, state.ROD_RATE], axis=1)[:, None]
    )
    x[state.PAYLOAD :] = rods.reshape(-1)
    sensed = run.model.sensed(x, AT_REST.u)[state.SENSED * UAV :][: state.SENSED]
    motion = motion_of(SYSTEM, UAV, x)
    np.testing.assert_allclose(motion.position_I, sensed[state.POSITION], atol=ROUNDING)
    np.testing.assert_allclose(motion.velocity_I, sensed[state.VELOCITY], atol=ROUNDING)
    np.testing.assert_allclose(
        motion.rod_I, SYSTEM.uavs[UAV].rod_length * rotation(x[state.THETA0]) @ rods[UAV, :3]
    )
    attached_P = x[state.V0] + np.cross(x[state.OMEGA0], SYSTEM.uavs[UAV].rho)
    lower_end_I = rotation(x[state.THETA0]) @ attached_P
    np.testing.assert_allclose(motion.velocity_I + motion.swing_I, lower_end_I, atol=ROUNDING)

    u = AT_REST.u + rng.standard_normal(len(AT_REST.u))
    setpoint = setpoint_of(SYSTEM, UAV, x, u)
    np.testing.assert_array_equal(setpoint.motion.Theta, rods[UAV, state.THETA])
    np.testing.assert_array_equal(setpoint.motion.omega_B, rods[UAV, state.OMEGA])
    np.testing.assert_allclose(setpoint.inputs, u[state.input_slice(UAV)], atol=ROUNDING)
    np.testing.assert_array_equal(setpoint.turning, u[state.input_slice(UAV)][1:])


@pytest.mark.parametrize("is_hover", [False, True], ids=["anywhere", "at hover"])
def test_slopes_are_differences_of_the_motion(*, is_hover: bool) -> None:
    """By every state of the team, of UAVs with rods of unequal lengths, (31c), (31g)."""
    x = hover(TEAM).x
    if not is_hover:
        x = x + 0.3 * np.random.default_rng(4).standard_normal(len(x))
    for uav in range(TEAM.N):
        found = hover_motion_slopes(TEAM, uav) if is_hover else motion_slopes(TEAM, uav, x)
        for i, step in enumerate(STEP * np.eye(len(x))):
            later, before = motion_of(TEAM, uav, x + step), motion_of(TEAM, uav, x - step)
            for name in ("position_I", "velocity_I", "rod_I", "swing_I"):
                slope = (getattr(later, name) - getattr(before, name)) / (2.0 * STEP)
                np.testing.assert_allclose(getattr(found, name)[:, i], slope, atol=SLOPE_TOLERANCE)


@pytest.mark.parametrize("system", [TEAM, RATES], ids=["moments", "body rates"])
def test_inputs_turn_a_uav_as_its_equations_do(system: System) -> None:
    """Theta' = omega, and J omega' = tau or omega' = K (omega_c - omega), beside constant body rates: (13), (57)."""
    whole = np.zeros((9, 9))
    whole[:3, 3:6] = np.eye(3)
    if system.rate_gains is None:
        whole[3:6, 6:] = np.linalg.inv(system.uavs[UAV].inertia)
    else:
        whole[3:6, 6:] = np.diag(system.rate_gains)
        whole[3:6, 3:6] = -np.diag(system.rate_gains)
    hold = expm(PERIOD_S * whole)[:6, 3:]
    constant_rates = np.vstack([PERIOD_S * np.eye(3), np.eye(3)])
    by_inputs, by_rates = turn_by_inputs(system, UAV, PERIOD_S)
    np.testing.assert_allclose(by_inputs, hold[:, 3:], atol=ROUNDING)
    np.testing.assert_allclose(by_rates, hold[:, :3] - constant_rates, atol=ROUNDING)


def at(time_s: float, x0: Array, v: Array, Theta0: Array, omega: Array) -> UavMotion:
    """Return the motion at a time of a UAV that moves and turns at constant rates, its rod at rest."""
    rest = motion_of(SYSTEM, UAV, AT_REST.x)
    return UavMotion(
        position_I=x0 + time_s * v,
        velocity_I=v,
        Theta=Theta0 + time_s * omega,
        omega_B=omega,
        rod_I=rest.rod_I,
        swing_I=rest.swing_I,
    )


@pytest.mark.parametrize("later", [0, 1, 3])
def test_a_drifting_uav_is_expected_where_it_drifts(later: int) -> None:
    """A UAV that drifts and turns off a moving reference at constant rates is there ticks later, (31e)."""
    rng = np.random.default_rng(5)
    x_ref, v_ref, Theta_ref, omega_ref, x, v, Theta, omega = rng.standard_normal((8, 3))
    k = 10

    def reference(tick: int) -> UavMotion:
        return at(PERIOD_S * tick, x_ref, v_ref, Theta_ref, omega_ref)

    expected = at(PERIOD_S * (k + later), x, v, Theta, omega)
    found = ahead(at(PERIOD_S * k, x, v, Theta, omega), k, k + later, reference, PERIOD_S)
    for name in UavMotion.__slots__:
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=ROUNDING)


def test_a_uav_on_its_reference_stays_on_it() -> None:
    """However the reference moves, the motion ticks later is that of the reference, its rod as far off, (31e)."""
    rng = np.random.default_rng(6)
    names = UavMotion.__slots__
    motions = [
        UavMotion(**dict(zip(names, rng.standard_normal((6, 3)), strict=True))) for _ in range(4)
    ]
    off = {name: rng.standard_normal(3) for name in ("rod_I", "swing_I")}
    beside = replace(motions[0], **{name: getattr(motions[0], name) + off[name] for name in off})
    found = ahead(beside, 0, 3, motions.__getitem__, PERIOD_S)
    for name in names:
        expected = getattr(motions[3], name) + off.get(name, 0.0)
        np.testing.assert_allclose(getattr(found, name), expected, atol=ROUNDING)
