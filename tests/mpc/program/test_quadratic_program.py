"""The optimality conditions that every answer is checked by.

By hand, and against errors put in on purpose.
"""

import numpy as np
import pytest

from transport.model.kernels import native
from transport.mpc.program.quadratic_program import QP, residuals

# A few products of small numbers: rounding only.
ROUNDING = 1e-15

# 1/2 |z|^2 - 3 z1 with -1 <= z1 <= 1 and 4 <= z1 + z2: the optimum is (1, 3), multipliers 5 and -3.
PROGRAM = QP(
    H=np.eye(2),
    g=np.array([-3.0, 0.0]),
    lower=np.array([-1.0, -np.inf]),
    upper=np.array([1.0, np.inf]),
    A=np.ones((1, 2)),
    row_lower=np.array([4.0]),
    row_upper=np.array([np.inf]),
)

# Answer (z, multipliers of the bounds, multiplier of the row) and its residuals by hand, each over
# its own scale: 1 + |g| = 4, 1 + |z| (largest entry), 1 + |objective|.
BY_HAND = {
    "the optimum": ([1.0, 3.0], [5.0, 0.0], -3.0, (0.0, 0.0, 0.0)),
    "multipliers forgotten": ([1.0, 3.0], [0.0, 0.0], 0.0, (3.0 / 4.0, 0.0, 0.0)),
    "row multiplier of the wrong sign": ([1.0, 3.0], [5.0, 0.0], 3.0, (6.0 / 4.0, 0.0, 3.0 / 3.0)),
    "bound multiplier of the wrong sign": (
        [1.0, 3.0],
        [-5.0, 0.0],
        -3.0,
        (10.0 / 4.0, 0.0, 10.0 / 3.0),
    ),
    "above a bound": ([1.5, 2.5], [0.0, 0.0], 0.0, (2.5 / 4.0, 0.5 / 3.5, 0.0)),
    "below a bound": ([-2.0, 6.0], [0.0, 0.0], 0.0, (6.0 / 4.0, 1.0 / 7.0, 0.0)),
    "below a row": ([1.0, 1.0], [0.0, 0.0], 0.0, (2.0 / 4.0, 2.0 / 2.0, 0.0)),
    "pushed by a distant bound": ([0.0, 4.0], [7.0, 0.0], -4.0, (0.0, 0.0, 7.0 / 9.0)),
    "pushed by a missing bound": ([1.0, 3.0], [5.0, -2.0], -3.0, (2.0 / 4.0, 0.0, 2.0 / 3.0)),
    "pushed down by a missing bound": ([1.0, 3.0], [5.0, 2.0], -3.0, (2.0 / 4.0, 0.0, 2.0 / 3.0)),
}


@pytest.mark.parametrize("compiled", [False, True], ids=["NumPy", "kernel"])
@pytest.mark.parametrize("name", BY_HAND)
def test_residuals_by_hand(name: str, *, compiled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stationarity, primal violation and complementarity of (28) in docs/equations.md, one error at a time."""
    if compiled and not native.AVAILABLE:
        pytest.skip("no compiled kernels")
    monkeypatch.setattr(native, "AVAILABLE", compiled)
    z, bound, row, expected = BY_HAND[name]
    found = residuals(PROGRAM, np.array(z), np.array(bound), np.array([row]))
    assert (found.stationarity, found.primal, found.complementarity) == pytest.approx(
        expected, abs=ROUNDING
    )
    assert found.worst == pytest.approx(max(expected), abs=ROUNDING)
