"""Which teams the shared regulator stabilises when a UAV's motors stop, and what follows where it cannot."""

from collections.abc import Set as AbstractSet

import numpy as np
import pytest

from tests.model.physics.test_failure import DEAD, larger
from tests.support.systems import paper_setup
from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.discretisation import zero_order_hold
from transport.model.linear.linearisation import Model
from transport.model.physics.hover import hover, hover_after_failures
from transport.model.physics.parameters import System, table_1
from transport.model.state import input_indices
from transport.mpc.controller import Controller, Horizon
from transport.mpc.law.infinite_horizon_lqr import HoveringTeam, Regulator, TeamFailures, regulator
from transport.mpc.law.present_law import Regulation
from transport.mpc.law.tangent import tangent
from transport.mpc.program.feedback_law import FeedbackError
from transport.mpc.program.stage_cost import Cost
from transport.mpc.settings_period_horizon_weights import ControllerSettings, Weights

PERIOD_S = 0.05
CLOSED = ControllerSettings(prediction="closed_loop", relaxation=1.0, terminal="riccati")

# Headings cost nothing and stay as they are: eigenvalue 1 to rounding. Everything else decays.
MARGINAL = 1e-6
# Rounding of a singular value of matrices of size one.
UNCONTROLLABLE = 1e-9
# Two Riccati recursions, the bob's 1e-6 kg between them, on gains of up to 30.
GAIN_TOLERANCE = 1e-3


def found(system: System, off: AbstractSet[int], released: AbstractSet[int]) -> Regulator:
    """Return the regulator of the remaining team."""
    at = hover_after_failures(system, off, released)
    cost = Cost(Weights(), system, at, off, released)
    team = TeamFailures(off=frozenset(off), released=frozenset(released))
    model = Model(system, off, released)
    return regulator(HoveringTeam(model=model, hover=at, cost=cost, team=team), PERIOD_S)


def control_margin(system: System, x: Array, u: Array) -> tuple[float, float]:
    """Return |z| of the unstable mode that is nearest to uncontrollable, and how near it is.

    That is the smallest singular value of [A - z I, B] over the eigenvalues z of the sampled
    linearisation outside the unit circle (the Popov-Belevitch-Hautus test). The UAV `DEAD` has no
    inputs.
    """
    discrete = zero_order_hold(Model(system, {DEAD}, set()).linearise(x, u), PERIOD_S)
    T = tangent(x, off={DEAD})
    A, B = T.T @ discrete.A @ T, T.T @ discrete.B
    eigenvalues = np.linalg.eigvals(A)
    unstable = eigenvalues[np.abs(eigenvalues) > 1.0 + 1e-3]
    margins = [np.linalg.svd(np.hstack([A - z * np.eye(len(A)), B]))[1][-1] for z in unstable]
    least = int(np.argmin(margins))
    return float(np.abs(unstable[least])), float(margins[least])


def test_three_stabilise_the_payload_without_the_fourth() -> None:
    """The regulator of the team without the released UAV is that of a system of three, and does not look at the bob."""
    system = table_1()
    live = [i for i in range(4) if i != DEAD]
    three = System(
        payload=system.payload, uavs=[system.uavs[i] for i in live], gravity=system.gravity
    )
    at = hover_after_failures(three, set(), set())
    cost = Cost(Weights(), three, at)
    of_three = regulator(HoveringTeam(model=Model(three), hover=at, cost=cost), PERIOD_S)
    K = found(system, {DEAD}, {DEAD}).K
    assert not K[state.input_slice(DEAD)].any()
    assert not K[:, state.uav_slice(DEAD)].any()
    columns = np.concatenate(
        [np.arange(12), *[np.arange(12) + state.uav_slice(i).start for i in live]]
    )
    np.testing.assert_allclose(K[input_indices(live)][:, columns], of_three.K, atol=GAIN_TOLERANCE)


@pytest.mark.parametrize(("uavs", "released"), [(4, True), (5, False), (6, False), (6, True)])
def test_what_can_be_stabilised(uavs: int, released: bool) -> None:
    """Four without the dead UAV, five and more with it balanced on its rod."""
    system = table_1() if uavs == 4 else larger(uavs)
    closed = found(system, {DEAD}, {DEAD} if released else set()).A_closed
    assert np.abs(np.linalg.eigvals(closed)).max() < 1.0 + MARGINAL


