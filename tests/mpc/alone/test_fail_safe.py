"""The fail-safe, level or following the reference; its attitude loop is in test_schedule.py, the law in test_alone."""

import numpy as np
import pytest

from transport.model import state
from transport.model.physics.hover import hover
from transport.model.physics.parameters import table_1
from transport.mpc.alone.fail_safe import FailSafe

SYSTEM = table_1()
AT_REST = hover(SYSTEM)


def test_level_is_linear_in_the_attitude() -> None:
    """Without reference the inputs are hover thrust and the gain times the UAV's block of the state, (31)."""
    level, x = FailSafe(SYSTEM, AT_REST.u), AT_REST.x + 0.01 * np.arange(len(AT_REST.x))
    for uav in range(SYSTEM.N):
        rest = AT_REST.u[state.input_slice(uav)] * np.array([1.0, 0.0, 0.0, 0.0])
        np.testing.assert_allclose(level.inputs(uav, x, 0), rest + level.gain(uav) @ x)


def test_level_has_no_setpoint() -> None:
    """A fail-safe that keeps level has no part of a reference, and its integral stays."""
    level = FailSafe(SYSTEM, AT_REST.u)
    assert not level.follows
    with pytest.raises(ValueError, match="keeps level"):
        level.setpoint(0, 0)
    held = np.array([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(level.integral_after(0, AT_REST.x, 0, held, 0.05), held)


@pytest.mark.parametrize(
    ("period_s", "steps", "expected"), [(0.05, 20, 8), (0.05, 4, 4), (2.0, 3, 1)]
)
def test_one_that_follows_takes_over_soon(period_s: float, steps: int, expected: int) -> None:
    """It comes 0.4 s after the begin of the last plan, or at its end; the one that keeps level at the end."""
    follows = FailSafe(SYSTEM, AT_REST.u, AT_REST.x[None])
    assert follows.played(steps, period_s) == expected
    assert FailSafe(SYSTEM, AT_REST.u).played(steps, period_s) == steps
