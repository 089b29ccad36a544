"""Rotations: each formula against the property that defines it, over the whole range of angles."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.support.random_systems import random_attitude
from transport.model.arrays import Array
from transport.model.physics.rotations import euler_angles, euler_rates, rotation

# Entries are sums of two products of numbers up to 1.
ROUNDING = 1e-15
# arcsin loses half the digits near 90 deg of pitch; up to PITCH_MAX they are amplified by 1 /
# cos(1.5) = 14.
PITCH_MAX = 1.5
ANGLE_TOLERANCE = 1e-13
SINGULAR_TOLERANCE = 1e-7  # half the digits, and what they do to the entries
# Central differences of second order with h = 1e-5: h^2 / 6 times rates of order 10 cubed.
RATE_STEP_S = 1e-5
RATE_TOLERANCE = 1e-6

angle = st.floats(-np.pi, np.pi)
attitudes = st.tuples(angle, st.floats(-PITCH_MAX, PITCH_MAX), angle).map(np.array)
any_attitude = st.tuples(angle, st.floats(-np.pi / 2, np.pi / 2), angle).map(np.array)
# The same examples on every run and nothing written next to the tests.
repeatable = settings(derandomize=True, database=None, deadline=None, max_examples=100)


@repeatable
@given(Theta=any_attitude)
def test_rotation_is_scipys_3_2_1_sequence(Theta: Array) -> None:
    """R = Rz(yaw) Ry(pitch) Rx(roll), the 3-2-1 parametrisation of paper section II-B."""
    expected = Rotation.from_euler("ZYX", Theta[::-1]).as_matrix()
    assert np.abs(rotation(Theta) - expected).max() < 2.0 * ROUNDING


@repeatable
@given(Theta=attitudes)
def test_euler_angles_invert_rotation(Theta: Array) -> None:
    """euler_angles(rotation(Theta)) = Theta up to whole turns of roll and yaw, away from 90 deg of pitch."""
    turn = euler_angles(rotation(Theta)) - Theta
    assert np.abs((turn + np.pi) % (2.0 * np.pi) - np.pi).max() < ANGLE_TOLERANCE


@repeatable
@given(Theta=any_attitude)
def test_euler_angles_reproduce_the_matrix(Theta: Array) -> None:
    """rotation(euler_angles(R)) = R also close to 90 deg, where arcsin keeps half the digits of the pitch."""
    R = rotation(Theta)
    assert np.abs(rotation(euler_angles(R)) - R).max() < SINGULAR_TOLERANCE


def test_euler_angles_reproduce_the_singular_matrix() -> None:
    """At exactly 90 deg of pitch one of roll and yaw is free.

    The other still has to carry the turn.
    """
    sin, cos = np.sin(0.4), np.cos(0.4)
    R = np.array([[0.0, sin, cos], [0.0, cos, -sin], [-1.0, 0.0, 0.0]])
    assert np.abs(rotation(euler_angles(R)) - R).max() < SINGULAR_TOLERANCE


@pytest.mark.parametrize("draw", range(10))
def test_euler_rates_are_those_of_the_turning_body(draw: int) -> None:
    """With Theta' = E omega, R' = R omega^x, paper (5), (6): omega has body components."""
    rng = np.random.default_rng(1700 + draw)
    Theta, omega = random_attitude(rng), rng.normal(0.0, 2.0, 3)
    step = RATE_STEP_S * euler_rates(Theta) @ omega
    R_dot = (rotation(Theta + step) - rotation(Theta - step)) / (2.0 * RATE_STEP_S)
    assert np.abs(R_dot - rotation(Theta) @ np.cross(np.eye(3), omega)).max() < RATE_TOLERANCE


@pytest.mark.parametrize("function", [rotation, euler_rates])
def test_symbolic_and_numeric_forms_agree(function: object) -> None:
    """The expressions the dynamics are built from evaluate to what the numeric form returns."""
    assert callable(function)
    Theta = random_attitude(np.random.default_rng(1800))
    symbol = ca.SX.sym("a", 3)
    symbolic = np.asarray(ca.Function("f", [symbol], [function(symbol)])(Theta).full())
    assert np.abs(symbolic - function(Theta)).max() < 4.0 * ROUNDING
