"""The steady state under external forces, and that the controller stays there."""

from functools import lru_cache

import numpy as np
import pytest
from scipy.linalg import null_space

from tests.support.systems import Setup, controller, paper_setup, ring_setup
from transport.model import state
from transport.model.arrays import Array
from transport.mpc.alone.fail_safe import FailSafe
from transport.mpc.controller import Horizon
from transport.mpc.law.infinite_horizon_lqr import HoveringTeam
from transport.mpc.law.steady_state import SteadyState, target
from transport.mpc.law.tangent import tangent
from transport.mpc.program.stage_cost import Cost
from transport.mpc.settings_period_horizon_weights import (
    ControllerSettings,
    PredictionName,
    Weights,
)

# Sums of a few dozen terms through a singular value decomposition of matrices with entries of up to
# 35.
ROUNDING = 1e-11
# N and N m. Two programs' worth of solver tolerance, as between two solvers.
PLAN_AGREEMENT = 1e-5
WEIGHTS = Weights()


def setup_of(name: str) -> Setup:
    """The paper's system, or a ring of as many UAVs as the name says."""
    return paper_setup() if name == "paper" else ring_setup(int(name))


@lru_cache
def found(name: str) -> SteadyState:
    """The target of a system."""
    setup = setup_of(name)
    cost = Cost(WEIGHTS, setup.system, setup.hover)
    return target(HoveringTeam(model=setup.model, hover=setup.hover, cost=cost))


def equations(setup: Setup) -> tuple[Array, Array, Array]:
    """Rest of the linearisation at hover, rows of (x, u), its right-hand side per force, and the output's rows."""
    linear = setup.model.linearise(setup.hover.x, setup.hover.u)
    T = tangent(setup.hover.x)
    rest = np.hstack([T.T @ linear.A_c, T.T @ linear.B_c])
    return rest, -T.T @ setup.model.force_effect(setup.hover.x, setup.hover.u), linear.C


@pytest.mark.parametrize("name", ["paper", "1", "2", "3", "6"])
def test_target_is_a_steady_state(name: str) -> None:
    """A_c M_x + B_c M_u + E = 0, and rods stay rods to first order, docs/equations.md (40)."""
    setup = setup_of(name)
    rest, pushed, _ = equations(setup)
    at = found(name)
    assert np.abs(rest @ np.vstack([at.M_x, at.M_u]) - pushed).max() < ROUNDING
    # Rods hang straight down: to first order they can only move sideways.
    assert np.abs(state.StateView(at.M_x.T).e_P[..., 2]).max() < ROUNDING


@pytest.mark.parametrize("name", ["paper", "1", "2", "3", "6"])
def test_nothing_is_better(name: str) -> None:
    """No other steady state has less output error, and none with the same output error takes less input."""
    setup = setup_of(name)
    rest, _, C = equations(setup)
    at, cost, n = found(name), Cost(WEIGHTS, setup.system, setup.hover), setup.system.n
    T = tangent(setup.hover.x)
    moves = null_space(np.hstack([rest[:, :n] @ T, rest[:, n:]]))
    dx, du = T @ moves[: T.shape[1]], moves[T.shape[1] :]
    error = C @ at.M_x
    assert np.abs((C @ dx).T @ (cost.Q[:, None] * error)).max() < ROUNDING
    silent = null_space(C @ dx, rcond=1e-9)
    assert np.abs((du @ silent).T @ (cost.R[:, None] * at.M_u)).max() < ROUNDING


def test_wind_on_the_payload() -> None:
    """Weighted outputs keep their reference under any force.

    The payload is off by l / (m_0 g), UAVs lean a quarter.
    """
    setup, at = paper_setup(), found("paper")
    _, _, C = equations(setup)
    assert np.abs((C @ at.M_x)[WEIGHTS.Q(setup.system.N) > 0.0]).max() < ROUNDING
    lean = state.StateView(at.M_x[:, 0])
    assert lean.r0_I[0] == pytest.approx(3.2 / (3.0 * 9.81))
    # Against a push along x the thrust leans back: -f R k has -f sin(pitch) along x.
    assert lean.Theta[:, 1] == pytest.approx(np.full(4, 0.25 / setup.hover.u[0]))
    # The push acts 0.125 m below the attachment points, which lie 0.25 m before and behind the
    # centre.
    assert at.M_u[::4, 0] == pytest.approx(0.125 / (4.0 * 0.25) * np.array([-1.0, -1.0, 1.0, 1.0]))


@pytest.mark.parametrize("prediction", ["open_loop", "closed_loop"])
@pytest.mark.parametrize("owned", [(0,), (0, 1, 2, 3)])
def test_the_controller_rests_at_the_target(
    prediction: PredictionName, owned: tuple[int, ...]
) -> None:
    """At the target, with all inputs there, the plan is to stay.

    There is no offset to trade for effort.
    """
    setup = paper_setup()
    settings = ControllerSettings(prediction=prediction)
    one = controller(setup, settings, owned)
    F = np.append([0.0, 0.0, 5.0], np.zeros(12))
    x, u = (
        setup.x + one.regulation.current.target.M_x @ F,
        setup.hover.u + one.regulation.current.target.M_u @ F,
    )
    U = np.tile(u, (settings.horizon, 1))
    y_ref = np.tile(setup.model.outputs(setup.x), (settings.horizon + 1, 1))
    law = one.law(x, np.tile(setup.x, (settings.horizon, 1)), np.zeros_like(U), F)
    optimum = one.step(x, u, Horizon(U=U, y_ref=y_ref, law=law), F)
    assert np.abs(optimum.U - u[one.own]).max() < PLAN_AGREEMENT
    assert np.abs(optimum.c).max(initial=0.0) < PLAN_AGREEMENT
    without = one.law(x, np.tile(setup.x, (settings.horizon, 1)), np.zeros_like(U))
    ignorant = one.step(x, u, Horizon(U=U, y_ref=y_ref, law=without))
    assert np.abs(ignorant.U - u[one.own]).max() > 0.1


def test_a_uav_on_its_own_is_no_means() -> None:
    """Under the fail-safe a UAV's inputs follow from its state.

    The others carry the payload, and all rest.
    """
    setup = paper_setup()
    uncontrolled = FailSafe(setup.system, setup.hover.u).gain(3)
    one = controller(setup, ControllerSettings(prediction="closed_loop"), (0,))
    together = one.regulation.current.target
    one.without([3])
    at = one.regulation.current.target
    rest, pushed, _ = equations(setup)
    assert np.abs(rest @ np.vstack([at.M_x, at.M_u]) - pushed).max() < ROUNDING
    own = state.input_slice(3)
    assert np.abs(at.M_u[own] - uncontrolled @ at.M_x).max() < ROUNDING
    assert np.abs(at.M_u[own, 2]).max() < ROUNDING
    assert at.M_u[::4, 2].sum() == pytest.approx(1.0)
    one.without([])
    np.testing.assert_array_equal(one.regulation.current.target.M_u, together.M_u)
