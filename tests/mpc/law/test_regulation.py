"""Control law, cost-to-go and preview are one problem.

Without active constraints no agent leaves the control law.

The theorem of docs/equations.md (36a)-(36e): on the linear model about hover, with no constraint
active, c = 0 is the optimum of every agent's program, for any owned UAVs and any horizon.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import pytest

from tests.support.linear_model import (
    LinearModel,
    difference,
    reference_outputs,
    reference_states,
    small_state,
    uneven,
)
from tests.support.systems import changed
from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.physics.hover import Hover, hover
from transport.model.physics.parameters import System, table_1
from transport.model.state import input_indices, input_slice
from transport.mpc.alone.fail_safe import FailSafe
from transport.mpc.controller import Controller, Horizon, StepResult
from transport.mpc.law.present_law import Regulation
from transport.mpc.program.stage_cost import Cost
from transport.mpc.reference import Sampled
from transport.mpc.settings_period_horizon_weights import (
    AloneGains,
    ControllerSettings,
    CostTerm,
    Limits,
    Weights,
)

# Relative to the largest deviation of the inputs from hover: two solutions of one linear problem
# with condition around 1e5, one by the Riccati recursion, one by condensing and a solver.
NO_CORRECTION = 1e-8
# Share of the same deviation: above any rounding; a program with another cost has larger
# corrections.
A_CORRECTION = 1e-2
# Relative, the same sum of 5000 products in another order; the slowest mode that costs has died out
# by then.
SAME_COST = 1e-8
STEPS_TO_REST = 5000
# Modes without damping have modulus 1: headings, and equal rods against each other. Rounding of
# their eigenvalues.
MODE_TOLERANCE = 1e-6

INSTANTS = 80
# In the hover before the maneuver, within a leg, shortly before a corner, at rest behind it, beyond
# the last instant.
STARTS = (0, 15, 23, 40, INSTANTS + 3)

# So wide that no bound or rate limit is active.
WIDE = Limits(
    thrust_N=(0.0, 100.0), moments_Nm=(1e2,) * 3, thrust_rate_N_s=1e4, moment_rates_Nm_s=(1e4,) * 3
)
LQ = ControllerSettings(prediction="closed_loop", terminal="riccati", preview=True, limits=WIDE)
PAYLOAD = Weights(position=0.1, payload_position=1.0, payload_velocity=0.1)
# One of them pulls at the reference itself for ever: its value there is not zero.
TERMS = (CostTerm(expression="v0[0]", weight=0.3), CostTerm(expression="e1[0] - 0.02", weight=0.5))


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A team and the settings of its controllers.

    Attributes:
        owned: UAVs of the agent whose program is solved, 0-based.
        gone: UAVs without an agent.
        forced: Whether external forces are estimated.
    """

    system: System = field(default_factory=table_1)
    owned: Sequence[int] = (1,)
    gone: Sequence[int] = ()
    forced: bool = False
    weights: Weights = field(default_factory=Weights)
    costs: tuple[CostTerm, ...] = ()


CASES = {
    "single": Case(),
    "pair": Case(owned=(1, 2)),
    "centralized": Case(owned=(0, 1, 2, 3)),
    "forces": Case(forced=True),
    "payload": Case(weights=PAYLOAD),
    "costs": Case(costs=TERMS),
    "gone": Case(gone=[2]),
    "single, all": Case(forced=True, weights=PAYLOAD, costs=TERMS),
    "pair, all": Case(owned=(0, 3), forced=True, weights=PAYLOAD, costs=TERMS),
    "centralized, all": Case(owned=(0, 1, 2, 3), forced=True, weights=PAYLOAD, costs=TERMS),
    "single, all, gone": Case(gone=[2], forced=True, weights=PAYLOAD, costs=TERMS),
    "pair, all, pair gone": Case(
        system=uneven(), owned=(0, 1), gone=[2, 3], forced=True, weights=PAYLOAD, costs=TERMS
    ),
    "uneven": Case(system=uneven(), owned=(1, 4), forced=True, weights=PAYLOAD, costs=TERMS),
    "uneven, gone": Case(system=uneven(), owned=(1, 4), gone=[2], forced=True, weights=PAYLOAD, costs=TERMS),
}  # fmt: skip


def held(X: Array, start: int, count: int) -> Array:
    """Rows from `start` on, the last one in place of those behind it."""
    return np.asarray(X[np.minimum(np.arange(start, start + count), len(X) - 1)])


