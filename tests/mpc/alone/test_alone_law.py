"""The control law of a UAV alone (docs/equations.md (31a)-(31e))."""

from dataclasses import replace
from functools import lru_cache
from itertools import product

import numpy as np
import pytest

from tests.support import runs
from transport.model import state
from transport.model.arrays import Array
from transport.model.kernels import native
from transport.model.linear.discretisation import zero_order_hold
from transport.model.physics.hover import hover
from transport.model.physics.parameters import System, table_1
from transport.mpc.alone.alone_law import GAINS, AloneLaw, steps_alone
from transport.mpc.alone.compiled_alone_law import CompiledAloneLaw
from transport.mpc.alone.fail_safe import FailSafe
from transport.mpc.alone.uav_motion import Setpoint, UavMotion, motion_of, setpoint_of
from transport.mpc.controller import Controller
from transport.mpc.law.tangent import tangent
from transport.mpc.margins.actual_plant import Mismatch
from transport.protocol.scenario.setup.run_setup import Setup

SYSTEM = table_1()
RATES = System(payload=SYSTEM.payload, uavs=SYSTEM.uavs, rate_gains=[25.0, 25.0, 10.0])
# An inner loop without noticeable lag.
FAST_RATES = System(payload=SYSTEM.payload, uavs=SYSTEM.uavs, rate_gains=[200.0, 200.0, 200.0])
AT_REST = hover(SYSTEM)
UAV, PERIOD_S = 1, 0.05
# Central differences of smooth functions of order one: their error is a thousandth of this.
STEP, SLOPE_TOLERANCE = 1e-4, 1e-6
ROUNDING = 1e-9
NEUTRAL = 1e-7  # rounding of a multiple eigenvalue
# Time in which a heading error falls to a tenth, s: three time constants of some seconds.
HEADING_RETURNS_S = 10.0
LOST = 3  # plans in a row that a UAV alone bridges at 20 Hz
READY = ("resilient", "precise", "windy", "eight", "gap")


@lru_cache
def ready(name: str) -> Setup:
    """Return a ready scenario."""
    return runs.ready(name)


@pytest.mark.parametrize("system", [SYSTEM, RATES])
def test_its_linearisation_is_its_gain(system: System) -> None:
    """Along every direction of the manifold at hover, for moments and for body rates, (31c)."""
    follows = FailSafe(system, AT_REST.u, AT_REST.x[None])
    for step in STEP * tangent(AT_REST.x).T:
        slope = (
            follows.inputs(UAV, AT_REST.x + step, 0) - follows.inputs(UAV, AT_REST.x - step, 0)
        ) / (2.0 * STEP)
        np.testing.assert_allclose(slope, follows.gain(UAV) @ (step / STEP), atol=SLOPE_TOLERANCE)


@pytest.mark.parametrize("rates", [False, True], ids=["moments", "body rates"])
def test_its_linearisation_along_a_path_is_its_gain_there(*, rates: bool) -> None:
    """At full speed along `eight` too, for every direction of the manifold, (31g)."""
    run = ready("eight")
    track = run.track
    assert track is not None
    system = run.system
    if rates:
        system = System(payload=system.payload, uavs=system.uavs, rate_gains=[25.0, 25.0, 10.0])
    follows = FailSafe(system, run.hover.u, run.X_ref, track)
    for tick in (0, len(track.X) // 3, len(track.X) // 2):
        x = track.X[tick]
        gain = follows.gain_along(UAV, x, tick)
        for step in STEP * tangent(x).T:
            ahead, back = (follows.inputs(UAV, x + sign * step, tick) for sign in (1.0, -1.0))
            slope = (ahead - back) / (2.0 * STEP)
            np.testing.assert_allclose(slope, gain @ (step / STEP), atol=SLOPE_TOLERANCE)


@pytest.mark.skipif(not native.AVAILABLE, reason="no compiled kernels")
@pytest.mark.parametrize("system", [SYSTEM, RATES], ids=["moments", "body rates"])
def test_its_kernel_is_its_twin(system: System) -> None:
    """At states near the setpoint and far from it, with and without a held force, for every UAV."""
    rng = np.random.default_rng(3)
    for _, uav in product(range(50), range(system.N)):
        x = AT_REST.x + 10.0 ** rng.uniform(-4.0, 0.0) * rng.standard_normal(system.n)
        x_ref = AT_REST.x + 0.1 * rng.standard_normal(system.n)
        law = AloneLaw(system, uav, float(AT_REST.u[4 * uav]))
        setpoint = setpoint_of(system, uav, x_ref, AT_REST.u)
        for integral_I in (None, rng.standard_normal(3)):
            expected = law.inputs(motion_of(system, uav, x), setpoint, integral_I)
            compiled = CompiledAloneLaw(system, uav, law)
            found = compiled.inputs(x, setpoint, integral_I)
            np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)


