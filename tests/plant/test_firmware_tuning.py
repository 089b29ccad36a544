"""Settings of the firmware by the loop that they close, without the firmware itself."""

import math

import numpy as np
import pytest

from tests.support.runs import setup
from transport.flight.roles import plant_run
from transport.plant.firmware.tuning import (
    SETTINGS,
    AxisGains,
    largest_rates_rads,
    moments_per_output_Nm,
    rate_settings,
    rotors_of,
    tuning,
)
from transport.plant.plant_run import PlantRun
from transport.plant.rotors_and_motors import Rotors
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.sections.plant_sections import RotorsSection
from transport.protocol.scenario.setup.run_setup import Setup

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
    # The integral is slow beside it.
    assert gains.i / gains.p == pytest.approx(0.04 / time_constant_s, rel=EXACT)


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


def plant(*settings: str) -> PlantRun:
    """Return the plant of the ready scenario with body rates."""
    path = find_scenario("flight")
    return plant_run(Setup.of(read_scenario(path, settings), str(path)))


def test_each_axis_has_its_rates_and_gains() -> None:
    """Full sticks are the limits, rounded up to 10 deg/s; gains are those of the axis' time constant and inertia."""
    setup = plant(
        "controller.limits.rates_rads=[3.0,2.0,1.0]",
        "controller.rate_time_constant_s=[0.05,0.04,0.2]",
        "system.uav.2.inertia_kgm2=[0.02,0.03,0.05]",
    )
    section = rotors_of(setup)[1]
    lines = tuning(setup, setup.run.system.uavs[1], section, HOVER_N)
    given = {}
    for line in lines:
        name, value = line.removeprefix("set ").split(" = ")
        given[name] = int(value)
    assert len(given) == len(lines)
    moments_Nm = moments_per_output_Nm(section, HOVER_N)
    expected: dict[str, int] = {}
    for name, rate, time_constant_s, inertia_kgm2, moment_Nm in zip(
        ("roll", "pitch", "yaw"), (18, 12, 6), (0.05, 0.04, 0.2), (0.02, 0.03, 0.05), moments_Nm,
        strict=True,
    ):  # fmt: skip
        expected |= {f"{name}_rc_rate": rate, f"{name}_srate": rate}
        expected |= {f"{name}_expo": 0, f"f_{name}": 0, f"d_max_{name}": 0}
        expected |= AxisGains.of(time_constant_s, inertia_kgm2, moment_Nm).settings(name)
    assert given == expected
    np.testing.assert_allclose(largest_rates_rads(setup), np.radians([180.0, 120.0, 60.0]))


def test_rates_beyond_the_largest_setting_are_cut() -> None:
    """40 rad/s are 2292 deg/s; the firmware takes 2000."""
    assert rate_settings(plant("controller.limits.rates_rads=[40.0,3.0,1.0]")) == [200, 18, 6]


def test_rotors_that_no_scenario_names_carry_the_mass_of_their_uav() -> None:
    """Four quarters of its mass at 45 deg to the axes have its inertia, m a^2 / 2; a quarter of the limit each."""
    named, assumed = rotors_of(plant()), rotors_of(plant_run(setup()))
    assert [each.arm_m for each in named] == [0.246] * 4
    assert len(assumed) == 4
    for rotors, uav in zip(assumed, setup().system.uavs, strict=True):
        assert uav.mass * rotors.arm_m**2 / 2.0 == pytest.approx(uav.inertia[0, 0])
        assert rotors.drag_to_thrust_m == pytest.approx(0.1 * rotors.arm_m)
        assert rotors.thrust_N == (0.0, setup().settings.limits.thrust_N[1] / 4.0)


def test_settings_of_all_uavs() -> None:
    """AUX1 above 1700 us arms, in any attitude and at once; channels are rates without smoothing or curves."""
    assert set(SETTINGS) == {
        "aux 0 0 0 1700 2100 0 0",
        "set pwr_on_arm_grace = 0",
        "set small_angle = 180",
        "set runaway_takeoff_prevention = OFF",
        "set blackbox_device = NONE",
        "set rc_smoothing = OFF",
        "set rates_type = ACTUAL",
        "set simplified_pids_mode = OFF",
        "set min_check = 1050",
        "set motor_idle = 550",
    }
