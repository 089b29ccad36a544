"""The control law of a UAV alone (docs/equations.md (31a)-(31e))."""

from functools import lru_cache
from itertools import product

import numpy as np
import pytest

from tests.support import runs
from transport.model import native, state
from transport.model.arrays import Array
from transport.model.discretisation import zero_order_hold
from transport.model.hover import hover
from transport.model.parameters import System, table_1
from transport.model.rotations import rotation
from transport.mpc.actual_plant import Mismatch
from transport.mpc.alone import GAINS, AloneLaw, Motion, OwnSensors, course_of, motion_of
from transport.mpc.alone_margins import AloneLoop
from transport.mpc.compiled_alone import CompiledAloneLaw, CompiledCourse
from transport.mpc.controller import Controller
from transport.mpc.fail_safe import FailSafe
from transport.mpc.manifold import tangent
from transport.protocol.scenario.setup import Setup

SYSTEM = table_1()
RATES = System(payload=SYSTEM.payload, uavs=SYSTEM.uavs, rate_gains=[25.0, 25.0, 10.0])
AT_REST = hover(SYSTEM)
UAV, PERIOD_S = 1, 0.05
# Central differences of smooth functions of order one: their error is a thousandth of this.
STEP, SLOPE_TOLERANCE = 1e-4, 1e-6
ROUNDING = 1e-9
NEUTRAL = 1e-7  # rounding of a multiple eigenvalue
# Trapezoids and sums of a pendulum over seconds, and the lag of the observer: a tenth of the swing.
OBSERVED = 0.15
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
    """At states near the course and far off, with and without a held force, for every UAV."""
    rng = np.random.default_rng(3)
    for _, uav in product(range(50), range(system.N)):
        x = AT_REST.x + 10.0 ** rng.uniform(-4.0, 0.0) * rng.standard_normal(system.n)
        x_ref = AT_REST.x + 0.1 * rng.standard_normal(system.n)
        law = AloneLaw(system, uav, float(AT_REST.u[4 * uav]))
        course = course_of(system, uav, x_ref, AT_REST.u)
        for held_I in (None, rng.standard_normal(3)):
            expected = law.inputs(motion_of(system, uav, x), course, held_I)
            compiled = CompiledAloneLaw(system, uav, law)
            found = compiled.inputs(x, CompiledCourse(course), held_I)
            np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)


def test_its_derivative_by_the_sensors() -> None:
    """Differences about hover, each sensor by itself but the specific force, which shows the rod."""
    law, course = (
        AloneLaw(SYSTEM, UAV, float(AT_REST.u[4 * UAV])),
        course_of(SYSTEM, UAV, AT_REST.x, AT_REST.u),
    )
    at_rest = motion_of(SYSTEM, UAV, AT_REST.x)

    def inputs(dz: Array) -> Array:
        moved = Motion(
            position_I=at_rest.position_I + dz[state.POSITION],
            velocity_I=at_rest.velocity_I + dz[state.VELOCITY],
            Theta=at_rest.Theta + dz[state.THETA],
            omega_B=at_rest.omega_B + dz[state.OMEGA],
            rod_I=at_rest.rod_I,
            swing_I=at_rest.swing_I,
        )
        return law.inputs(moved, course)

    steps = STEP * np.eye(state.SENSED)
    slopes = np.array([(inputs(step) - inputs(-step)) / (2.0 * STEP) for step in steps]).T
    np.testing.assert_allclose(slopes, law.by_sensors(), atol=SLOPE_TOLERANCE)


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
            x = run.hover.x + np.where(
                np.arange(len(x)) < 3, x, 0.0
            )  # at rest where the reference moves
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
    law, course = (
        AloneLaw(SYSTEM, UAV, float(AT_REST.u[4 * UAV])),
        course_of(SYSTEM, UAV, x_ref, AT_REST.u),
    )
    motion, wanted = motion_of(SYSTEM, UAV, x), course.motion
    uav = SYSTEM.uavs[UAV]
    masses = np.array([uav.mass, uav.mass, AT_REST.u[4 * UAV] / SYSTEM.gravity])
    expected = GAINS.position * (wanted.position_I - motion.position_I)
    expected += GAINS.velocity * (wanted.velocity_I - motion.velocity_I)
    swing = GAINS.swing * np.sqrt(SYSTEM.uavs[UAV].rod_length)
    expected[:2] -= swing * (motion.swing_I - wanted.swing_I)[:2]
    np.testing.assert_allclose(
        law.force(motion, course) - course.force_I, masses * expected, rtol=1e-9
    )