def test_its_derivative_by_the_sensors() -> None:
    """Differences about hover, each sensor by itself but the specific force, which shows the rod."""
    law, setpoint = (
        AloneLaw(SYSTEM, UAV, float(AT_REST.u[4 * UAV])),
        setpoint_of(SYSTEM, UAV, AT_REST.x, AT_REST.u),
    )
    at_rest = motion_of(SYSTEM, UAV, AT_REST.x)

    def inputs(dz: Array) -> Array:
        moved = UavMotion(
            position_I=at_rest.position_I + dz[state.POSITION],
            velocity_I=at_rest.velocity_I + dz[state.VELOCITY],
            Theta=at_rest.Theta + dz[state.THETA],
            omega_B=at_rest.omega_B + dz[state.OMEGA],
            rod_I=at_rest.rod_I,
            swing_I=at_rest.swing_I,
        )
        return law.inputs(moved, setpoint)

    steps = STEP * np.eye(state.SENSED)
    slopes = np.array([(inputs(step) - inputs(-step)) / (2.0 * STEP) for step in steps]).T
    np.testing.assert_allclose(slopes, law.by_sensors(), atol=SLOPE_TOLERANCE)


@pytest.mark.parametrize("system", [SYSTEM, RATES])
def test_its_derivative_by_the_inputs_in_force(system: System) -> None:
    """Differences about hover of what acts a period later: by inputs, attitude and body rates at its begin, (31h)."""
    law = AloneLaw(system, UAV, float(AT_REST.u[4 * UAV]))
    setpoint = setpoint_of(system, UAV, AT_REST.x, AT_REST.u)
    before, attitude, rates = law.by_inputs_before(PERIOD_S)

    def inputs(dz: Array) -> Array:
        dTheta, domega, du = dz[:3], dz[3:6], dz[6:]
        Theta = setpoint.motion.Theta + dTheta + PERIOD_S * domega
        turned = replace(setpoint.motion, Theta=Theta, omega_B=setpoint.motion.omega_B + domega)
        in_force = setpoint.inputs + du
        moved = law.driven(turned, setpoint, setpoint.motion, in_force, PERIOD_S)
        return law.inputs(moved, setpoint)

    steps = STEP * np.eye(6 + state.INPUTS)
    slopes = np.array([(inputs(step) - inputs(-step)) / (2.0 * STEP) for step in steps]).T
    by_sensors = law.by_sensors()
    by_attitude = by_sensors[:, state.THETA] + attitude
    by_rates = by_sensors[:, state.OMEGA] + PERIOD_S * by_sensors[:, state.THETA]
    by_rates = by_rates + rates + 0.5 * PERIOD_S * attitude
    expected = np.hstack([by_attitude, by_rates, before])
    np.testing.assert_allclose(slopes, expected, atol=SLOPE_TOLERANCE)


