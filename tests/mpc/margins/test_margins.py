"""The linear analysis of the sampled loop about hover (docs/equations.md (60))."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.linalg import expm

from tests.support.linear_model import PERIOD_S, difference
from tests.support.random_systems import with_drag
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.physics.hover import hover
from transport.model.physics.parameters import ParameterError, System, table_1
from transport.model.state import PAYLOAD, input_slice, uav_slice
from transport.mpc.alone.fail_safe import FailSafe
from transport.mpc.controller import Controller
from transport.mpc.law.tangent import tangent
from transport.mpc.margins.actual_plant import Mismatch, delayed_step
from transport.mpc.margins.sampled_loop import (
    FARTHEST,
    FARTHEST_S,
    GROWTH,
    Loop,
    Margin,
    SampledLoop,
    margins,
)
from transport.mpc.settings_period_horizon_weights import (
    ControllerSettings,
    CostTerm,
    Limits,
    Weights,
)

SYSTEM = table_1()
RATES = System(payload=SYSTEM.payload, uavs=SYSTEM.uavs, rate_gains=[25.0, 25.0, 10.0])
DRAGGED = with_drag(np.random.default_rng(4), SYSTEM)
SHARED = ControllerSettings(prediction="closed_loop", terminal="riccati")
# Rounding of eigenvalues of modes that come in equal pairs: the square root of that of the matrix.
ROUNDING = 1e-6
# With a fail-safe that follows, deviations decay by e within some periods of the rods' pendulum,
# which are about 5 s.
SETTLING_S = 10.0
# Factor from the end of a margin, which is found to 0.5 %, to where the loop is unstable.
BEYOND = 1.02
# Of growths at delays 1e-7 s apart, 1/s.
SAME_GROWTH = 1e-3

TICKS = 20  # of a simulation
# Sums of that many steps with deviations of some units.
SAME_STEPS = 1e-9


def _loop(
    settings: ControllerSettings = SHARED,
    *,
    next_tick: bool = False,
    age: int = 1,
    system: System = SYSTEM,
) -> Loop:
    model, at_rest = Model(system), hover(system)
    team = [Controller(model, at_rest, settings, (uav,)) for uav in range(system.N)]
    return Loop(team, next_tick=next_tick, age=age)


@pytest.mark.parametrize(
    ("next_tick", "age", "system"),
    [
        (False, 1, SYSTEM),
        (True, 1, SYSTEM),
        (False, 3, SYSTEM),
        (True, 3, SYSTEM),
        (True, 3, RATES),
        (True, 3, DRAGGED),
    ],
)
def test_with_the_plant_as_known_the_loop_is_the_regulator(
    next_tick: bool, age: int, system: System
) -> None:
    """Estimates are exact, so the step has the regulator's eigenvalues, for any age of the states."""
    loop = _loop(next_tick=next_tick, age=age, system=system)
    found = np.linalg.eigvals(loop.matrix(Mismatch()))
    regulator = Controller(Model(system), hover(system), SHARED, (0,)).regulation.current.regulator
    assert regulator is not None
    expected = np.linalg.eigvals(regulator.A_closed)
    assert np.abs(found[:, None] - expected[None]).min(axis=0).max() < ROUNDING
    assert np.abs(found).max() == pytest.approx(np.abs(expected).max(), abs=ROUNDING)


