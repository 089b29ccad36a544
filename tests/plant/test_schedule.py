"""Actuator schedule: the newest plan that has started, to its end, then the fail-safe."""

import numpy as np
import pytest
from msgspec.structs import replace

from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.hover import hover
from transport.model.physics.parameters import Payload, System, Uav
from transport.model.physics.rotations import euler_rates, rotation
from transport.mpc.alone.fail_safe import FailSafe
from transport.mpc.settings_period_horizon_weights import ControllerSettings, Limits
from transport.plant.actuator_schedule import BEFORE_ANY_PLAN, FAIL_SAFE, ActuatorSchedule
from transport.protocol.wire.messages import Plan

STEPS = 4  # of each plan
OWNED = {1: (1, 3), 2: (2,)}  # UAVs, 1-based, by agent
# The UAV of agent 2, 0-based: tests of the fail-safe observe it.
UAV = 1

J = np.diag([0.029, 0.029, 0.055])
SYSTEM = System(
    payload=Payload(mass=3.0, inertia=[0.556, 0.556, 0.556]),
    uavs=[
        Uav(mass=1.5, inertia=J, rho=[x, 0.0, -0.125], rod_length=3.2) for x in (-0.25, 0.0, 0.25)
    ],
)
N = SYSTEM.N
LIMITS = Limits()

# Thrusts that no plan below has, another one for each UAV, so that hover shows which UAV it is of.
HOVER_THRUSTS_N = [20.0, 21.0, 22.0]
U_HOVER = np.zeros(state.INPUTS * N)
U_HOVER[:: state.INPUTS] = HOVER_THRUSTS_N
# Level and at rest. Plans are played in any state; the fail-safe that keeps level reads attitudes
# alone.
X = np.zeros(SYSTEM.n)

PERIOD_S = 0.05
# 1 ms: Euler steps are then accurate to a fraction of a degree over seconds.
SUBSTEPS = 50

# The loop's real part is 0.8 x 6 / s and saturation costs some tenths of a second: three seconds
# are many of its time constants, and what is left is far below a degree.
SETTLING_S = 3.0
LEVEL_RAD = np.radians(0.5)
STILL_RAD_S = 0.02
RATE_SLACK = 1e-12  # N and N m: rounding of a sum and a difference


def schedule(
    *plans: Plan, fail_safe: FailSafe | None = None, period_s: float = PERIOD_S
) -> ActuatorSchedule:
    """Return a schedule with some plans, by default with the fail-safe that keeps level."""
    keeps_level = FailSafe(SYSTEM, U_HOVER)
    settings = ControllerSettings(limits=LIMITS, sampling_period_s=period_s)
    actuators = ActuatorSchedule(U_HOVER, keeps_level if fail_safe is None else fail_safe, settings)
    for plan in plans:
        actuators.add(plan)
    return actuators


def labelled_N(uav: int, made: int, step: int) -> float:
    """Return the thrust of a UAV, 1-based, at a step of a `labelled` plan made at a tick."""
    return 1000.0 * made + 100.0 * uav + step


def labelled(agent: int, made: int, delay: int = 0) -> Plan:
    """Return a plan made at a tick that starts `delay` ticks later.

    Each of its numbers tells UAV, tick and step, and by its tenths the input.
    """
    uavs = OWNED[agent]
    tenths = np.arange(state.INPUTS) / 10.0
    inputs = [
        np.concatenate([labelled_N(uav, made, step) + tenths for uav in uavs])
        for step in range(STEPS)
    ]
    return Plan(
        sender=f"agent{agent}",
        incarnation=0,
        sequence=0,
        tick=made,
        agent=agent,
        start_tick=made + delay,
        negotiation=0,
        shared=True,
        uavs=uavs,
        uav_states=np.zeros((len(uavs), state.PER_UAV)),
        inputs=np.array(inputs),
        corrections=np.zeros((0, state.INPUTS * len(uavs))),
        status="solved",
    )


def played(actuators: ActuatorSchedule, k: int) -> tuple[list[float], tuple[int, ...]]:
    """Return the thrust of each UAV at a tick, and the sources of the inputs."""
    u, sources = actuators.inputs(k, X, U_HOVER)
    return u[:: state.INPUTS].tolist(), sources


def with_plan(made: int, step: int) -> tuple[list[float], tuple[int, ...]]:
    """Return what is `played` at a step of a plan of agent 2 while agent 1 has none."""
    thrusts_N = list(HOVER_THRUSTS_N)
    thrusts_N[UAV] = labelled_N(UAV + 1, made, step)
    return thrusts_N, (BEFORE_ANY_PLAN, made, BEFORE_ANY_PLAN)