def test_thrust_in_force_moves_a_uav() -> None:
    """A UAV that leans, and pulls by more than its share, is faster a period later by that force, (31h)."""
    law = AloneLaw(SYSTEM, UAV, float(AT_REST.u[4 * UAV]))
    setpoint = setpoint_of(SYSTEM, UAV, AT_REST.x, AT_REST.u)
    pitch_rad, more_N = 0.1, 2.0
    leaning = replace(
        setpoint.motion, Theta=setpoint.motion.Theta + np.array([0.0, pitch_rad, 0.0])
    )
    in_force = setpoint.inputs + np.array([more_N, 0.0, 0.0, 0.0])
    moved = law.driven(leaning, setpoint, setpoint.motion, in_force, PERIOD_S)

    hover_N = setpoint.inputs[0]
    forwards_N = -(hover_N + more_N) * np.sin(pitch_rad)
    down_N = hover_N - (hover_N + more_N) * np.cos(pitch_rad)
    faster_mps = PERIOD_S / SYSTEM.uavs[UAV].mass * np.array([forwards_N, 0.0, down_N])
    np.testing.assert_allclose(moved.velocity_I, faster_mps, atol=SLOPE_TOLERANCE)


@pytest.mark.parametrize("name", ["precise", "eight"])
def test_on_the_reference_its_inputs_are_those_of_the_reference(name: str) -> None:
    """At hover and along a flat reference, thrust and moments or body rates are those that fly it."""
    run = ready(name)
    follows = FailSafe(run.system, run.hover.u, run.X_ref, run.track)
    for tick in (0, 60, 130):
        x, u = (
            (run.X_ref[tick], run.hover.u)
            if run.track is None
            else (run.track.X[tick], run.track.U[tick])
        )
        if run.track is None:
            # At rest where the reference moves.
            x = run.hover.x + np.where(np.arange(len(x)) < 3, x, 0.0)
            follows = FailSafe(run.system, run.hover.u, np.tile(x, (tick + 1, 1)))
        for uav in range(run.system.N):
            np.testing.assert_allclose(
                follows.inputs(uav, x, tick), u[state.input_slice(uav)], atol=ROUNDING
            )


@pytest.mark.parametrize("seed", range(4))
def test_it_accelerates_towards_the_reference(seed: int) -> None:
    """The wanted force is that of the deviations of position and velocity, in any heading, against the swing."""
    rng = np.random.default_rng(seed)
    x, x_ref = (AT_REST.x + 0.01 * rng.standard_normal(len(AT_REST.x)) for _ in range(2))
    law, setpoint = (
        AloneLaw(SYSTEM, UAV, float(AT_REST.u[4 * UAV])),
        setpoint_of(SYSTEM, UAV, x_ref, AT_REST.u),
    )
    motion, wanted = motion_of(SYSTEM, UAV, x), setpoint.motion
    uav = SYSTEM.uavs[UAV]
    masses = np.array([uav.mass, uav.mass, AT_REST.u[4 * UAV] / SYSTEM.gravity])
    expected = GAINS.position * (wanted.position_I - motion.position_I)
    expected += GAINS.velocity * (wanted.velocity_I - motion.velocity_I)
    swing = GAINS.swing * np.sqrt(SYSTEM.uavs[UAV].rod_length)
    expected[:2] -= swing * (motion.swing_I - wanted.swing_I)[:2]
    np.testing.assert_allclose(
        law.force(motion, setpoint) - setpoint.force_I, masses * expected, rtol=1e-9
    )


def test_its_tilt_is_bounded() -> None:
    """However far the UAV is, roll and pitch are asked to differ from those of the reference by 0.5 rad at most."""
    law, setpoint = (
        AloneLaw(SYSTEM, UAV, float(AT_REST.u[4 * UAV])),
        setpoint_of(SYSTEM, UAV, AT_REST.x, AT_REST.u),
    )
    x = AT_REST.x.copy()
    x[state.R0] += [100.0, -100.0, 0.0]
    moments = law.inputs(motion_of(SYSTEM, UAV, x), setpoint)[1:]
    largest = 36.0 * np.diag(SYSTEM.uavs[UAV].inertia)[:2] * 0.5
    np.testing.assert_allclose(np.abs(moments[:2]), largest)