def simulated(plant: System, x: Array, *, next_tick: bool, age: int, late: int = 0) -> Array:
    """Return deviations of a plant from hover, (TICKS + 1, n), by the estimates of (60a).

    Agents of one UAV each estimate one after the other, in vectors of the state. Commands reach the
    plant `late` periods after the agents expect them there, and before the start all were zero.
    """
    known, actual = difference(SYSTEM, hover(SYSTEM)), difference(plant, hover(plant))
    K = Controller(Model(SYSTEM), hover(SYSTEM), SHARED, (0,)).regulation.gain(0)
    before, delay = age + late + 1, int(next_tick)
    X, U = [np.zeros_like(x)] * before + [x], [np.zeros(SYSTEM.m)] * before
    for k in range(before, before + TICKS):
        issued = np.zeros(SYSTEM.m)
        for uav in range(SYSTEM.N):
            own = input_slice(uav)
            measured_at_once = (slice(0, PAYLOAD), uav_slice(uav))
            # The newest state of all UAVs that the agent knows, x(k - age).
            estimate = X[k - age]
            held = np.zeros(SYSTEM.m)
            for step in range(age + delay):
                acting = U[k - age - delay + step]
                if step == delay:
                    # The newest plans it has: their difference from the law is held from here on.
                    held = acting - K @ estimate
                if step > delay:
                    # It knows its own later commands; the law stands for those of the others.
                    from_plan = acting[own]
                    acting = K @ estimate + held
                    acting[own] = from_plan
                estimate = known.A @ estimate + known.B @ acting
                if step < age:
                    # Up to x(k) it has measurements of the payload and of its own UAV.
                    for measured in measured_at_once:
                        estimate[measured] = X[k - age + step + 1][measured]
            issued[own] = K[own] @ estimate
        U.append(issued)
        X.append(actual.A @ X[k] + actual.B @ U[k - delay - late])
    return np.array(X[before:])


def assert_steps_are_simulated(mismatch: Mismatch, *, next_tick: bool, age: int, late: int) -> None:
    """Compare the steps of the loop, from a random motion, with the simulation of its agents."""
    matrix = _loop(next_tick=next_tick, age=age).matrix(mismatch)
    T = tangent(hover(SYSTEM).x)
    motion = T.shape[1]
    whole = np.zeros(len(matrix))
    whole[:motion] = np.random.default_rng(3).standard_normal(motion)

    plant = mismatch.system(SYSTEM)
    expected = simulated(plant, T @ whole[:motion], next_tick=next_tick, age=age, late=late)
    for x in expected:
        np.testing.assert_allclose(T @ whole[:motion], x, atol=SAME_STEPS)
        whole = matrix @ whole


@pytest.mark.parametrize("next_tick", [False, True])
def test_loop_is_a_simulation_of_its_agents(next_tick: bool) -> None:
    """On a plant with other inertias its steps are those of estimates by (60a) in plain vectors.

    As known the plant would not tell the estimates apart: all are exact.
    """
    mismatch = Mismatch(uav_inertia=1.5, payload_inertia=0.7)
    assert_steps_are_simulated(mismatch, next_tick=next_tick, age=3, late=0)


@pytest.mark.parametrize("next_tick", [False, True])
@pytest.mark.parametrize(("age", "late"), [(1, 1), (3, 1), (1, 3)])
def test_a_delayed_loop_is_a_simulation_of_late_commands(
    next_tick: bool, age: int, late: int
) -> None:
    """With a plant delay of whole periods commands act so much later, unknown to the agents."""
    delayed = Mismatch(delay_s=late * PERIOD_S)
    assert_steps_are_simulated(delayed, next_tick=next_tick, age=age, late=late)


@pytest.mark.parametrize("age", [1, 4])
def test_a_known_lag_is_no_mismatch(age: int) -> None:
    """A controller that knows the motors is stable with them, and its margins are a range about their lag."""
    loop = _loop(SHARED.model_copy(update={"motor_lag_s": 0.05}), age=age)
    assert loop.growth(Mismatch(lag_s=0.05)) <= GROWTH
    assert loop.growth(Mismatch(lag_s=0.5)) > GROWTH


def test_a_margin_is_where_stability_ends() -> None:
    """The loop is stable at each end of a range and unstable just beyond it.

    A range without end is stable as far away as is tried. Delays and lags have an upper end.
    """
    loop = _loop()
    found = margins(loop)
    assert set(found) == {field.name for field in fields(Mismatch)}
    assert found["delay_s"].upper is not None
    assert found["lag_s"].upper is not None
    for name, margin in found.items():
        is_time = name.endswith("_s")
        least, most = (0.0, FARTHEST_S) if is_time else (1.0 / FARTHEST, FARTHEST)
        for end, factor, far in (
            (margin.lower, 1.0 / BEYOND, least),
            (margin.upper, BEYOND, most),
        ):
            stable = far if end is None else end
            assert loop.growth(Mismatch(**{name: stable})) <= GROWTH, name
            if end is not None:
                assert loop.growth(Mismatch(**{name: end * factor})) > GROWTH, name