def test_its_tilt_is_bounded() -> None:
    """However far the UAV is, roll and pitch are asked to differ from those of the reference by a bound at most."""
    law, course = (
        AloneLaw(SYSTEM, UAV, float(AT_REST.u[4 * UAV])),
        course_of(SYSTEM, UAV, AT_REST.x, AT_REST.u),
    )
    x = AT_REST.x.copy()
    x[state.R0] += [100.0, -100.0, 0.0]
    moments = law.inputs(motion_of(SYSTEM, UAV, x), course)[1:]
    largest = 36.0 * np.diag(SYSTEM.uavs[UAV].inertia)[:2] * GAINS.steepest_rad
    np.testing.assert_allclose(np.abs(moments[:2]), largest)


def test_the_integral_finds_a_force_and_has_a_bound() -> None:
    """Under a constant deviation the force of the integral grows towards it, to its bound."""
    law, course = (
        AloneLaw(SYSTEM, UAV, float(AT_REST.u[4 * UAV])),
        course_of(SYSTEM, UAV, AT_REST.x, AT_REST.u),
    )
    x = AT_REST.x.copy()
    x[state.R0] += [0.5, 0.0, 0.0]
    held = np.zeros(3)
    for _ in range(2000):
        held = law.held(held, motion_of(SYSTEM, UAV, x), course, PERIOD_S)
    np.testing.assert_allclose(
        held, [-GAINS.most_held * AT_REST.u[4 * UAV], 0.0, 0.0], atol=ROUNDING
    )


@pytest.mark.parametrize("name", READY)
@pytest.mark.parametrize("next_tick", [False, True])
def test_a_team_of_uavs_alone_is_stable(name: str, next_tick: bool) -> None:
    """All deviations from hover decay, also those of the integrals, with inputs at once and a period later."""
    run = ready(name)
    loop = AloneLoop(run.system, run.settings.sampling_period_s, next_tick=next_tick)
    assert loop.growth(Mismatch()) < 0.0
    assert loop.growth(Mismatch(lag_s=0.03)) < 0.0


@pytest.mark.parametrize("name", READY)
def test_a_team_of_which_some_act_alone_is_stable(name: str) -> None:
    """Any UAVs alone, the others on the team's law, and any share of both: no deviation grows.

    The team's law leaves headings of its UAVs free, so that one mode for each of them is neutral.
    """
    run = ready(name)
    whole = Controller(run.model, run.hover, run.settings, range(run.system.N))
    K_team = whole.regulation.gain(0)[:, : run.system.n]
    follows = FailSafe(run.system, run.hover.u, run.hover.x[None])
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