def test_four_with_the_dead_one_cannot_be_stabilised() -> None:
    """The dead UAV falls over: with the opposite one at zero thrust no input reaches that mode."""
    with pytest.raises(FeedbackError, match="can stabilise about hover, got a closed loop whose"):
        found(table_1(), {DEAD}, set())
    at = hover_after_failures(table_1(), {DEAD}, set())
    growth, margin = control_margin(table_1(), at.x, at.u)
    assert margin < UNCONTROLLABLE
    rod_m = table_1().uavs[DEAD].rod_length
    rate_rad_s = np.sqrt(table_1().gravity / rod_m)  # that of the rods 1 and 3 alone: 1.75 rad/s
    assert growth == pytest.approx(np.exp(rate_rad_s * PERIOD_S), rel=1e-6)


@pytest.mark.parametrize("released", [set(), {0, 1}])
def test_where_nothing_helps_the_control_law_stays(released: set[int]) -> None:
    """Without a hover, or one that can be stabilised, gain and cost are those of the whole team."""
    setup = paper_setup()
    controller = Controller(setup.model, setup.hover, CLOSED, [3])
    before, cost = controller.regulation.current.regulator, controller.cost
    controller.fail(released or {DEAD}, released)
    after = controller.regulation.current.regulator
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(after.K, before.K)
    np.testing.assert_array_equal(controller.cost.Q, cost.Q)
    assert (
        not controller.model.linearise(setup.hover.x, setup.hover.u)
        .B_c[:, input_indices(sorted(released or {DEAD}))]
        .any()
    )


def test_uavs_on_the_fail_safe_keep_their_thrust() -> None:
    """With UAV 3 of six cut loose and agent 2 dead, its UAV keeps its share of the load, and the others hold the rest.

    docs/equations.md (31), (51).
    """
    system = larger(6)
    whole = hover(system)
    regulation = Regulation(Model(system), whole, CLOSED)
    regulation.form([1], [DEAD], [DEAD])
    lift_N, at = regulation.hover.u[::4], regulation.hover
    assert lift_N[1] == pytest.approx(hover_after_failures(system, [DEAD], [DEAD]).u[4], abs=1e-9)
    assert lift_N[DEAD] == 0.0
    left_kg = system.total_mass - system.uavs[DEAD].mass
    assert lift_N.sum() == pytest.approx(left_kg * system.gravity, rel=1e-6)
    held = Model(system, {DEAD}, {DEAD}).derivative(at.x, at.u)
    assert np.abs(held[state.V0]).max() < 1e-4
    assert np.abs(held[state.OMEGA0]).max() < 1e-4


def test_derivatives_are_those_at_the_hover_of_the_present_team() -> None:
    """After a failure and the loss of an agent the next step has those of the new hover, and their hold, (35a)."""
    system, settings = larger(6), CLOSED.model_copy(update={"linearisation": "along"})
    at = hover(system)
    one = Controller(Model(system), at, settings, [0])

    def checked() -> Array:
        now = one.regulation.hover
        linear = one.linearise(at.x, at.u)
        found = linear.model.jacobians.values.copy()
        np.testing.assert_array_equal(found, one.model.linearise(now.x, now.u).jacobians.values)
        held = zero_order_hold(linear.model, settings.sampling_period_s)
        np.testing.assert_array_equal(one.discretise(linear).A, held.A)
        return found

    whole = checked()
    one.fail({DEAD}, {DEAD})
    failed = checked()
    one.without({1})
    lost = checked()
    assert (failed != whole).any()
    assert (lost != failed).any()


def test_at_hover_nothing_is_to_be_corrected() -> None:
    """At the hover of the remaining UAVs the control law gives that hover, and all corrections are zero."""
    setup = paper_setup()
    controller = Controller(setup.model, setup.hover, CLOSED, [3])
    controller.fail({DEAD}, {DEAD})
    at = hover_after_failures(setup.system, {DEAD}, {DEAD})
    steps = CLOSED.horizon
    x_ref, U = np.tile(setup.hover.x, (steps, 1)), np.tile(at.u, (steps, 1))
    law = controller.law(at.x, x_ref, np.zeros_like(U))
    y_ref = np.tile(setup.model.outputs(setup.hover.x), (steps + 1, 1))
    end = controller.end(at.x, x_ref[0])
    found = controller.step(at.x, at.u, Horizon(U=U, y_ref=y_ref, law=law, end=end))
    assert found.solution.status == "solved"
    np.testing.assert_allclose(found.U, U[:, controller.own], atol=1e-5)
    np.testing.assert_allclose(found.c, 0.0, atol=1e-5)