def test_a_long_delay_is_unstable() -> None:
    """A delay of several periods that the agents do not know makes the loop unstable."""
    assert _loop().growth(Mismatch(delay_s=10.0 * PERIOD_S)) > GROWTH


@pytest.mark.parametrize("name", [field.name for field in fields(Mismatch) if field.default == 1.0])
def test_step_is_that_of_the_actual_bodies(name: str) -> None:
    """Each factor changes its own property: the step is the hold about the hover of bodies that have it."""
    factor = 1.3
    payload, uavs = SYSTEM.payload, SYSTEM.uavs
    of = name.removeprefix("payload_").removeprefix("uav_")
    if name.startswith("payload"):
        payload = replace(payload, **{of: factor * getattr(payload, of)})
    elif name != "gain":
        uavs = tuple(replace(uav, **{of: factor * getattr(uav, of)}) for uav in uavs)
    actual = System(payload=payload, uavs=uavs)
    T = tangent(hover(SYSTEM).x)
    expected = difference(actual, hover(actual))
    step = delayed_step(SYSTEM, T, Mismatch(**{name: factor}), PERIOD_S).parts[0]
    by_inputs = factor if name == "gain" else 1.0
    np.testing.assert_allclose(step.A, T.T @ expected.A @ T, atol=SAME_STEPS)
    np.testing.assert_allclose(step.B, by_inputs * T.T @ expected.B, atol=SAME_STEPS)


def test_actual_bodies_keep_what_no_factor_changes() -> None:
    """Gravity, attachment points and drag are the known ones."""
    known = replace(DRAGGED, gravity=3.7)
    actual = Mismatch(gain=0.5, uav_mass=2.0, rod_length=1.1).system(known)
    assert (actual.gravity, actual.payload.mass) == (3.7, known.payload.mass)
    np.testing.assert_array_equal(actual.drag, known.drag)
    for found, before in zip(actual.uavs, known.uavs, strict=True):
        np.testing.assert_array_equal(found.rho, before.rho)
        np.testing.assert_array_equal(found.inertia, before.inertia)
        assert (found.mass, found.rod_length) == (2.0 * before.mass, 1.1 * before.rod_length)


@pytest.mark.parametrize("lag_s", [0.03, 1e-5])
@pytest.mark.parametrize("system", [SYSTEM, RATES], ids=["moments", "rates"])
def test_step_with_motors_is_their_exponential(system: System, lag_s: float) -> None:
    """a' = (wrench - a) / lag, the wrench the command, or with commanded rates J K (command - rate): (53), (57)."""
    linear = Model(SYSTEM).linearise(hover(SYSTEM).x, hover(SYSTEM).u)
    n, m = linear.B_c.shape
    by_state, by_command = np.zeros((m, n)), np.eye(m)
    for i, uav in enumerate(system.uavs if system.rate_gains is not None else ()):
        first = 4 * i + 1
        gains = uav.inertia * np.array(system.rate_gains)
        by_state[first : first + 3, uav_slice(i)][:, 9:] = -gains
        by_command[first : first + 3, first : first + 3] = gains
    whole = np.zeros((n + 2 * m, n + 2 * m))
    whole[:n, : n + m] = np.hstack([linear.A_c, linear.B_c])
    whole[n : n + m] = np.hstack([by_state, -np.eye(m), by_command]) / lag_s
    hold = expm(PERIOD_S * whole)

    T = tangent(hover(SYSTEM).x)
    r = T.shape[1]
    step = delayed_step(system, T, Mismatch(lag_s=lag_s), PERIOD_S).parts[0]
    np.testing.assert_allclose(step.A[:r, :r], T.T @ hold[:n, :n] @ T, atol=SAME_STEPS)
    np.testing.assert_allclose(step.B[:r], T.T @ hold[:n, n + m :], atol=SAME_STEPS)