def optimum(
    one: Controller, X_ref: Array, k: int, x: Array, u0: Array, forces: Array | None
) -> StepResult:
    """One step of a controller at an instant of the maneuver, all announced corrections zero."""
    steps = one.settings.horizon
    window = held(X_ref, k, steps + 1)
    U = np.tile(u0, (steps, 1))
    law = one.law(x, window[:-1], np.zeros_like(U), forces, k)
    end = one.end(x, window[-1], forces, k + steps)
    y_ref = reference_outputs(one.model, window)
    return one.step(x, u0, Horizon(U=U, y_ref=y_ref, law=law, end=end), forces)


def corrections(
    case: Case, settings: ControllerSettings, starts: Sequence[int] = STARTS
) -> list[float]:
    """Largest correction an agent finds from random small states, relative to the largest input deviation."""
    at = hover(case.system)
    model = LinearModel(case.system, at)
    X_ref = reference_states(case.system, at, "ramp", INSTANTS)
    settings = changed(settings, weights=case.weights, cost=case.costs)
    one = Controller(model, at, settings, case.owned, Sampled(X=X_ref))
    if case.gone:
        one.without(case.gone)
    shares = []
    for k in starts:
        rng = np.random.default_rng(100 * settings.horizon + k)
        forces = rng.normal(0.0, 2.0, 3 + 3 * case.system.N) if case.forced else None
        x = held(X_ref, k, 1)[0] + small_state(at, rng, 0.05)
        u0 = at.u + 0.1 * rng.standard_normal(len(at.u))
        if settings.motor_lag_s > 0.0:
            x = np.concatenate([x, at.u + 0.1 * rng.standard_normal(len(at.u))])
        found = optimum(one, X_ref, k, x, u0, forces)
        assert found.solution.status == "solved"
        assert not np.any(found.solution.row_multipliers), (
            "a constraint is active: the theorem says nothing"
        )
        deviation = float(np.abs(found.U - at.u[one.own]).max())
        assert deviation > 0.1, "nothing to do: the comparison shows nothing"
        shares.append(float(np.abs(found.c).max()) / deviation)
    return shares


@pytest.mark.parametrize("horizon", [1, 5, 20])
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_no_agent_leaves_the_law(case: Case, horizon: int) -> None:
    """c = 0 is the optimum of every program, from any small state and instant, docs/equations.md (36a)-(36e)."""
    assert max(corrections(case, changed(LQ, horizon=horizon))) < NO_CORRECTION


@pytest.mark.parametrize(
    ("name", "lag_s", "horizon"),
    [
        ("single, all", 0.005, 1),
        ("single, all", 0.1, 20),
        ("pair, all, pair gone", 0.03, 5),
        ("centralized, all", 0.1, 5),
    ],
)
def test_no_agent_leaves_the_law_of_motors(name: str, lag_s: float, horizon: int) -> None:
    """With motors that lag, c = 0 is the optimum as well.

    Gain, preview, cost-to-go and prediction are of (55).
    """
    assert (
        max(corrections(CASES[name], changed(LQ, horizon=horizon, motor_lag_s=lag_s)))
        < NO_CORRECTION
    )


@pytest.mark.parametrize("name", ["single, all, gone", "uneven, gone"])
def test_no_agent_leaves_the_law_beside_uavs_that_follow_alone(name: str) -> None:
    """With UAVs that respond to the others without an agent, c = 0 is the optimum as well, (45).

    Their effort is given, so that no program may weigh it among that of the others, (36e).
    """
    follow = changed(LQ, horizon=5, fail_safe="follow")
    assert max(corrections(CASES[name], follow)) < NO_CORRECTION


@pytest.mark.parametrize("change", [{"terminal": "multiple"}, {"preview": False}])
def test_another_cost_has_corrections(change: dict[str, object]) -> None:
    """Without the cost-to-go or the preview the same program leaves the control law.

    The guarantee assumes them.
    """
    assert min(corrections(Case(), changed(LQ, **change), [15])) > A_CORRECTION


def test_without_preview_nothing_is_missing_at_rest() -> None:
    """With a reference at rest the control law needs no preview, (36c)."""
    assert max(corrections(Case(), changed(LQ, preview=False), [INSTANTS])) < NO_CORRECTION


