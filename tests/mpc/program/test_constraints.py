"""Rows of the program against the constraints evaluated one step after the other, and the separation of the UAVs."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt
import pytest

from tests.support import naive
from tests.support.systems import Setup, Situation, controller, paper_setup, situation, step
from transport.model.arrays import Array
from transport.model.physics.hover import hover_after_failures
from transport.model.state import THETA, V0, uav_slice
from transport.mpc.program.constraints.separation import pair_distances
from transport.mpc.program.prediction import Prediction, convolve
from transport.mpc.program.quadratic_program import QP
from transport.mpc.settings_period_horizon_weights import (
    ConstraintSection,
    ControllerSettings,
    SeparationSection,
    TensionSection,
    TiltSection,
)

# Relative to the largest margin of the block: the same sums in another order.
ROUNDING = 1e-10
# N and N m. The softened and the hard program are different programs; both are solved to 1e-9 of
# their scale.
SAME_PLAN = 1e-5

HORIZON = 5
OWNED = [(0,), (1, 3), (0, 1, 2, 3)]
MINIMUM_M, TILT_DEG, SPEED_LIMIT, CEILING_M, THRUST_PRODUCT, MOMENT_SUM = (
    0.45,
    12.0,
    1.0,
    -11.0,
    500.0,
    0.1,
)
TENSION_N = 5.0
OFF = 2  # the UAV that fails
# Slopes of tensions of some newtons by central differences, N.
BY_DIFFERENCES = 1e-6
SETTINGS = ControllerSettings(
    horizon=HORIZON,
    separation=SeparationSection(minimum_m=MINIMUM_M),
    tilt=TiltSection(limit_deg=TILT_DEG),
    tension=TensionSection(minimum_N=TENSION_N),
    constraint=(
        ConstraintSection(expression=f"r0[2] >= {CEILING_M}", soft=False),
        ConstraintSection(expression=f"thrust1 * thrust2 <= {THRUST_PRODUCT}"),
        ConstraintSection(expression=f"dot(v0, v0) <= {SPEED_LIMIT}"),
        ConstraintSection(expression="r0[0] == 0.5"),
        ConstraintSection(expression=f"tau1[0] + tau4[1] == {MOMENT_SUM}"),
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One program, one decision, and what that decision makes of the horizon.

    Attributes:
        dX: Predicted state deviations, (N_p + 1, n).
        inputs: Of all UAVs over the horizon, (N_p, m).
        slacks: Of the separation, of the tilts, of the softened speed limit and of the tensions.
        below, above: Distances of every row to its bounds at that decision.
    """

    setup: Setup
    at: Situation
    dX: Array
    inputs: Array
    own: npt.NDArray[np.intp]
    slacks: tuple[float, ...]
    qp: QP
    below: Array
    above: Array


@pytest.fixture(params=OWNED, ids=str)
def case(request: pytest.FixtureRequest) -> Case:
    """A random decision, well away from equilibrium, for each set of owned UAVs."""
    setup, owned = paper_setup(), request.param
    at = situation(setup, SETTINGS, seed=9)
    one = controller(setup, SETTINGS, owned)
    linear = one.linearise(at.x, at.u)
    qp = one.condense(linear, one.predict(linear, one.discretise(linear), at.U, None), at.y_ref)
    half = (SETTINGS.upper(len(owned)) - SETTINGS.lower(len(owned))) / 2.0
    rng = np.random.default_rng(2)
    v, slacks = 0.2 * rng.standard_normal((HORIZON, len(half))), (0.07, 0.02, 0.3, 0.5)
    inputs = at.U.copy()
    inputs[:, one.own] = at.u[one.own] + v * half
    hold = naive.exact_hold(setup.model.linearise(at.x, at.u), SETTINGS.sampling_period_s)
    values = qp.A @ np.concatenate([v.reshape(-1), slacks])
    return Case(
        setup=setup, at=at, dX=naive.simulate(*hold, inputs - at.u), inputs=inputs,
        own=one.own, slacks=slacks, qp=qp,
        below=values - qp.row_lower, above=qp.row_upper - values,
    )  # fmt: skip