@pytest.mark.parametrize("delay_s", [0.0, 0.02])
def test_commands_of_each_uav_arrive_at_their_own_time(delay_s: float) -> None:
    """The step is that of the motion in a hundred parts, in each of which each UAV has its newest command.

    UAV i of N has a delay of i/N of the spread beyond the common one.
    """
    T = tangent(hover(SYSTEM).x)
    # Arrivals of four UAVs in two periods, at bounds of parts.
    spread_s, parts = (
        1.6 * PERIOD_S,
        100,
    )
    step = delayed_step(SYSTEM, T, Mismatch(delay_s=delay_s, spread_s=spread_s), PERIOD_S)
    part = delayed_step(SYSTEM, T, Mismatch(), PERIOD_S / parts).parts[-1]
    rng = np.random.default_rng(0)
    expected = motion = rng.standard_normal((step.size, 1))
    acting = rng.standard_normal((step.late + 2, SYSTEM.m, 1))

    for k in range(parts):
        u = np.zeros((SYSTEM.m, 1))
        for uav in range(SYSTEM.N):
            late_s = delay_s + spread_s * (uav + 1) / SYSTEM.N
            # In force is the newest command sent at least that long ago, in the middle of a part.
            age = int(np.ceil((late_s - (k + 0.5) / parts * PERIOD_S) / PERIOD_S))
            u[input_slice(uav)] = acting[max(age, 0)][input_slice(uav)]
        expected = part.A @ expected + part.B @ u
    np.testing.assert_allclose(step.moved(motion, list(acting)), expected, atol=SAME_STEPS)


@pytest.mark.parametrize("periods", [1, 2])
def test_growth_is_continuous_where_a_delay_is_whole_periods(periods: int) -> None:
    """Delays just below, at and just above whole periods have the same growth, unlike one period less."""
    loop, delay_s, near_s = _loop(), periods * PERIOD_S, 1e-7
    delays_s = (delay_s - near_s, delay_s, delay_s + near_s)
    growths = [loop.growth(Mismatch(delay_s=each_s)) for each_s in delays_s]
    assert np.ptp(growths) < SAME_GROWTH
    assert growths[1] > loop.growth(Mismatch(delay_s=delay_s - PERIOD_S)) + 1.0


@pytest.mark.parametrize("size", [0.01, 20.0])
def test_weights_on_accelerations_serve_vehicles_of_any_size(size: float) -> None:
    """Masses and inertias times a factor leave the loop as it is, docs/equations.md (21a)."""
    weights = Weights(acceleration=5e-3, angular_acceleration=1.7e-3, tilt_rate=0.15)
    plant, growths = Mismatch(lag_s=0.1), []
    for factor in (1.0, size):
        scaled = Mismatch(
            uav_mass=factor, uav_inertia=factor, payload_mass=factor, payload_inertia=factor
        ).system(SYSTEM)
        at_rest, model = hover(scaled), Model(scaled)
        settings = SHARED.model_copy(
            update={"weights": weights, "limits": Limits(thrust_N=(0.0, 1e4))}
        )
        team = [Controller(model, at_rest, settings, (uav,)) for uav in range(scaled.N)]
        growths.append(Loop(team, next_tick=False).growth(plant))
    assert growths[0] > GROWTH
    assert growths[1] == pytest.approx(growths[0], rel=1e-6)


@pytest.mark.parametrize(
    ("gone", "follows"),
    [((1,), False), ((1,), True), ((0, 2), False), ((0, 2), True), ((0, 1, 3), True)],
)
def test_the_team_that_is_left_is_its_regulator(gone: tuple[int, ...], follows: bool) -> None:
    """The step has the eigenvalues of the regulator for that team, which settle if the fail-safe follows.

    The other eigenvalues are those of the estimates of UAVs that no agent measures. Two UAVs that
    only keep level swing against each other undamped, docs/equations.md (45).
    """
    model, at_rest = Model(SYSTEM), hover(SYSTEM)
    settings = SHARED.model_copy(update={"fail_safe": "follow" if follows else "level"})
    fail_safe = FailSafe(SYSTEM, at_rest.u, at_rest.x[None] if follows else None)
    team = [
        Controller(model, at_rest, settings, (uav,)) for uav in range(SYSTEM.N) if uav not in gone
    ]
    for controller in team:
        controller.without(gone)
    regulator = team[0].regulation.current.regulator
    assert regulator is not None
    for next_tick in (False, True):
        loop = Loop(
            team,
            next_tick=next_tick,
            age=2,
            uncontrolled={uav: fail_safe.gain(uav) for uav in gone},
        )
        found = np.linalg.eigvals(loop.matrix(Mismatch()))
        assert (
            np.abs(found[:, None] - np.linalg.eigvals(regulator.A_closed)[None]).min(axis=0).max()
            < ROUNDING
        )
        settling_s = loop.settling_s(Mismatch())
        if follows:
            assert settling_s is not None
            assert settling_s < SETTLING_S
        else:
            assert (settling_s is None) == (len(gone) > 1)


