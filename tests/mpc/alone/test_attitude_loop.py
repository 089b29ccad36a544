"""The attitude loop of a UAV without a plan (docs/equations.md (31), (31b), (58))."""

import numpy as np
import pytest

from transport.model.physics.parameters import System, table_1
from transport.mpc.alone.attitude_loop import LEVELLING, OuterGain, attitude_loop

PAPER = table_1()
# That of a UAV alone.
FOLLOWING = OuterGain(share=0.5, largest=10.0)
ROUNDING = 1e-6  # of a double pole, whose error is the root of that of its coefficients


@pytest.mark.parametrize(
    ("outer", "damping_ratio"),
    [(LEVELLING, 1.0), (FOLLOWING, np.sqrt(0.5))],
    ids=["level", "follow"],
)
@pytest.mark.parametrize("K", [5.0, 10.0, 20.0])
def test_both_loops_together_have_their_damping(
    outer: OuterGain, damping_ratio: float, K: float
) -> None:
    """The poles of an attitude whose body rate follows its command with a lag of 1 / K, (57), (58)."""
    system = System(payload=PAPER.payload, uavs=PAPER.uavs, rate_gains=[K, K, K])
    gain = attitude_loop(system, 0, outer, frequency_rad_s=6.0, heading=0.0).stiffness[0, 0]

    # dTheta/dt = omega, domega/dt = K (-gain Theta - omega)
    poles = np.linalg.eigvals(np.array([[0.0, 1.0], [-K * gain, -K]]))
    found = -poles.sum().real / (2.0 * np.sqrt(poles.prod().real))
    assert found == pytest.approx(damping_ratio, abs=ROUNDING)