def test_the_observer_sees_the_swing() -> None:
    """From the specific force of a resting UAV under a swinging rod, velocity and place of its end are those of it."""
    sensors = OwnSensors(SYSTEM, UAV, (0,) * 5, PERIOD_S)
    uav, thrust_N = SYSTEM.uavs[UAV], float(AT_REST.u[4 * UAV])
    rest = motion_of(SYSTEM, UAV, AT_REST.x)
    frequency = np.sqrt(SYSTEM.gravity / uav.rod_length)
    swing_m, errors = 0.3, []
    for k in range(200):
        end_I = np.array([swing_m * np.sin(frequency * k * PERIOD_S), 0.0, 0.0])
        end_I[2] = np.sqrt(uav.rod_length**2 - end_I[0] ** 2)
        z = np.zeros(state.SENSED)
        z[state.POSITION] = rest.position_I
        z[state.SPECIFIC_FORCE] = (7.0 * end_I / uav.rod_length - [0.0, 0.0, thrust_N]) / uav.mass
        motion = sensors.motion(z, thrust_N, k, k, lambda _: rest)
        errors.append(motion.swing_I[0] - swing_m * frequency * np.cos(frequency * k * PERIOD_S))
    assert np.sqrt(np.mean(np.square(errors[60:]))) < np.sqrt(
        0.5
    ) * 2.0 * swing_m * frequency * np.sqrt(OBSERVED)


@pytest.mark.parametrize("ages", [(0, 0, 0, 0, 0), (3, 0, 2, 0, 0)])
@pytest.mark.parametrize("ahead", [0, 1])
def test_late_sensors_show_deviations_that_go_on(ages: tuple[int, ...], ahead: int) -> None:
    """A UAV that deviates from a moving reference at constant rates is seen where it is, (31e)."""
    sensors = OwnSensors(SYSTEM, UAV, ages, PERIOD_S)
    rest = motion_of(SYSTEM, UAV, AT_REST.x)
    drift, turning, moving = (
        np.array([0.1, -0.2, 0.3]),
        np.array([0.2, 0.1, -0.1]),
        np.array([2.0, 0.0, 0.0]),
    )

    def course(tick: int) -> Motion:
        return Motion(
            position_I=rest.position_I + PERIOD_S * tick * moving,
            velocity_I=moving,
            Theta=rest.Theta,
            omega_B=rest.omega_B,
            rod_I=rest.rod_I,
            swing_I=rest.swing_I,
        )

    k = 10
    z = np.zeros(state.SENSED)
    z[state.POSITION] = course(k - ages[0]).position_I + PERIOD_S * (k - ages[0]) * drift
    z[state.VELOCITY] = moving + drift
    z[state.THETA] = PERIOD_S * (k - ages[2]) * turning
    z[state.OMEGA] = turning
    motion = sensors.motion(z, 22.0, k, k + ahead, course)
    there = PERIOD_S * (k + ahead)
    np.testing.assert_allclose(
        motion.position_I, course(k + ahead).position_I + there * drift, atol=ROUNDING
    )
    np.testing.assert_allclose(motion.Theta, there * turning, atol=ROUNDING)
    np.testing.assert_allclose(motion.velocity_I, moving + drift, atol=ROUNDING)


def test_motion_is_that_of_the_model() -> None:
    """Position, velocity and attitude of a UAV are those that its sensors measure without noise, (1), (39), (61)."""
    rng = np.random.default_rng(3)
    run = ready("precise")
    x = AT_REST.x + 0.05 * rng.standard_normal(len(AT_REST.x))
    rods = state.StateView(x).uavs
    rods[:, state.E] /= np.linalg.norm(rods[:, state.E], axis=1)[:, None]
    rods[:, state.ROD_RATE] -= (
        rods[:, state.E] * np.sum(rods[:, state.E] * rods[:, state.ROD_RATE], axis=1)[:, None]
    )
    x[state.PAYLOAD :] = rods.reshape(-1)
    sensed = run.model.sensed(x, AT_REST.u)[state.SENSED * UAV :][: state.SENSED]
    motion = motion_of(SYSTEM, UAV, x)
    np.testing.assert_allclose(motion.position_I, sensed[state.POSITION], atol=ROUNDING)
    np.testing.assert_allclose(motion.velocity_I, sensed[state.VELOCITY], atol=ROUNDING)
    np.testing.assert_allclose(
        motion.rod_I, SYSTEM.uavs[UAV].rod_length * rotation(x[state.THETA0]) @ rods[UAV, :3]
    )
