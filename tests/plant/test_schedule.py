"""Actuator schedule: the newest plan that has started, to its end, then the fail-safe."""

import numpy as np
import pytest

from transport.model import state
from transport.model.arrays import Array
from transport.model.parameters import Payload, System, Uav
from transport.model.rotations import euler_rates, rotation
from transport.mpc.fail_safe import FailSafe
from transport.mpc.settings import ControllerSettings, Limits
from transport.plant.actuators import ActuatorSchedule
from transport.protocol.wire.messages import Plan

N, STEPS = 3, 4
OWNED = {1: (1, 3), 2: (2,)}
U_HOVER = np.tile([20.0, 0.0, 0.0, 0.0], N) + np.repeat([0.0, 1.0, 2.0], 4) * np.tile(
    [1.0, 0.0, 0.0, 0.0], N
)
J = np.diag([0.029, 0.029, 0.055])
SYSTEM = System(
    payload=Payload(mass=3.0, inertia=[0.556, 0.556, 0.556]),
    uavs=[
        Uav(mass=1.5, inertia=J, rho=[x, 0.0, -0.125], rod_length=3.2) for x in (-0.25, 0.0, 0.25)
    ],
)
LIMITS = Limits()
X = np.zeros(12 + 12 * N)

PERIOD_S, SUBSTEPS = (
    0.05,
    50,
)  # 1 ms: Euler steps are then accurate to a fraction of a degree over seconds

# The loop's real part is 0.8 x 6 / s and saturation costs some tenths of a second: three seconds
# are many of its time constants, and what is left is far below a degree.
SETTLING_S, LEVEL_RAD, STILL_RAD_S = 3.0, np.radians(0.5), 0.02
RATE_SLACK = 1e-12  # N and N m: rounding of a sum and a difference


def schedule(*plans: Plan, limits: Limits = LIMITS) -> ActuatorSchedule:
    """Return a schedule with some plans."""
    found = ActuatorSchedule(U_HOVER, FailSafe(SYSTEM, U_HOVER), ControllerSettings(limits=limits))
    for plan in plans:
        found.add(plan)
    return found


def labelled(agent: int, k: int, delay: int = 0) -> Plan:
    """Return a plan whose numbers encode UAV, tick and step."""
    uavs = OWNED[agent]
    columns = np.concatenate([100.0 * uav + np.arange(4.0) / 10.0 for uav in uavs])
    return Plan(
        sender=f"agent{agent}",
        incarnation=0,
        sequence=0,
        tick=k,
        agent=agent,
        start_tick=k + delay,
        negotiation=0,
        shared=True,
        uavs=uavs,
        uav_states=np.zeros((len(uavs), 12)),
        inputs=1000.0 * k + np.arange(STEPS)[:, None] + columns,
        corrections=np.zeros((0, len(columns))),
        status="solved",
    )


def played(plans: ActuatorSchedule, k: int, x: Array = X) -> tuple[list[float], tuple[int, ...]]:
    """Return the thrust of each UAV at a tick, and the sources of the inputs."""
    u, sources = plans.inputs(k, x, U_HOVER)
    return u[::4].tolist(), sources


def test_plan_is_played_step_by_step() -> None:
    """A plan acts from its start tick on, one step per tick, on exactly the UAVs it is for."""
    plans = schedule(labelled(1, 0), labelled(2, 0))
    for k in range(STEPS):
        u, sources = plans.inputs(k, X, U_HOVER)
        np.testing.assert_array_equal(u[state.input_slice(0)], labelled(1, 0).inputs[k, :4])
        np.testing.assert_array_equal(u[state.input_slice(1)], labelled(2, 0).inputs[k])
        np.testing.assert_array_equal(u[state.input_slice(2)], labelled(1, 0).inputs[k, 4:])
        assert sources == (0, 0, 0)


