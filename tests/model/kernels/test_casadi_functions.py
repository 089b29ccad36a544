"""CasADi functions behind buffers: arrays in, arrays out."""

import casadi as ca
import numpy as np
import pytest

from transport.model.kernels import casadi_functions
from transport.model.kernels.casadi_functions import Compiled


def test_compiled_functions_take_exactly_their_arguments() -> None:
    """Arrays of the wrong length are refused.

    A missing argument raises instead of reusing the last one.
    """
    a, b = ca.SX.sym("a", 2), ca.SX.sym("b")
    scale = Compiled(ca.Function("scale", [a, b], [a * b, ca.vertcat(a.T, b * a.T)]))
    vector, matrix = scale(np.array([1.0, 2.0]), 3.0)
    further, _ = scale(np.array([5.0, 7.0]), 2.0)  # another array than the one before
    assert np.array_equal(further, [10.0, 14.0])
    assert np.array_equal(vector, [3.0, 6.0])
    assert np.array_equal(matrix, [[1.0, 2.0], [3.0, 6.0]])
    with pytest.raises(ValueError, match="broadcast"):
        scale(np.zeros(3), 1.0)
    with pytest.raises(ValueError, match="zip"):
        scale(np.zeros(2))


def test_equations_of_each_kind_have_their_own_library() -> None:
    """Functions of another number of UAVs, of commanded rates or with drag are never loaded for one another."""
    kinds = [(N, rates, drag) for N in (2, 3) for rates in (False, True) for drag in (False, True)]
    assert len({casadi_functions._file(*kind) for kind in kinds}) == len(kinds)
