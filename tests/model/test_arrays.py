"""Checks of arrays."""

import numpy as np
import pytest

from transport.model.arrays import ascending, within


@pytest.mark.parametrize(
    ("numbers", "is_within"),
    [
        ([1.0, -1.0], True),
        ([1.0, -1.0, 1.0, 1.0], True),  # the sum of squares is above the square of the largest
        ([0.0, -1.0000001], False),
        ([np.nan, 0.0], False),
        ([np.inf], False),
        ([1e200, 0.0], False),  # whose square overflows
        ([], True),
    ],
)
def test_within_is_a_bound_of_each_magnitude(numbers: list[float], is_within: bool) -> None:
    """The largest itself is within; NaN and infinity are not; an empty array is."""
    with np.errstate(over="ignore"):
        assert within(np.array(numbers), 1.0) is is_within


def test_ascending_numbers_are_distinct() -> None:
    """They are those of `numpy.unique`, also of one number and of none."""
    for arrays in (([3.0, 1.0], [1.0, 2.0, 3.0]), ([5.0],), ([],), ([0.0, -0.0],)):
        assert ascending(*arrays).tolist() == np.unique(np.concatenate(arrays)).tolist()