def test_a_fail_safe_that_follows_takes_over_before_the_end() -> None:
    """Where the UAV can follow the reference alone, it does so after 0.4 s of its last plan."""
    follows = FailSafe(SYSTEM, U_HOVER, X[None])
    plans = ActuatorSchedule(U_HOVER, follows, ControllerSettings(sampling_period_s=0.2))
    plans.add(labelled(2, 0))
    sources = [plans.inputs(k, X, U_HOVER)[1][1] for k in range(STEPS)]
    assert sources == [0, 0, -2, -2]


def test_newest_plan_wins() -> None:
    """A newer plan takes over at its start, not before; a late older one changes nothing."""
    plans = schedule(labelled(2, 0), labelled(2, 2))
    assert played(plans, 1)[0][1] == 201.0
    assert played(plans, 2) == ([20.0, 2200.0, 22.0], (-1, 2, -1))
    plans.add(labelled(2, 1))
    assert played(plans, 3) == ([20.0, 2201.0, 22.0], (-1, 2, -1))


def test_order_of_arrival_does_not_matter() -> None:
    """The order of adding plans has no effect."""
    rng = np.random.default_rng(5)
    plans = [labelled(agent, k, delay=1) for agent in OWNED for k in (0, 1, 3, 4)]
    in_order = [played(schedule(*plans), k) for k in range(10)]
    for _ in range(20):
        shuffled = schedule(*[plans[i] for i in rng.permutation(len(plans))])
        assert [played(shuffled, k) for k in range(10)] == in_order


def test_fail_safe_law() -> None:
    """Small errors: moments J (-36 (roll, pitch, 0) - 9.6 omega). Source: docs/equations.md (31)."""
    x = X.copy()
    x[state.uav_slice(1)][state.THETA] = [0.02, -0.01, 1.0]
    x[state.uav_slice(1)][state.OMEGA] = [0.1, 0.2, -0.3]
    u, _ = schedule(labelled(2, 0)).inputs(STEPS, x, U_HOVER)
    expected = J @ (-36.0 * np.array([0.02, -0.01, 0.0]) - 9.6 * np.array([0.1, 0.2, -0.3]))
    # Same arithmetic in another order: rounding only.
    np.testing.assert_allclose(u[state.input_slice(1)], [21.0, *expected], rtol=1e-14)


@pytest.mark.parametrize("seed", range(10))
def test_fail_safe_levels(seed: int) -> None:
    """From any tilt up to 60 deg, turning at up to 3 rad/s, a UAV is level and at rest after some seconds."""
    rng = np.random.default_rng(seed)
    tilt, heading = np.radians(rng.uniform(20.0, 60.0)), rng.uniform(-np.pi, np.pi)
    Theta = np.array([tilt * np.cos(heading), tilt * np.sin(heading), rng.uniform(-np.pi, np.pi)])
    omega = rng.uniform(-3.0, 3.0, 3)
    plans = schedule(labelled(2, 0))
    x, u = X.copy(), U_HOVER
    for k in range(round(SETTLING_S / PERIOD_S)):
        x[state.uav_slice(1)][state.THETA], x[state.uav_slice(1)][state.OMEGA] = Theta, omega
        u, _ = plans.inputs(STEPS + k, x, u)
        Theta, omega = attitude_after(Theta, omega, u[state.input_slice(1)][1:])
    upright = rotation(Theta)[2, 2]
    assert np.arccos(min(upright, 1.0)) < LEVEL_RAD
    assert np.abs(omega).max() < STILL_RAD_S


def attitude_after(Theta: Array, omega: Array, tau: Array) -> tuple[Array, Array]:
    """Attitude and rates of a rigid UAV after one period under constant moments (its rod pulls at its centre)."""
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
    low, high, step = settings.lower(N), settings.upper(N), settings.largest_step(N)
    plans = schedule(labelled(1, 0), labelled(2, 0))
    before = rng.uniform(low, high)
    for _ in range(50):
        u, _ = plans.inputs(STEPS, rng.normal(0.0, 30.0, len(X)), before)
        assert (low <= u).all()
        assert (u <= high).all()
        assert (np.abs(u - before) <= step + RATE_SLACK).all()
        before = u
