"""The stage cost, by hand."""

import numpy as np
import pytest

from mpc.cost import Cost
from mpc.settings import Weights
from tests.support.systems import changed, paper_setup, ring_setup

# A handful of products of numbers near 1: rounding only.
ROUNDING = 1e-13


def test_stage_cost_by_hand() -> None:
    """(y - y_ref)' Q (y - y_ref) + (u - u_hover)' R (u - u_hover), paper (17), term by term for one UAV."""
    setup = ring_setup(1)
    uavs = Weights(position=2.0, attitude=3.0, yaw_rate=0.5, thrust=0.1, moments=(1.0, 10.0, 100.0))
    cost = Cost(changed(uavs, payload_position=7.0, payload_velocity=0.25), setup.system, setup.hover)
    y_ref = np.zeros(13)
    y = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3, 4.0, 0.5, -1.0, 1.5, 2.0, 0.0, -6.0])
    u = setup.hover.u + np.array([2.0, 0.1, -0.2, 0.3])
    positions, attitudes, yaw_rate = 2.0 * (1.0 + 4.0 + 9.0), 3.0 * (0.01 + 0.04 + 0.09), 0.5 * 16.0
    payload = 7.0 * (0.25 + 1.0 + 2.25) + 0.25 * (4.0 + 36.0)
    efforts = 0.1 * 4.0 + 1.0 * 0.01 + 10.0 * 0.04 + 100.0 * 0.09
    assert cost.stage(y, y_ref, u) == pytest.approx(positions + attitudes + yaw_rate + payload + efforts, rel=ROUNDING)


def test_error_is_measured_from_the_reference() -> None:
    """Moving output and reference together changes nothing: the cost depends on their difference only, paper (17)."""
    setup = paper_setup()
    cost = Cost(Weights(), setup.system, setup.hover)
    rng = np.random.default_rng(0)
    y, y_ref, u = rng.integers(-8, 8, 25) / 4.0, rng.integers(-8, 8, 25) / 4.0, setup.hover.u
    assert cost.stage(y + 0.5, y_ref + 0.5, u) == cost.stage(y, y_ref, u)
    assert cost.stage(y, y, u) == 0.0


def test_deviation_is_measured_from_hover() -> None:
    """With the deviation penalised, hover is free and an equal change either way costs the same."""
    setup = paper_setup()
    cost, y = Cost(Weights(penalised_input="deviation"), setup.system, setup.hover), setup.model.outputs(setup.x)
    change = np.linspace(-1.0, 1.0, setup.system.m)
    assert cost.stage(y, y, setup.hover.u) == 0.0
    more, less = cost.stage(y, y, setup.hover.u + change), cost.stage(y, y, setup.hover.u - change)
    assert more == pytest.approx(less, rel=ROUNDING * setup.hover.u.max())


def test_absolute_inputs_are_measured_from_zero() -> None:
    """With the input itself penalised, paper (17), hover costs its squared thrusts."""
    setup = paper_setup()
    weights, y = Weights(penalised_input="absolute", thrust=0.5), setup.model.outputs(setup.x)
    cost = Cost(weights, setup.system, setup.hover)
    assert cost.stage(y, y, np.zeros(setup.system.m)) == 0.0
    thrust = (3.0 / 4.0 + 1.5) * 9.81  # each UAV lifts itself and a quarter of the payload
    assert cost.stage(y, y, setup.hover.u) == pytest.approx(4 * 0.5 * thrust**2, rel=ROUNDING)


@pytest.mark.parametrize("N", [1, 2, 4, 8])
def test_weights_for_any_team(N: int) -> None:
    """Q and R have one entry per output and input."""
    setup = ring_setup(N)
    cost = Cost(Weights(), setup.system, setup.hover)
    assert cost.Q.shape == (setup.system.p,) == (4 * N + 9,)
    assert cost.R.shape == cost.u_target.shape == (4 * N,)
