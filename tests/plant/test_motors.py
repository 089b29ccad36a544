"""Motors of the plant: rotors, steps, lag and efficiency, by themselves and in a plant that flies."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.support.nodes import PlantNode
from tests.support.runs import ALL, plan, plant_states, recorded, roster, setup, tick, ticks
from transport.model import state
from transport.model.arrays import Array
from transport.plant.rotors_and_motors import Motors, Rotors
from transport.protocol.scenario.sections.plant_sections import MotorsSection, RotorsSection
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import ActualInputs, Message

PERIOD_S, STEPS = 0.05, 5
ROTORS = RotorsSection(arm_m=0.25, drag_to_thrust_m=0.016, thrust_N=(0.5, 12.0))
U_HOVER = np.tile([22.0, 0.0, 0.0, 0.0], 4)
# Five steps of order 4 per period against an ODE solver, over ten periods of inputs that jump, SI.
CLOSE = 1e-5
ROUNDING = 1e-12


def commands(seed: int, count: int = 1) -> Array:
    """Return random commands within the limits of the paper's UAVs, (count, 16)."""
    rng = np.random.default_rng(seed)
    return np.tile([22.0, 0.0, 0.0, 0.0], 4) + np.tile([15.0, 1.0, 1.0, 0.5], 4) * rng.uniform(
        -1.0, 1.0, (count, 16)
    )


def mean(motors: Motors, u: Array) -> Array:
    """Return the mean of the inputs over a period; they fill it."""
    found = list(motors.inputs(u, PERIOD_S, STEPS))
    assert sum(duration_s for _, duration_s in found) == pytest.approx(PERIOD_S)
    return np.asarray(sum(inputs * duration_s for inputs, duration_s in found) / PERIOD_S)


def test_rotors_have_the_wrench_of_their_thrusts() -> None:
    """The mixing is the sum of r x F over four arms at 45 deg, and of the drag moments, (56)."""
    # Positions of the rotors: x forward, y right.
    at = 0.25 * np.array([[1, 1, 0], [-1, -1, 0], [1, -1, 0], [-1, 1, 0]]) / np.sqrt(2.0)
    # About z down; opposite to the sense of rotation.
    drag = 0.016 * np.array([1.0, 1.0, -1.0, -1.0])
    thrusts = np.array([3.0, 5.0, 7.0, 4.0])
    forces = np.outer(thrusts, [0.0, 0.0, -1.0])
    moment = np.cross(at, forces).sum(axis=0)
    moment[2] += drag @ thrusts
    found = Rotors(ROTORS).mixing @ thrusts
    np.testing.assert_allclose(found, [19.0, *moment], rtol=0.0, atol=ROUNDING)


def test_limited_rotors() -> None:
    """Commands within the limits pass bit for bit.

    Of the others every rotor thrust is the nearest possible one.
    """
    rotors = Rotors(ROTORS)
    thrusts = np.random.default_rng(3).uniform(0.6, 11.9, (50, 4))
    possible = thrusts @ rotors.mixing.T
    np.testing.assert_array_equal(rotors.limited(possible), possible)
    thrusts = np.random.default_rng(4).uniform(-5.0, 20.0, (50, 4))
    found = rotors.limited(thrusts @ rotors.mixing.T) @ np.linalg.inv(rotors.mixing).T
    least, most = ROTORS.thrust_N
    np.testing.assert_allclose(found, np.clip(thrusts, least, most), rtol=0.0, atol=1e-10)
    # Motors with limits alone are not ideal.
    motors, u = Motors(MotorsSection(rotors=ROTORS), U_HOVER), 3.0 * U_HOVER
    limited = rotors.limited(u.reshape(4, 4)).reshape(-1)
    np.testing.assert_allclose(mean(motors, u), limited, rtol=0.0, atol=1e-10)


def test_steps_of_the_thrust() -> None:
    """Thrusts are the nearest multiples of the step, moments as commanded."""
    u = commands(5)[0]
    found = mean(Motors(MotorsSection(thrust_step_N=0.5), U_HOVER), u).reshape(4, 4)
    given = u.reshape(4, 4)
    np.testing.assert_allclose(
        found[:, 0], np.round(given[:, 0] * 2.0) / 2.0, rtol=0.0, atol=ROUNDING
    )
    np.testing.assert_allclose(found[:, 1:], given[:, 1:], rtol=0.0, atol=ROUNDING)


def test_lag_goes_on_from_period_to_period() -> None:
    """The mean of each period is that of the exponential from where the period before ended, (53)."""
    motors, a, lag_s = Motors(MotorsSection(lag_s=0.07), U_HOVER), U_HOVER, 0.07
    left = np.exp(-PERIOD_S / lag_s)
    for u in commands(6, 5):
        expected = u + lag_s / PERIOD_S * (1.0 - left) * (a - u)
        np.testing.assert_allclose(mean(motors, u), expected, rtol=0.0, atol=1e-10)
        a = u + left * (a - u)


