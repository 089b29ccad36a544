"""The fail-safe that follows the reference (docs/equations.md (31a)).

Its attitude loop is in test_schedule.py.
"""

import numpy as np
import pytest

from transport.model import state
from transport.model.hover import hover
from transport.model.linearisation import Model
from transport.model.parameters import table_1
from transport.mpc.fail_safe import FailSafe
from transport.mpc.manifold import tangent

SYSTEM = table_1()
MODEL, AT_REST = Model(SYSTEM), hover(SYSTEM)
UAV = 1
OWN = state.uav_slice(UAV)
# Central differences of smooth functions of order one: their error is a thousandth of this.
STEP, SLOPE_TOLERANCE = 1e-4, 1e-6


def test_its_linearisation_is_its_gain() -> None:
    """Along every direction of the manifold at hover, (45)."""
    follows = FailSafe(SYSTEM, AT_REST.u, AT_REST.x[None])
    for step in STEP * tangent(AT_REST.x).T:
        slope = (
            follows.inputs(UAV, AT_REST.x + step, 0) - follows.inputs(UAV, AT_REST.x - step, 0)
        ) / (2.0 * STEP)
        np.testing.assert_allclose(slope, follows.gain(UAV) @ (step / STEP), atol=SLOPE_TOLERANCE)


@pytest.mark.parametrize("seed", range(4))
def test_it_accelerates_towards_the_reference(seed: int) -> None:
    """The wanted tilt turns thrust against the deviations of position and velocity, in any heading, within its bound.

    Positions and velocities are those of the model, (1), (39).
    """
    rng = np.random.default_rng(seed)
    x, x_ref = (AT_REST.x + 0.01 * rng.standard_normal(len(AT_REST.x)) for _ in range(2))
    heading = x[OWN][state.THETA][2] = rng.uniform(-np.pi, np.pi)
    follows, level = (
        FailSafe(SYSTEM, AT_REST.u, np.stack([AT_REST.x, x_ref])),
        FailSafe(SYSTEM, AT_REST.u),
    )
    uav = SYSTEM.uavs[UAV]
    stiffness = 36.0 * np.diag(np.asarray(uav.inertia))
    roll, pitch, _ = (follows.inputs(UAV, x, 7) - level.inputs(UAV, x, 7))[1:] / stiffness
    lift = AT_REST.u[state.input_slice(UAV)][0] / uav.mass
    ahead, aside = -lift * pitch, lift * roll  # acceleration by a tilt, axes of the heading
    found = [
        np.cos(heading) * ahead - np.sin(heading) * aside,
        np.sin(heading) * ahead + np.cos(heading) * aside,
    ]
    apart = (MODEL.outputs(x) - MODEL.outputs(x_ref))[3 * UAV : 3 * UAV + 2]
    drift = (MODEL.velocities(x) - MODEL.velocities(x_ref))[1 + UAV][:2]
    np.testing.assert_allclose(found, -(1.5**2) * apart - 2.0 * 1.5 * drift, rtol=1e-9)
    x[state.R0] += 100.0
    far = (follows.inputs(UAV, x, 7) - level.inputs(UAV, x, 7))[1:] / stiffness
    np.testing.assert_allclose(np.abs(far[:2]).max(), 0.2)