def test_plan_is_played_step_by_step() -> None:
    """A plan acts from its start tick on, one step per tick, on exactly the UAVs it is for."""
    of_two_uavs = labelled(1, 0)
    of_one_uav = labelled(2, 0)
    actuators = schedule(of_two_uavs, of_one_uav)
    for k in range(STEPS):
        u, sources = actuators.inputs(k, X, U_HOVER)
        np.testing.assert_array_equal(u[state.input_slice(0)], of_two_uavs.inputs[k, :4])
        np.testing.assert_array_equal(u[state.input_slice(1)], of_one_uav.inputs[k])
        np.testing.assert_array_equal(u[state.input_slice(2)], of_two_uavs.inputs[k, 4:])
        assert sources == (0, 0, 0)


def test_a_fail_safe_that_follows_takes_over_before_the_end() -> None:
    """Where the UAV can follow the reference alone, it does so after 0.4 s of its last plan."""
    follows = FailSafe(SYSTEM, U_HOVER, X[None])
    actuators = schedule(labelled(2, 0), fail_safe=follows, period_s=0.2)
    sources = [actuators.inputs(k, X, U_HOVER)[1][UAV] for k in range(STEPS)]
    assert sources == [0, 0, FAIL_SAFE, FAIL_SAFE]


def test_copies_of_old_inputs_do_not_put_off_the_fail_safe() -> None:
    """A plan says how long ago its inputs were fresh, and they are played from then on, however often sent.

    A fresh plan ends the fail-safe.
    """
    copies = [replace(labelled(2, made), stale=made) for made in range(2 * STEPS)]
    fresh = labelled(2, 2 * STEPS)
    actuators = schedule(*copies, fresh)
    sources = [actuators.inputs(k, X, U_HOVER)[1][UAV] for k in range(2 * STEPS + 1)]
    assert sources == [*range(STEPS), *[FAIL_SAFE] * STEPS, 2 * STEPS]


def test_the_integral_begins_anew_after_a_plan() -> None:
    """The fail-safe that follows knows nothing of an earlier time on it once a plan has come back.

    Its integral holds the force that pushed the UAV then. Another force may act now, which the plan
    has answered.
    """
    at_rest = hover(SYSTEM)
    follows = FailSafe(SYSTEM, at_rest.u, at_rest.x[None])
    aside = at_rest.x.copy()
    aside[state.R0] += [0.1, 0.0, 0.0]  # m off the reference: the integral grows with every tick

    def thrusts_and_moments(actuators: ActuatorSchedule, first: int) -> list[Array]:
        """Return the UAV's inputs on the fail-safe at the ticks from one on."""
        ticks = range(first, first + STEPS)
        inputs = []
        for k in ticks:
            u, sources = actuators.inputs(k, aside, at_rest.u)
            assert sources[UAV] == FAIL_SAFE
            inputs.append(u[state.input_slice(UAV)])
        return inputs

    actuators = schedule(labelled(2, 0), fail_safe=follows)
    first_time = thrusts_and_moments(actuators, STEPS)
    assert not np.array_equal(first_time[0], first_time[-1])  # the integral shows

    returned = 2 * STEPS
    actuators.add(labelled(2, returned))
    assert actuators.inputs(returned, aside, at_rest.u)[1][UAV] == returned
    second_time = thrusts_and_moments(actuators, returned + STEPS)
    np.testing.assert_array_equal(second_time, first_time)


def test_newest_plan_wins() -> None:
    """A newer plan takes over at its start, not before; a late older one changes nothing."""
    actuators = schedule(labelled(2, 0), labelled(2, 2))
    assert played(actuators, 1) == with_plan(made=0, step=1)
    assert played(actuators, 2) == with_plan(made=2, step=0)
    actuators.add(labelled(2, 1))
    assert played(actuators, 3) == with_plan(made=2, step=1)


@pytest.mark.parametrize("is_newer_first", [False, True])
def test_of_plans_with_one_start_the_newest_wins(is_newer_first: bool) -> None:
    """Among plans that start at the same tick that of the later tick acts, in any order of arrival."""
    older = labelled(2, 2, delay=1)
    newer = labelled(2, 3)
    plans = (newer, older) if is_newer_first else (older, newer)
    assert played(schedule(*plans), newer.start_tick) == with_plan(made=newer.tick, step=0)


