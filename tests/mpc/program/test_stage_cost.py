"""The stage cost, by hand."""

import numpy as np
import pytest

from tests.support.systems import changed, paper_setup, ring_setup
from transport.mpc.program.stage_cost import Cost
from transport.mpc.settings_period_horizon_weights import Weights

# A handful of products of numbers near 1: rounding only.
ROUNDING = 1e-13


def test_stage_cost_by_hand() -> None:
    """(y - y_ref)' Q (y - y_ref) + (u - u_hover)' R (u - u_hover), paper (17), term by term for one UAV."""
    setup = ring_setup(1)
    uavs = Weights(position=2.0, attitude=3.0, yaw_rate=0.5, thrust=0.1, moments=(1.0, 10.0, 100.0))
    cost = Cost(
        changed(uavs, payload_position=7.0, payload_velocity=0.25), setup.system, setup.hover
    )
    y_ref = np.zeros(13)
    y = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3, 4.0, 0.5, -1.0, 1.5, 2.0, 0.0, -6.0])
    u = setup.hover.u + np.array([2.0, 0.1, -0.2, 0.3])
    positions, attitudes, yaw_rate = 2.0 * (1.0 + 4.0 + 9.0), 3.0 * (0.01 + 0.04 + 0.09), 0.5 * 16.0
    payload = 7.0 * (0.25 + 1.0 + 2.25) + 0.25 * (4.0 + 36.0)
    efforts = 0.1 * 4.0 + 1.0 * 0.01 + 10.0 * 0.04 + 100.0 * 0.09
    assert cost.stage(y, y_ref, u) == pytest.approx(
        positions + attitudes + yaw_rate + payload + efforts, rel=ROUNDING
    )


def test_absolute_inputs_are_measured_from_zero() -> None:
    """With the input itself penalised, paper (17), hover costs its squared thrusts."""
    setup = paper_setup()
    weights, y = Weights(penalised_input="absolute", thrust=0.5), setup.model.outputs(setup.x)
    cost = Cost(weights, setup.system, setup.hover)
    assert cost.stage(y, y, np.zeros(setup.system.m)) == 0.0
    thrust = (3.0 / 4.0 + 1.5) * 9.81  # each UAV lifts itself and a quarter of the payload
    assert cost.stage(y, y, setup.hover.u) == pytest.approx(4 * 0.5 * thrust**2, rel=ROUNDING)
