"""Constraints that several agents keep together (docs/equations.md (30c), (30d))."""

from functools import lru_cache

import numpy as np
import pytest

from tests.support.systems import paper_setup
from transport.model.arrays import Array
from transport.model.state import input_indices
from transport.mpc.program.constraints.shared_rows import default_penalties, share
from transport.mpc.program.constraints.user_constraints import OwnInputs
from transport.mpc.program.decision import Decision
from transport.mpc.program.prediction import Linear, Prediction
from transport.mpc.program.trajectory import Announced, TimeInvariant
from transport.mpc.settings_period_horizon_weights import (
    ConstraintSection,
    ControllerSettings,
    Weights,
)

# Rows of four UAVs: the sum of all thrusts, thrusts of UAVs 1 and 3, the moments of UAV 2 alone.
ROWS = np.zeros((3, 16), dtype=bool)
ROWS[0, ::4] = True
ROWS[1, [0, 8]] = True
ROWS[2, 5:8] = True


@pytest.mark.parametrize("teams", [[[0], [1], [2], [3]], [[0, 1], [2, 3]], [[0, 1, 2, 3]]])
def test_the_agents_of_a_row_correct_it_once(teams: list[list[int]]) -> None:
    """Each corrects the violation over its factor, weighed by its inputs: together the violation."""
    for row, uavs in enumerate(({0, 1, 2, 3}, {0, 2}, {1})):
        corrected = 0.0
        for owned in teams:
            if uavs & set(owned):
                factor = share(ROWS[row : row + 1], input_indices(owned))[0]
                corrected += 1.0 / factor
        assert corrected == pytest.approx(1.0)


def test_a_row_of_owned_inputs_keeps_its_effect() -> None:
    """An agent alone in a row has factor 1."""
    assert share(ROWS[2:], input_indices([1]))[0] == 1.0


def test_the_default_penalties_are_in_the_scale_of_the_cost() -> None:
    """All weights times a number give that number times the penalties; places count over the horizon."""
    weights = Weights(position=3.0, payload_position=1.0)
    scaled = Weights(position=30.0, payload_position=10.0)
    for before, after in zip(
        default_penalties(weights, 4, 20), default_penalties(scaled, 4, 20), strict=True
    ):
        assert after == pytest.approx(10.0 * before)
    of_places, other = default_penalties(weights, 4, 20)
    assert default_penalties(weights, 4, 40) == pytest.approx((2.0 * of_places, other))


# A sum of thrusts that hover exceeds by 8 N, and plans of a single step.
SETUP = paper_setup()
EXCESS_N = 8.0
SUM_N = float(SETUP.hover.u[::4].sum()) - EXCESS_N
SETTINGS = ControllerSettings(
    horizon=1,
    constraint=(
        ConstraintSection(expression=f"thrust1 + thrust2 + thrust3 + thrust4 <= {SUM_N!r}"),
    ),
)
# Of a corrected newton: rounding.
CLOSE = 1e-9


@lru_cache
def _constraint(uav: int) -> tuple[Decision, OwnInputs]:
    """Return the sum as an agent of one UAV keeps it."""
    decision = Decision(SETUP.system, SETTINGS, (uav,))
    return decision, OwnInputs(decision)


def _corrections(uav: int, c: Array) -> float:
    """Return the correction of the thrust that keeps an agent's row, from those announced, (4,), N."""
    decision, constraint = _constraint(uav)
    u_hover, m = SETUP.hover.u, SETUP.system.m
    corrections = np.zeros((1, m))
    corrections[0, ::4] = c
    none = np.zeros((0, 1, 4))
    prediction = Prediction(
        effect=none,
        dX_free=np.zeros((2, SETUP.system.n)),
        U_free=u_hover[decision.own][None],
        U_all=u_hover[None],
        feedback=none,
        dU_free=np.zeros((1, m)),
    )
    trajectory = TimeInvariant(
        decision=decision,
        linear=Linear(
            x0=SETUP.hover.x,
            z0=SETUP.hover.x,
            u0=u_hover,
            model=SETUP.model.linearise(SETUP.hover.x, u_hover),
            u_target=u_hover,
        ),
        prediction=prediction,
        announced=Announced(U=u_hover + corrections, c=corrections),
    )
    row = constraint.block(trajectory)
    return float(row.upper[0] / row.A[0, 0] * decision.scale[0])


def test_agents_that_correct_alike_each_take_their_share_at_once() -> None:
    """Whatever correction all have announced, each takes a quarter of the excess by the law."""
    for announced_N in (0.0, -1.0, -5.0):
        taken = _corrections(1, np.full(4, announced_N))
        assert taken == pytest.approx(-EXCESS_N / 4.0, abs=CLOSE)


def test_agents_whose_corrections_differ_come_together() -> None:
    """From corrections of two agents alone, all come to the same ones, which keep the constraint."""
    c, w = np.array([-4.0, -4.0, 0.0, 0.0]), 0.25
    spreads = []
    for _ in range(80):
        c = (1.0 - w) * c + w * np.array([_corrections(uav, c) for uav in range(4)])
        spreads.append(np.ptp(c))
    assert (np.diff(spreads) < 0.0).all()
    np.testing.assert_allclose(c, -EXCESS_N / 4.0, atol=1e-3)
