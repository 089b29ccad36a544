"""The paper's algorithm with the linearisation of the paper's own equations.

The reference cost of `paper`.
"""

from dataclasses import replace

import pytest

from tests.support import runs
from tests.support.published_jacobian import PublishedModel
from tests.support.systems import paper_setup, simulate, team

# Mean cost of the paper's maneuver with the Jacobian of paper (7)-(11), all unknowns kept, to the
# digits published.
PUBLISHED = 0.00227
DIGITS = 0.000005

STEPS = 500  # 25 s of 0.05 s


@pytest.mark.slow
def test_published_equations_cost() -> None:
    """Paper (22)-(27) on the Jacobian of (7)-(11) costs what the project publishes of the algorithm.

    `tests/system/test_processes.py` compares the run of `paper`, with the expansion (15), with this
    cost.
    """
    run, setup = runs.setup(), paper_setup()
    setup = replace(setup, model=PublishedModel(setup.system))
    found = simulate(setup, team(setup, run.settings, run.owned), 0.0, STEPS)
    assert found.statuses == {"solved"}
    assert found.mean_cost == pytest.approx(PUBLISHED, abs=DIGITS)
