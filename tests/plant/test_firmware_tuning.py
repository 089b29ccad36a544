"""Settings of the firmware by the loop that they close, without the firmware itself."""

import math

import numpy as np
import pytest

from transport.plant.firmware.tuning import AxisGains, moments_per_output_Nm
from transport.plant.rotors_and_motors import Rotors
from transport.protocol.scenario.sections.plant_sections import RotorsSection

ROTORS = RotorsSection(arm_m=0.2, drag_to_thrust_m=0.016, thrust_N=(0.0, 11.25))
HOVER_N = 22.0725
INERTIA_KGM2 = 0.03
MOMENT_NM = 10.0  # of a unit of output
STEP = 1e-6
EXACT = 1e-12  # relative
DERIVATIVE = 1e-6  # relative: central differences


@pytest.mark.parametrize("time_constant_s", [0.02, 0.04, 0.1])
def test_the_loop_has_the_time_constant(time_constant_s: float) -> None:
    """J omega' = b (p (command - omega) - d omega') decays with p b / (J + d b) = 1 / time constant."""
    gains = AxisGains.of(time_constant_s, INERTIA_KGM2, MOMENT_NM)
    rate = gains.p * MOMENT_NM / (INERTIA_KGM2 + gains.d * MOMENT_NM)
    assert rate == pytest.approx(1.0 / time_constant_s, rel=EXACT)


def test_a_loop_faster_than_the_derivative_allows_is_slower_than_asked() -> None:
    """Below a time constant of 8 ms the factor on the gain stays 2, and does not grow to infinity at 4 ms."""
    at_limit, beyond = (AxisGains.of(s, INERTIA_KGM2, MOMENT_NM) for s in (0.008, 0.004))
    assert beyond.p == pytest.approx(2.0 * at_limit.p, rel=EXACT)


def test_a_unit_of_output_makes_the_moment_of_the_rotors() -> None:
    """The derivative of the moments by the outputs at hover, with rotors that push T_max o^2."""
    mixing = Rotors(ROTORS).mixing
    hover = math.sqrt(HOVER_N / 4.0 / ROTORS.thrust_N[1])
    expected = []
    for row in mixing[1:]:
        signs = np.sign(row)
        up, down = (hover + step * signs for step in (STEP, -STEP))
        expected.append(row @ (ROTORS.thrust_N[1] * (up**2 - down**2)) / (2.0 * STEP))
    found = moments_per_output_Nm(ROTORS, HOVER_N)
    np.testing.assert_allclose(found, expected, rtol=DERIVATIVE)


def test_settings_are_in_the_units_of_the_firmware() -> None:
    """0.5 of full output per rad/s is 8.73e-3 per deg/s, 272 units: the largest one is 250; i and d likewise."""
    gains = AxisGains(p=0.05, i=0.5, d=0.005)
    assert gains.settings("roll") == {"p_roll": 27, "i_roll": 36, "d_roll": 165}
    assert AxisGains(p=0.5, i=0.0, d=0.0).settings("yaw")["p_yaw"] == 250