def test_the_integral_finds_a_force_and_has_a_bound() -> None:
    """Under a constant deviation the force of the integral grows towards it, to 0.4 of the hover thrust."""
    law, setpoint = (
        AloneLaw(SYSTEM, UAV, float(AT_REST.u[4 * UAV])),
        setpoint_of(SYSTEM, UAV, AT_REST.x, AT_REST.u),
    )
    x = AT_REST.x.copy()
    x[state.R0] += [0.5, 0.0, 0.0]
    held = np.zeros(3)
    for _ in range(2000):
        held = law.integral_after(held, motion_of(SYSTEM, UAV, x), setpoint, PERIOD_S)
    np.testing.assert_allclose(held, [-0.4 * AT_REST.u[4 * UAV], 0.0, 0.0], atol=ROUNDING)


def test_without_a_deviation_the_integral_forgets() -> None:
    """UAVs on a rigid body that hold forces against each other, without any error, let them go in 20 s, (31a)."""
    law = AloneLaw(SYSTEM, UAV, float(AT_REST.u[4 * UAV]))
    setpoint = setpoint_of(SYSTEM, UAV, AT_REST.x, AT_REST.u)
    assert (law.follows_s, law.forgets_s) == (6.0 / 2.5, 20.0)
    first = np.array([1.0, -2.0, 0.5])
    held = first
    for _ in range(round(20.0 / PERIOD_S)):
        held = law.integral_after(held, setpoint.motion, setpoint, PERIOD_S)
    np.testing.assert_allclose(held, np.exp(-1.0) * first, rtol=PERIOD_S / 20.0)


@pytest.mark.parametrize("name", READY)
@pytest.mark.parametrize("next_tick", [False, True])
def test_a_team_of_uavs_alone_is_stable(name: str, next_tick: bool) -> None:
    """All deviations from hover decay, also those of the integrals, with inputs at once and a period later."""
    team = ready(name).team_alone(next_tick=next_tick)
    loop = team.loop(team.design().gains)
    assert loop.growth(Mismatch()) < 0.0
    assert loop.growth(Mismatch(lag_s=0.025)) < 0.0


@pytest.mark.parametrize("name", READY)
def test_a_team_of_which_some_act_alone_is_stable(name: str) -> None:
    """Any UAVs alone, the others on the team's law, and any share of both: no deviation grows.

    The team's law leaves headings of its UAVs free, so that one mode for each of them is neutral.
    """
    run = ready(name)
    whole = Controller(run.model, run.hover, run.settings, range(run.system.N))
    K_team = whole.regulation.gain(0)[:, : run.system.n]
    gains = run.settings.alone_gains
    follows = FailSafe(run.system, run.hover.u, run.hover.x[None], gains=gains)
    K_alone = np.vstack([follows.gain(uav) for uav in range(run.system.N)])
    T = tangent(run.hover.x)
    held = zero_order_hold(
        run.model.linearise(run.hover.x, run.hover.u), run.settings.sampling_period_s
    )

    subsets = product((0.0, 1.0), repeat=run.system.N)
    mixtures = [*subsets, *([share] * run.system.N for share in np.linspace(0.1, 0.9, 9))]
    for mixture in mixtures:
        alone = np.repeat(mixture, state.INPUTS)[:, None]
        K = (1.0 - alone) * K_team + alone * K_alone
        growth = np.abs(np.linalg.eigvals(T.T @ (held.A + held.B @ K) @ T))
        neutral = growth > 1.0 - NEUTRAL
        assert growth.max() < 1.0 + NEUTRAL
        assert neutral.sum() <= np.count_nonzero(np.array(mixture) < 1.0)


def turning_by(law: AloneLaw, setpoint: Setpoint, Theta: Array, omega_B: Array) -> Array:
    """Return the moments, or body rates, of a UAV on its setpoint but for attitude and body rates, (3,)."""
    motion = replace(setpoint.motion, Theta=Theta, omega_B=omega_B)
    return law.inputs(motion, setpoint)[1:]