@pytest.mark.parametrize("forced", [False, True])
def test_centralized_open_loop_program_is_the_law(forced: bool) -> None:
    """With all UAVs owned, cost-to-go and preview, the program alone gives the inputs of the control law, (36d)."""
    system = table_1()
    at = hover(system)
    model, X_ref = LinearModel(system, at), reference_states(system, at, "min_jerk", INSTANTS)
    free = Controller(model, at, changed(LQ, prediction="open_loop"), range(4), Sampled(X=X_ref))
    shared = Controller(model, at, LQ, range(4), Sampled(X=X_ref))
    rng = np.random.default_rng(4)
    forces = rng.normal(0.0, 2.0, 15) if forced else None
    x = X_ref[15] + small_state(at, rng, 0.05)
    plan = optimum(free, X_ref, 15, x, at.u, forces)
    law = optimum(shared, X_ref, 15, x, at.u, forces)
    assert plan.c.shape == (0, 16)
    assert np.abs(plan.U - law.U).max() < NO_CORRECTION * np.abs(law.U - at.u).max()
    first = shared.regulation.inputs(x, X_ref[15], forces, 15)
    assert first is not None
    np.testing.assert_array_equal(free.regulation.gain(15), shared.regulation.gain(15))
    assert np.abs(plan.U[0] - first).max() < NO_CORRECTION * np.abs(law.U - at.u).max()


@lru_cache
def uneven_hover() -> Hover:
    """Equilibrium of the uneven team."""
    return hover(uneven())


@pytest.mark.parametrize("terms", [(), TERMS[:1]])
@pytest.mark.parametrize("gone", [[], [2]])
def test_cost_to_go_is_the_sum_of_the_costs_to_come(
    gone: list[int], terms: tuple[CostTerm, ...]
) -> None:
    """|root (x - x_hover)|^2 is the cost of the closed loop summed until it rests, docs/equations.md (36d)."""
    system, at = uneven(), uneven_hover()
    model = difference(system, at)
    regulation = Regulation(Model(system), at, changed(LQ, weights=PAYLOAD, cost=terms))
    regulation.form(gone, (), ())
    law, cost = regulation.current.regulator, Cost(PAYLOAD, system, at)
    assert law is not None
    deviation = small_state(at, np.random.default_rng(2), 0.1)
    x, R = deviation, cost.R.copy()
    R[input_indices(gone)] = 0.0  # the fail-safe of a UAV without an agent is given, not optimised
    total = 0.0
    for _ in range(STEPS_TO_REST):
        y, u = model.C @ x, law.K @ x
        total += float(y @ (cost.Q * y) + u @ (R * u)) + sum(
            term.weight * x[state.V0.start] ** 2 for term in terms
        )
        x = model.A @ x + model.B @ u
    end = regulation.current.cost_to_go(at.x + deviation, at.x, None, 0)
    assert end is not None
    assert not end.slope.any()
    assert np.linalg.norm(end.root @ end.error) ** 2 == pytest.approx(total, rel=SAME_COST)


@pytest.mark.parametrize("gone", [[2, 3], [1, 3], [1, 2, 3]])
def test_equal_uavs_without_agents(gone: list[int]) -> None:
    """Two equal UAVs without agents swing against each other for ever.

    The others' gain is found all the same, (45).

    No other UAV feels that mode, and it has a cost; with a discount of the far future the cost is
    finite. Rows of those without agents are the fail-safe's, and no mode of the closed loop grows.
    """
    system = table_1()
    at, model = hover(system), Model(system)
    regulation = Regulation(
        model, at, LQ, Sampled(X=reference_states(system, at, "ramp", INSTANTS))
    )
    regulation.form(gone, (), ())
    found = regulation.current.regulator
    assert found is not None
    assert np.abs(np.linalg.eigvals(found.A_closed)).max() < 1.0 + MODE_TOLERANCE
    for uav in gone:
        fail_safe = FailSafe(system, at.u).gain(uav)
        np.testing.assert_array_equal(found.K[input_slice(uav)], fail_safe)
        assert np.count_nonzero(found.K[input_slice(uav)]) == np.count_nonzero(fail_safe)

    # K = -(R + g^2 B'PB)^-1 g^2 B'P A, with the root g of the discount.
    discount = 1.0 - 1e-4
    controlled = found.controlled
    B = found.T.T @ difference(system, at).B[:, controlled]
    A = found.A + found.B_uncontrolled @ found.K[found.uncontrolled] @ found.T
    R = regulation.current.cost.R[controlled]
    M = np.diag(R) + discount**2 * B.T @ found.P @ B
    expected = -np.linalg.solve(M, discount**2 * B.T @ found.P @ A) @ found.T.T
    np.testing.assert_allclose(found.K[controlled], expected, atol=1e-5)