def block(case: Case, kind: str) -> slice:
    """Rows of one kind; they come in this order."""
    uavs = len(case.own) // 4
    pairs = 6 - (4 - uavs) * (3 - uavs) // 2
    counts = {
        "rate": (HORIZON - 1) * 4 * uavs,
        "separation": HORIZON * pairs,
        "tilt": 2 * HORIZON * 2 * uavs,
        "state": HORIZON * 3,
        "input": HORIZON * 2,
        "tension": HORIZON * uavs,
    }
    start = 0
    for name, count in counts.items():
        if name == kind:
            return slice(start, start + count)
        start += count
    raise KeyError(kind)


def close(rows: Array, brute: Array) -> bool:
    """Equal up to rounding relative to the largest value."""
    return rows.shape == brute.shape and bool(
        np.abs(rows - brute).max() <= ROUNDING * max(1.0, np.abs(brute).max())
    )


def test_every_row_is_accounted_for(case: Case) -> None:
    """Rates, separation, tilts, states, inputs, tensions.

    Nothing else constrains the decision, paper (26)-(27).
    """
    assert len(case.qp.A) == block(case, "tension").stop


def test_rate_rows(case: Case) -> None:
    """Distance of each rate row to its bounds is that of the inputs' change over one period, paper section V-A."""
    own = case.own
    rate = SETTINGS.largest_step(len(own) // 4)
    change = np.diff(case.inputs[:, own], axis=0)
    assert close(case.below[block(case, "rate")], (change + rate).reshape(-1))
    assert close(case.above[block(case, "rate")], (rate - change).reshape(-1))


def test_first_rate_is_a_bound(case: Case) -> None:
    """The first input's change against the input in force is bounded by the rate, or by the input's own bound."""
    own = case.own
    uavs = len(own) // 4
    low, high = SETTINGS.lower(uavs), SETTINGS.upper(uavs)
    rate, half = SETTINGS.largest_step(uavs), (high - low) / 2.0
    in_force = case.at.u[own]
    assert close(in_force + case.qp.lower[: len(own)] * half, np.maximum(low, in_force - rate))
    assert close(in_force + case.qp.upper[: len(own)] * half, np.minimum(high, in_force + rate))
    later = case.qp.upper[len(own) : -4].reshape(HORIZON - 1, -1)
    assert close(in_force + later * half, np.tile(high, (HORIZON - 1, 1)))
    assert (case.qp.lower[-4:] == 0.0).all(), "a negative slack would tighten what it softens"
    assert np.isinf(case.qp.upper[-4:]).all()


def test_pair_distances(case: Case) -> None:
    """Predicted distance along the present direction, plus the slack, minus the minimum, for pairs with an owner."""
    model, owners = case.setup.model, {int(i) // 4 for i in case.own}
    y, C = model.outputs(case.at.x), model.linearise(case.at.x, case.at.u).C
    r = y[:12].reshape(4, 3)
    expected = []
    for dx in case.dX[1:]:
        moved = (y + C @ dx)[:12].reshape(4, 3)
        for i, j in combinations(range(4), 2):
            if i in owners or j in owners:
                d = (r[i] - r[j]) / np.linalg.norm(r[i] - r[j])
                expected.append(d @ (moved[i] - moved[j]) + case.slacks[0] - MINIMUM_M)
    rows = block(case, "separation")
    assert close(case.below[rows], np.array(expected))
    assert np.isinf(case.above[rows]).all(), "nothing keeps the UAVs together"


def test_tilt_rows(case: Case) -> None:
    """Predicted roll and pitch of the owned UAVs, from above and from below, with one slack.

    No other UAVs.
    """
    owners = sorted({int(i) // 4 for i in case.own})
    angles = np.array(
        [[(case.at.x + dx)[uav_slice(uav)][THETA][:2] for uav in owners] for dx in case.dX[1:]]
    ).reshape(-1)  # fmt: skip
    limit = np.radians(TILT_DEG) + case.slacks[1]
    above, below = (
        np.split(case.above[block(case, "tilt")], 2),
        np.split(case.below[block(case, "tilt")], 2),
    )
    assert close(above[0], limit - angles)
    assert close(below[1], limit + angles)
    assert np.isinf(above[1]).all()
    assert np.isinf(below[0]).all()


def test_state_rows(case: Case) -> None:
    """User constraints on states, value plus slope times deviation as in paper (20)-(21), hard, soft and equal."""
    x = case.at.x
    expected = np.array(
        [
            [
                x[2] + dx[2] - CEILING_M,
                SPEED_LIMIT - x[V0] @ x[V0] - 2.0 * x[V0] @ dx[V0] + case.slacks[2],
                0.5 - x[0] - dx[0],
            ]
            for dx in case.dX[1:]
        ]
    )
    above = case.above[block(case, "state")].reshape(HORIZON, 3)
    below = case.below[block(case, "state")].reshape(HORIZON, 3)
    assert close(above, expected)
    assert np.isinf(below[:, :2]).all()
    assert close(below[:, 2], -expected[:, 2])


def test_input_rows(case: Case) -> None:
    """User constraints on inputs about u0, the others' as announced, the own effect times (30c)."""
    u0 = case.at.u

    def changes(uavs: set[int]) -> Array:
        """Return the changes of the inputs, the own ones times UAVs of a row over owned ones."""
        dU = case.inputs - u0
        dU[:, case.own] *= len(uavs) / len(uavs & set((case.own // 4).tolist()))
        return dU

    thrusts, turning = changes({0, 1}), changes({0, 3})
    product = u0[0] * u0[4] + u0[4] * thrusts[:, 0] + u0[0] * thrusts[:, 4] - THRUST_PRODUCT
    moments = u0[1] + turning[:, 1] + u0[14] + turning[:, 14] - MOMENT_SUM
    above = case.above[block(case, "input")].reshape(HORIZON, 2)
    below = case.below[block(case, "input")].reshape(HORIZON, 2)
    assert close(above, -np.column_stack([product, moments]))
    assert np.isinf(below[:, 0]).all()
    assert close(below[:, 1], moments)


def tensions(setup: Setup, at: Situation, dX: Array, dU: Array, uavs: list[int]) -> Array:
    """Return tensions of some rods to first order in deviations at each step, by differences, (N_p, uavs), N."""
    T, h = setup.model.tensions, 1e-5
    slopes = [
        (T(at.x + h * x, at.u + h * u) - T(at.x - h * x, at.u - h * u)) / (2.0 * h)
        for x, u in zip(dX, dU, strict=True)
    ]
    return (T(at.x, at.u) + np.array(slopes))[:, uavs]


def test_tension_rows(case: Case) -> None:
    """Tensions of the owned UAVs' rods before each step, with one slack, (30b); no other rods."""
    uavs = sorted({int(i) // 4 for i in case.own})
    found = tensions(case.setup, case.at, case.dX[:-1], case.inputs - case.at.u, uavs)
    rows = block(case, "tension")
    expected = (found - TENSION_N + case.slacks[3]).reshape(-1)
    np.testing.assert_allclose(case.above[rows], expected, rtol=0.0, atol=BY_DIFFERENCES)
    assert np.isinf(case.below[rows]).all()


def test_tensions_after_failures() -> None:
    """At the hover of the UAVs left their rods have its tensions; UAVs off have no limit."""
    setup = paper_setup()
    system = setup.model.system
    one = controller(setup, SETTINGS, (0, 1, 2, 3))
    one.fail({OFF}, {OFF})

    at = hover_after_failures(system, {OFF}, {OFF})
    linear = one.linearise(at.x, at.u)
    U = np.tile(at.u, (HORIZON, 1))
    y_ref = np.tile(setup.model.outputs(at.x), (HORIZON + 1, 1))
    prediction = one.predict(linear, one.discretise(linear), U, None)
    limits = one.condense(linear, prediction, y_ref).row_upper[-HORIZON * system.N :]

    margin_N = at.tensions - TENSION_N
    margin_N[OFF] = np.inf
    np.testing.assert_allclose(limits.reshape(HORIZON, -1), np.tile(margin_N, (HORIZON, 1)))


@pytest.mark.parametrize("owned", OWNED, ids=str)
def test_tension_rows_with_others_that_respond(owned: tuple[int, ...]) -> None:
    """With a shared control law the others' inputs respond to the decision, and the tensions to both."""
    setup, settings = (
        paper_setup(),
        SETTINGS.model_copy(update={"prediction": "closed_loop", "constraint": ()}),
    )
    at, one = situation(setup, settings, seed=9), controller(setup, settings, owned)
    law = one.law(at.x, np.tile(at.x, (HORIZON, 1)), 0.1 * at.U, None, 0)
    linear = one.linearise(at.x, at.u)
    prediction = one.predict(linear, one.discretise(linear), at.U, law)
    assert isinstance(prediction, Prediction)
    qp = one.condense(linear, prediction, at.y_ref, law)
    v = 0.2 * np.random.default_rng(2).standard_normal((HORIZON, len(one.own)))
    half = (settings.upper(len(owned)) - settings.lower(len(owned))) / 2.0
    dX = prediction.dX_free[:-1] + convolve(prediction.effect, v * half)
    U = prediction.U_all + convolve(prediction.feedback, v * half)
    U[:, one.own] = prediction.U_free + v * half
    rows = slice(len(qp.A) - HORIZON * len(owned), None)
    values = qp.A[rows, : v.size] @ v.reshape(-1)
    expected = (tensions(setup, at, dX, U - at.u, list(owned)) - TENSION_N).reshape(-1)
    np.testing.assert_allclose(qp.row_upper[rows] - values, expected, rtol=0.0, atol=BY_DIFFERENCES)


def test_linear_distance_is_a_lower_bound() -> None:
    """d' (r_i - r_j) <= |r_i - r_j| for any move, with equality at the linearisation point, so keeping it is safe."""
    rng = np.random.default_rng(1)
    for _ in range(50):
        positions, moved = rng.standard_normal(12), rng.standard_normal(12)
        distances, rows = pair_distances(positions, np.array(list(combinations(range(4), 2))))
        true = [
            np.linalg.norm(np.subtract(*moved.reshape(4, 3)[[i, j]]))
            for i, j in combinations(range(4), 2)
        ]
        assert close(rows @ positions, distances)
        assert (rows @ moved <= np.array(true) + ROUNDING).all()


def test_distances_of_several_instants_are_those_of_each() -> None:
    """One call for all steps of a horizon gives the same bits as a call for each."""
    R = np.random.default_rng(2).standard_normal((5, 12))
    R[3, 3:6] = R[3, 0:3]  # two in one point
    pairs = np.array(list(combinations(range(4), 2)))
    distances, gradients = pair_distances(R, pairs)
    for k, positions in enumerate(R):
        expected = pair_distances(positions, pairs)
        np.testing.assert_array_equal(distances[k], expected[0])
        np.testing.assert_array_equal(gradients[k], expected[1])


def test_uavs_in_one_point_are_pushed_apart() -> None:
    """Two UAVs in one point have no direction; some unit direction stands in and nothing is nan."""
    distances, rows = pair_distances(np.zeros(3 * 2), np.array([[0, 1]]))
    assert distances.tolist() == [0.0]
    assert np.linalg.norm(rows[0, :3]) == 1.0
    assert np.array_equal(rows[0, :3], -rows[0, 3:6])


def test_soft_equals_hard_when_the_penalty_is_high() -> None:
    """Above the multiplier of the hard constraint, the softened program has the hard one's plan and no slack."""
    setup, ceiling, horizon = paper_setup(), "r0[2] >= -10.01", 6
    y_ref = np.tile(setup.model.outputs(setup.x), (horizon + 1, 1))
    y_ref[:, 2:12:3] -= 1.0
    u = setup.hover.u
    at = Situation(x=setup.x, u=u, U=np.tile(u, (horizon, 1)), y_ref=y_ref)
    hard = ControllerSettings(
        horizon=horizon, constraint=(ConstraintSection(expression=ceiling, soft=False),)
    )
    soft = ControllerSettings(
        horizon=horizon, constraint=(ConstraintSection(expression=ceiling, penalty=1e4),)
    )
    cheap = ControllerSettings(
        horizon=horizon, constraint=(ConstraintSection(expression=ceiling, penalty=1e-3),)
    )
    plans = [
        step(controller(setup, settings, (0, 1, 2, 3)), at) for settings in (hard, soft, cheap)
    ]
    assert all(plan.solution.status == "solved" for plan in plans)
    assert np.abs(plans[0].U - plans[1].U).max() < SAME_PLAN
    assert plans[2].solution.z[-1] > 1e-3, (
        "the constraint was not active: the comparison shows nothing"
    )