def test_rotors_rise_and_fall_with_their_own_lag() -> None:
    """Each rotor follows the exponential of its direction, (56a).

    Equal time constants are one, bit for bit.
    """
    one, two = (
        MotorsSection(lag_s=0.02, falling_lag_s=falling_s, rotors=ROTORS)
        for falling_s in (None, 0.05)
    )
    same = Motors(one.model_copy(update={"falling_lag_s": 0.02}), U_HOVER)
    rotors, motors, single = Rotors(ROTORS), Motors(two, U_HOVER), Motors(one, U_HOVER)
    a = rotors.thrusts(U_HOVER.reshape(4, 4))
    for u in commands(9, 5):
        aim = rotors.thrusts(rotors.limited(u.reshape(4, 4)))
        lags_s = np.where(aim > a, 0.02, 0.05)
        left = np.exp(-PERIOD_S / lags_s)
        expected = (aim + lags_s / PERIOD_S * (1.0 - left) * (a - aim)) @ rotors.mixing.T
        np.testing.assert_allclose(mean(motors, u), expected.reshape(-1), rtol=0.0, atol=1e-10)
        np.testing.assert_array_equal(mean(same, u), mean(single, u))
        a = aim + left * (a - aim)


def test_efficiency() -> None:
    """A degraded UAV gives a share of thrust and moments, a motor-off one nothing at once.

    The others all.
    """
    motors, u = Motors(MotorsSection(lag_s=0.07), U_HOVER, fails=True), commands(7)[0]
    whole = mean(Motors(MotorsSection(lag_s=0.07), U_HOVER), u)
    motors.degrade(1, 0.8)
    motors.degrade(3, 0.0)
    share = np.repeat([1.0, 0.8, 1.0, 0.0], 4)
    np.testing.assert_allclose(mean(motors, u), share * whole, rtol=0.0, atol=ROUNDING)


def flown(run: Setup, U: Array) -> list[Message]:
    """Return the plant's messages while agents announce given inputs, (ticks, 16)."""
    node = PlantNode(run)
    messages = list(node.receive(roster(), 0))
    for k, u in enumerate(U):
        messages += node.receive(tick(k), 0)
        for agent in ALL:
            own = u[state.input_slice(agent - 1)]
            messages += node.receive(plan(run, agent, k, inputs=np.tile(own, (20, 1))), 0)
    return messages


def test_the_plant_follows_the_augmented_equations() -> None:
    """States of a run with lag are those of x' = f(x, a), a' = (u - a) / lag by an ODE solver, period by period."""
    lag_s = 0.03
    run = setup(f"plant.motors.lag_s={lag_s}")
    U = run.hover.u + 0.2 * (commands(8, 10) - U_HOVER)
    found = plant_states(flown(run, U))
    n = run.system.n
    z = np.concatenate([run.initial_state(), run.hover.u])
    for k, u in enumerate(U):
        np.testing.assert_array_equal(found[k].u, u)  # the record has the commands
        np.testing.assert_allclose(found[k].x, z[:n], rtol=0.0, atol=CLOSE)

        def slope(_: float, z: Array, u: Array = u) -> Array:
            return np.concatenate([run.model.derivative(z[:n], z[n:]), (u - z[n:]) / lag_s])

        z = solve_ivp(slope, (0.0, PERIOD_S), z, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    assert np.abs(z[:n] - run.initial_state()).max() > 0.1


def test_actual_inputs_are_recorded_where_they_differ() -> None:
    """A degraded UAV's inputs stand in the record from its tick on.

    A run with ideal motors has no such messages.
    """
    event = "faults.event=[{at_s=0.1,do='degrade',target='uav2',efficiency=0.9}]"
    run = setup(ticks(4), event)
    messages = recorded(run)
    found = [message for message in messages if isinstance(message, ActualInputs)]
    assert [message.tick for message in found] == [0, 1, 2, 3]
    for message, before in zip(found, plant_states(messages), strict=True):
        share = np.ones((4, 1))
        share[1] = 0.9 if message.tick >= 2 else 1.0
        np.testing.assert_allclose(
            message.inputs, share * before.u.reshape(4, 4), rtol=0.0, atol=ROUNDING
        )
    assert not any(isinstance(message, ActualInputs) for message in recorded(setup(ticks(4))))


def test_motors_that_are_off_give_nothing() -> None:
    """Ideal motors too, although an inner loop, such as an armed autopilot, goes on idling."""
    motors = Motors(MotorsSection(), U_HOVER)
    motors.degrade(1, 0.0)
    actual = mean(motors, U_HOVER).reshape(4, 4)
    expected = U_HOVER.reshape(4, 4).copy()
    expected[1] = 0.0
    np.testing.assert_array_equal(actual, expected)
