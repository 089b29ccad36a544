"""The oracle of the expansion.

The published equations themselves, and where the two expansions may differ.
"""

import numpy as np
import pytest

from tests.support.paper_form import accelerations, thrust_forces
from tests.support.published_jacobian import PublishedModel
from tests.support.random_systems import random_input, random_state, random_system
from transport.model.linear.linearisation import Model
from transport.mpc.law.tangent import tangent

# Relative to the largest entry: two linear solves of 6 + 3 N unknowns, and of 6, with conditions of
# up to 1e4.
ROUNDING = 1e-11


@pytest.mark.parametrize("N", [1, 4])
def test_equations_are_those_of_the_paper(N: int) -> None:
    """Away from |e| = 1 the oracle's accelerations are those of paper (11) as `paper_form` assembles it."""
    rng = np.random.default_rng(40 + N)
    system = random_system(rng, N)
    x, u = random_state(rng, N) + 0.1 * rng.standard_normal(12 + 12 * N), random_input(rng, N)
    expected = np.concatenate(
        [part.reshape(-1) for part in accelerations(system, x, thrust_forces(x, u))]
    )
    assert (
        np.abs(PublishedModel(system).accelerations(x, u) - expected).max()
        < ROUNDING * np.abs(expected).max()
    )


@pytest.mark.parametrize("N", [1, 4])
def test_along_the_manifold_both_expansions_agree(N: int) -> None:
    """In every direction the state can take, A_c is the derivative of the published equations, (15); paper (13).

    The directions are those of rods at rest; where Omega_i is not zero, e_i . Omega_i = 0 ties
    Omega_i to e_i.
    """
    rng = np.random.default_rng(50 + N)
    system, x, u = random_system(rng, N), random_state(rng, N), random_input(rng, N)
    for i in range(N):
        x[12 + 12 * i + 3 : 12 + 12 * i + 6] = 0.0
    T = tangent(x)
    found, expected = Model(system).linearise(x, u), PublishedModel(system).linearise(x, u)
    assert np.abs((found.A_c - expected.A_c) @ T).max() < ROUNDING * np.abs(expected.A_c).max()