def turned(system: System, turning: Array, Theta: Array, omega_B: Array, held_s: float) -> Array:
    """Return small Euler angles and body rates, (6,), of a UAV whose moments, or commanded rates, are held for a time.

    About hover J domega/dt = tau, or domega/dt = K (omega_c - omega), (57).
    """
    if system.rate_gains is None:
        acceleration = np.linalg.solve(system.uavs[UAV].inertia, turning)
        angles = Theta + held_s * omega_B + 0.5 * held_s**2 * acceleration
        return np.concatenate([angles, omega_B + held_s * acceleration])
    decay = np.exp(-system.rate_gains * held_s)
    lag_s = (1.0 - decay) / system.rate_gains
    angles = Theta + lag_s * omega_B + (held_s - lag_s) * turning
    return np.concatenate([angles, decay * omega_B + (1.0 - decay) * turning])


def test_around_a_slow_inner_loop_the_attitude_is_damped() -> None:
    """Roll returns with damping ratio 0.7 where the largest gain does not limit it, (31b), (57)."""
    K = 8.0
    system = System(payload=SYSTEM.payload, uavs=SYSTEM.uavs, rate_gains=[K, K, K])
    by_sensors = AloneLaw(system, UAV, float(AT_REST.u[4 * UAV])).by_sensors()
    by_roll, by_rate = by_sensors[1, state.THETA][0], by_sensors[1, state.OMEGA][0]
    # phi'' = K (omega_c - phi'), omega_c = by_roll phi + by_rate phi'
    ratio = K * (1.0 - by_rate) / (2.0 * np.sqrt(-K * by_roll))
    assert ratio == pytest.approx(np.sqrt(0.5))


@pytest.mark.parametrize("name", READY)
def test_any_heading_error_is_within_the_moments_of_the_rotors(name: str) -> None:
    """Up to half a turn asks for no more than there is about the vertical, and it decays in seconds, (31b).

    Rotors have little moment about the vertical. A heading that asks for more takes from the thrusts
    that roll and pitch need.
    """
    run = ready(name)
    law = AloneLaw(run.system, UAV, float(run.hover.u[state.INPUTS * UAV]))
    setpoint = setpoint_of(run.system, UAV, run.hover.x, run.hover.u)
    period_s = run.settings.sampling_period_s
    largest = run.settings.upper(1)[3]
    for error in (-0.999 * np.pi, 0.5 * np.pi, 0.999 * np.pi):
        Theta = np.array([0.0, 0.0, error])
        omega_B = np.zeros(3)
        for _ in range(round(HEADING_RETURNS_S / period_s)):
            turning = turning_by(law, setpoint, Theta, omega_B)
            assert abs(turning[2]) <= largest
            Theta, omega_B = np.split(turned(run.system, turning, Theta, omega_B, period_s), 2)
        assert abs(Theta[2]) < 0.1 * abs(error)


@pytest.mark.parametrize("period_s", [0.02, 0.025, 0.05, 0.1, 0.2])
@pytest.mark.parametrize(
    "system", [SYSTEM, RATES, FAST_RATES], ids=["moments", "body rates", "fast body rates"]
)
def test_a_uav_stays_upright_on_whole_plans(system: System, period_s: float) -> None:
    """Where each plan is held to its end, as all between are lost, an attitude error decays, (31b).

    Nothing predicts the feedback within a plan: moments that are held for too long turn the UAV over.
    """
    law = AloneLaw(system, UAV, float(AT_REST.u[state.INPUTS * UAV]))
    setpoint = setpoint_of(system, UAV, AT_REST.x, AT_REST.u)
    held_s = steps_alone(period_s) * period_s
    steps = STEP * np.eye(6)
    columns = [
        turned(system, turning_by(law, setpoint, step[:3], step[3:]), step[:3], step[3:], held_s)
        for step in steps
    ]
    assert np.abs(np.linalg.eigvals(np.array(columns).T / STEP)).max() < 1.0


@pytest.mark.parametrize(
    ("period_s", "steps"), [(0.02, 10), (0.03, 7), (0.05, LOST + 1), (0.09, 2), (0.5, 1)]
)
def test_a_plan_outlasts_lost_ones(period_s: float, steps: int) -> None:
    """It covers 0.2 s to the nearest period, and one at least: three lost plans in a row change nothing at 20 Hz."""
    assert steps_alone(period_s) == steps
