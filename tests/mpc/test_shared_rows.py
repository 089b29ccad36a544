"""Constraints that several agents keep together (docs/equations.md (30c), (30d))."""

import numpy as np
import pytest

from transport.model.state import input_indices
from transport.mpc.settings import Weights
from transport.mpc.shared_rows import default_penalties, share

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