def test_a_heading_that_a_cost_controls_is_a_deviation_like_any_other() -> None:
    """Only modes that a step leaves as they are count as headings: the slowest other one decides."""
    terms = tuple(CostTerm(expression=f"Theta{i}[2]", weight=1.0) for i in range(1, SYSTEM.N + 1))
    loop = _loop(SHARED.model_copy(update={"cost": terms}))
    slowest = np.abs(np.linalg.eigvals(loop.matrix(Mismatch()))).max()
    assert slowest < 1.0
    assert loop.settling_s(Mismatch()) == pytest.approx(-loop.period_s / np.log(slowest))


class _ShortDelayLoop(SampledLoop):
    """A loop that only delays and lags up to a limit leave stable."""

    period_s = 0.05

    def __init__(self, limit_s: float, known_lag_s: float) -> None:
        self.known_lag_s = known_lag_s
        self._limit_s = limit_s

    def matrix(self, plant: Mismatch) -> Array:
        is_stable = plant.delay_s <= self._limit_s and plant.lag_s <= self._limit_s
        return np.array([[0.9 if is_stable else 1.1]])


def test_ends_below_the_shortest_time_tried_are_stable() -> None:
    """A loop that 1 ms makes unstable has the known value as its end, which is stable, and no lower one."""
    found = margins(_ShortDelayLoop(limit_s=7e-4, known_lag_s=5e-4))
    assert found["delay_s"] == Margin(nominal=0.0, lower=None, upper=0.0)
    assert found["lag_s"] == Margin(nominal=5e-4, lower=None, upper=5e-4)
    assert found["gain"] == Margin(nominal=1.0, lower=None, upper=None)


def test_an_unstable_loop_has_no_margins() -> None:
    """Where the plant as known is unstable there is no range about it."""
    assert margins(_ShortDelayLoop(limit_s=-1.0, known_lag_s=0.0)) == {}


def test_beyond_the_longest_lag_tried_a_known_one_is_within_its_margin() -> None:
    """The upper end is sought upwards from a known lag of any length."""
    known_s, limit_s = 0.7, 0.9
    upper_s = margins(_ShortDelayLoop(limit_s=limit_s, known_lag_s=known_s))["lag_s"].upper
    assert upper_s == pytest.approx(limit_s, rel=0.01)


class _RangeLoop(SampledLoop):
    """A loop that counts as stable for one property within a range, and beyond it is not, or has no hover."""

    period_s = 0.05

    def __init__(self, name: str, least: float, most: float, *, has_hover: bool) -> None:
        self._name = name
        self._range = least, most
        self._has_hover = has_hover

    def matrix(self, plant: Mismatch) -> Array:
        least, most = self._range
        is_within = least <= getattr(plant, self._name) <= most
        if not is_within and not self._has_hover:
            raise ParameterError("no hover")
        growth_per_s = 0.019 if is_within else 0.021
        return np.array([[math.exp(growth_per_s * self.period_s)]])


@pytest.mark.parametrize("has_hover", [True, False])
@pytest.mark.parametrize(
    ("name", "least", "most", "is_found"),
    [
        ("gain", 0.4, 3.0, True),
        ("payload_mass", 0.11, 9.5, True),
        ("payload_mass", 0.09, 10.5, False),
        ("delay_s", 0.0, 0.55, True),
        ("delay_s", 0.0, 0.65, False),
    ],
)
def test_a_range_is_found_to_half_a_percent(
    name: str, least: float, most: float, is_found: bool, *, has_hover: bool
) -> None:
    """From a tenth to ten times, and up to 0.6 s; a growth of 0.02 1/s counts as none, no hover as unstable."""
    margin = margins(_RangeLoop(name, least, most, has_hover=has_hover), [name])[name]
    if not is_found:
        assert (margin.lower, margin.upper) == (None, None)
        return
    assert margin.upper is not None
    assert most / 1.005 <= margin.upper <= most
    if least > 0.0:
        assert margin.lower is not None
        assert least <= margin.lower <= least * 1.005
