"""Quadratic programs for the tests of the solvers: random, infeasible, and from simulated runs."""

from dataclasses import fields
from functools import lru_cache

import numpy as np

from tests.support.systems import paper_setup, situations, team
from transport.model.arrays import Array
from transport.mpc.program.quadratic_program import QP
from transport.mpc.settings_period_horizon_weights import (
    ConstraintSection,
    ControllerSettings,
    SeparationSection,
)


def random_qp(seed: int) -> QP:
    """Return a strictly convex, feasible program with one-sided and missing bounds, ranges and equalities."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 16))
    r = int(rng.integers(0, 2 * n))
    M = rng.standard_normal((n, n))
    inside = rng.standard_normal(n)
    A = rng.standard_normal((r, n))
    values = A @ inside

    def below(at: Array) -> Array:
        return np.where(rng.random(len(at)) < 0.3, -np.inf, at - rng.uniform(0.0, 1.0, len(at)))

    row_lower, row_upper = below(values), -below(-values)
    equal = rng.permutation(r)[: min(r, n // 3)]
    row_lower[equal] = row_upper[equal] = values[equal]
    return QP(
        H=M @ M.T + 0.1 * np.eye(n),
        g=3.0 * rng.standard_normal(n),
        lower=below(inside),
        upper=-below(-inside),
        A=A,
        row_lower=row_lower,
        row_upper=row_upper,
    )


def without_solution() -> dict[str, QP]:
    """Return programs whose rows contradict each other, the bounds, or another equality."""
    free = {
        "H": np.eye(2),
        "g": np.ones(2),
        "lower": np.full(2, -np.inf),
        "upper": np.full(2, np.inf),
    }
    twice = np.array([[1.0, 1.0], [1.0, 1.0]])
    return {
        "two equalities": QP(**free, A=twice, row_lower=np.array([0.0, 1.0]), row_upper=np.array([0.0, 1.0])),
        "two ranges": QP(**free, A=twice, row_lower=np.array([-np.inf, 1.0]), row_upper=np.array([0.0, np.inf])),
        "row against bounds": QP(
            **{**free, "lower": np.zeros(2), "upper": np.ones(2)},
            A=twice[:1], row_lower=np.array([3.0]), row_upper=np.array([np.inf]),
        ),
        "empty row": QP(**free, A=np.zeros((1, 2)), row_lower=np.array([1.0]), row_upper=np.array([2.0])),
    }  # fmt: skip


@lru_cache
def collected(minimum_m: float) -> list[QP]:
    """Return programs of a short climb of the paper's system, centralized and distributed, with all constraints.

    The UAVs start 0.5 m apart, so a larger minimum distance needs its slack from the first step on.
    """
    setup = paper_setup()
    settings = ControllerSettings(
        horizon=8,
        separation=SeparationSection(minimum_m=minimum_m),
        constraint=(
            ConstraintSection(expression="r0[2] >= -10.001"),
            ConstraintSection(expression="thrust1 + thrust2 <= 45"),
            ConstraintSection(expression="tau3[2] == 0"),
        ),
    )
    centralized = team(setup, settings, [(0, 1, 2, 3)])
    programs = []
    for at in situations(setup, centralized, start_s=5.0, steps=8):
        for one in [*centralized, *team(setup, settings, [(0,), (1, 2)])]:
            linear = one.linearise(at.x, at.u)
            prediction = one.predict(linear, one.discretise(linear), at.U, None)
            qp = one.condense(linear, prediction, at.y_ref)
            programs.append(
                QP(**{field.name: getattr(qp, field.name).copy() for field in fields(qp)})
            )
    return programs