# UAVs without agents, without motors, cut loose.
TEAMS = (
    ((), (2,), (2,)),
    ((0,), (2,), (2,)),
    ((0, 1), (2,), (2,)),
    ((0,), (2,), ()),
    ((1, 3), (), ()),
)


@pytest.mark.parametrize("team", TEAMS)
def test_the_team_alone_decides(team: tuple[tuple[int, ...], ...]) -> None:
    """Agents that know of the same team share the same control law, bit for bit, whatever the history, (45)."""
    system = table_1()
    at, model = hover(system), Model(system)
    X_ref = reference_states(system, at, "ramp", INSTANTS)
    # Controllers of one model share results.
    fresh, old = (
        Regulation(model, at, LQ, Sampled(X=X_ref)),
        Regulation(Model(system), at, LQ, Sampled(X=X_ref)),
    )
    fresh.form(*team)
    for before in (((0, 1), (), ()), ((), (2,), ()), ((0, 1), (2,), (2,))):
        old.form(*before)
    old.form(*team)
    assert fresh.current.regulator is not None
    assert old.current.regulator is not None
    np.testing.assert_array_equal(old.current.regulator.K, fresh.current.regulator.K)
    np.testing.assert_array_equal(old.current.cost.u_target, fresh.current.cost.u_target)
    np.testing.assert_array_equal(old.current.cost.Q, fresh.current.cost.Q)
    np.testing.assert_array_equal(
        old.current.feedforward(0, INSTANTS), fresh.current.feedforward(0, INSTANTS)
    )


def test_no_gain_exists_through_rounding_alone() -> None:
    """UAV 3 cut loose and agent 1 dead.

    Two rods in a line cannot hold the payload, and no gain pretends to, (45).
    """
    system = table_1()
    at, model = hover(system), Model(system)
    whole = Regulation(model, at, LQ).current.regulator
    assert whole is not None
    for gone in (0, 1):
        regulation = Regulation(model, at, LQ)
        regulation.form([gone], [2], [2])
        assert regulation.current.regulator is not None
        assert np.abs(regulation.current.regulator.K).max() < 3.0 * np.abs(whole.K).max()


def test_a_reference_that_is_changed_in_place_is_another_one() -> None:
    """Laws are shared by the numbers they follow from, (36c): not by the array that held them."""
    system = table_1()
    at, model = hover(system), Model(system)
    X_ref = reference_states(system, at, "ramp", INSTANTS)
    before = Regulation(model, at, LQ, Sampled(X=X_ref))
    alike = Regulation(model, at, LQ, Sampled(X=X_ref.copy()))
    assert alike.current.preview is before.current.preview, "equal numbers are computed once"

    X_ref[INSTANTS // 2 :, state.R0] += [0.0, 0.0, 1.0]
    after = Regulation(model, at, LQ, Sampled(X=X_ref))
    alone = Regulation(Model(system), at, changed(LQ, relaxation=0.5), Sampled(X=X_ref.copy()))
    steps = 0, INSTANTS
    new = after.current.feedforward(*steps)
    np.testing.assert_array_equal(new, alone.current.feedforward(*steps))
    assert np.abs(new - before.current.feedforward(*steps)).max() > A_CORRECTION


def test_uavs_without_agents_have_the_gains_of_their_own_team() -> None:
    """Teams that differ in the gains of UAVs alone share no law in which such a UAV flies, (45)."""
    system = table_1()
    at, model, gone = hover(system), Model(system), 2
    X_ref = reference_states(system, at, "ramp", INSTANTS)
    own_gains = AloneGains(), AloneGains(position=3.0)
    teams = []  # all alive: laws are shared as long as one has them
    for gains in own_gains:
        settings = changed(LQ, fail_safe="follow", alone=gains)
        teams.append(Regulation(model, at, settings, Sampled(X=X_ref)))
        teams[-1].form([gone], (), ())
    for gains, regulation in zip(own_gains, teams, strict=True):
        assert regulation.current.regulator is not None
        expected = FailSafe(system, at.u, X_ref[:1], gains=gains).gain(gone)
        np.testing.assert_array_equal(regulation.current.regulator.K[input_slice(gone)], expected)
