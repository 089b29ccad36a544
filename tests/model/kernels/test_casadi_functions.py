"""CasADi functions behind buffers: arrays in, arrays out."""

import casadi as ca
import numpy as np
import pytest

from transport.model.kernels.casadi_functions import Compiled


def test_compiled_functions_take_exactly_their_arguments() -> None:
    """Arrays of the wrong length are refused.

    A missing argument raises instead of reusing the last one.
    """
    a, b = ca.SX.sym("a", 2), ca.SX.sym("b")
    scale = Compiled(ca.Function("scale", [a, b], [a * b, ca.vertcat(a.T, b * a.T)]))
    vector, matrix = scale(np.array([1.0, 2.0]), 3.0)
    assert np.array_equal(vector, [3.0, 6.0])
    assert np.array_equal(matrix, [[1.0, 2.0], [3.0, 6.0]])
    with pytest.raises(ValueError, match="broadcast"):
        scale(np.zeros(3), 1.0)
    with pytest.raises(ValueError, match="zip"):
        scale(np.zeros(2))
