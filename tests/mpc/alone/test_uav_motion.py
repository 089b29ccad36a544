"""The motion of one UAV and its deviation from a reference (docs/equations.md (1), (31e), (39))."""

import numpy as np
import pytest

from tests.support import runs
from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.hover import hover
from transport.model.physics.parameters import table_1
from transport.model.physics.rotations import rotation
from transport.mpc.alone.uav_motion import UavMotion, ahead, motion_of

SYSTEM = table_1()
AT_REST = hover(SYSTEM)
UAV, PERIOD_S = 1, 0.05
ROUNDING = 1e-9


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
    """However the reference moves, without a deviation the motion ticks later is that of the reference, (31e)."""
    rng = np.random.default_rng(6)
    motions = [at(0.0, *rng.standard_normal((4, 3))) for _ in range(4)]
    found = ahead(motions[0], 0, 3, motions.__getitem__, PERIOD_S)
    for name in UavMotion.__slots__:
        np.testing.assert_allclose(getattr(found, name), getattr(motions[3], name), atol=ROUNDING)