def test_order_of_arrival_does_not_matter() -> None:
    """The order of adding plans has no effect, also where two of them start at the same tick."""
    rng = np.random.default_rng(5)
    start_ticks = {0: 1, 1: 2, 3: 4, 4: 4}  # by the tick at which a plan is made
    plans = [
        labelled(agent, made, delay=start - made)
        for agent in OWNED
        for made, start in start_ticks.items()
    ]
    ticks = range(max(start_ticks.values()) + STEPS + 1)  # the last one is on the fail-safe

    def all_played(actuators: ActuatorSchedule) -> list[tuple[list[float], tuple[int, ...]]]:
        return [played(actuators, k) for k in ticks]

    in_order = all_played(schedule(*plans))
    for _ in range(20):
        shuffled = [plans[place] for place in rng.permutation(len(plans))]
        assert all_played(schedule(*shuffled)) == in_order


def test_fail_safe_law() -> None:
    """Small errors: moments J (-36 (roll, pitch, 0) - 9.6 omega). Source: docs/equations.md (31)."""
    roll, pitch, yaw = 0.02, -0.01, 1.0
    omega = np.array([0.1, 0.2, -0.3])
    x = X.copy()
    x[state.uav_slice(UAV)][state.THETA] = [roll, pitch, yaw]
    x[state.uav_slice(UAV)][state.OMEGA] = omega
    u, _ = schedule(labelled(2, 0)).inputs(STEPS, x, U_HOVER)

    moments_Nm = J @ (-36.0 * np.array([roll, pitch, 0.0]) - 9.6 * omega)
    expected = [HOVER_THRUSTS_N[UAV], *moments_Nm]
    # Same arithmetic in another order: rounding only.
    np.testing.assert_allclose(u[state.input_slice(UAV)], expected, rtol=1e-14)


@pytest.mark.parametrize("seed", range(10))
def test_fail_safe_levels(seed: int) -> None:
    """From any tilt up to 60 deg, turning at up to 3 rad/s, a UAV is level and at rest after some seconds."""
    rng = np.random.default_rng(seed)
    tilt = np.radians(rng.uniform(20.0, 60.0))
    direction = rng.uniform(-np.pi, np.pi)
    yaw = rng.uniform(-np.pi, np.pi)
    Theta = np.array([tilt * np.cos(direction), tilt * np.sin(direction), yaw])
    omega = rng.uniform(-3.0, 3.0, 3)
    actuators = schedule(labelled(2, 0))
    x = X.copy()
    u = U_HOVER
    for k in range(round(SETTLING_S / PERIOD_S)):
        x[state.uav_slice(UAV)][state.THETA] = Theta
        x[state.uav_slice(UAV)][state.OMEGA] = omega
        u, _ = actuators.inputs(STEPS + k, x, u)
        moments_Nm = u[state.input_slice(UAV)][1:]
        Theta, omega = attitude_after(Theta, omega, moments_Nm)
    upright = rotation(Theta)[2, 2]
    assert np.arccos(min(upright, 1.0)) < LEVEL_RAD
    assert np.abs(omega).max() < STILL_RAD_S


def attitude_after(Theta: Array, omega: Array, tau: Array) -> tuple[Array, Array]:
    """Return attitude and rates of a rigid UAV after one period under constant moments.

    Its rod pulls at its centre, so that it turns by its own moments alone.
    """
    h = PERIOD_S / SUBSTEPS
    for _ in range(SUBSTEPS):
        Theta = Theta + h * euler_rates(Theta) @ omega
        omega = omega + h * np.linalg.solve(J, tau - np.cross(omega, J @ omega))
    return Theta, omega


@pytest.mark.parametrize("seed", range(5))
def test_fail_safe_keeps_the_limits(seed: int) -> None:
    """The fail-safe keeps the bounds and rates of the actuators at any attitude and rate."""
    rng = np.random.default_rng(seed)
    settings = ControllerSettings(limits=LIMITS, sampling_period_s=PERIOD_S)
    lower = settings.lower(N)
    upper = settings.upper(N)
    largest_step = settings.largest_step(N)
    actuators = schedule(labelled(1, 0), labelled(2, 0))
    u_before = rng.uniform(lower, upper)
    for _ in range(50):
        # States that no run has: attitudes and rates of tens of rad and rad/s want far more than the
        # limits.
        x = rng.normal(0.0, 30.0, len(X))
        u, _ = actuators.inputs(STEPS, x, u_before)
        assert (lower <= u).all()
        assert (u <= upper).all()
        assert (np.abs(u - u_before) <= largest_step + RATE_SLACK).all()
        u_before = u
