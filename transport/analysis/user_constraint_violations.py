"""The user's own constraints on the actual trajectory of a run."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from transport.analysis.series import Series
from transport.log.run_log import RunLog
from transport.model.arrays import Array
from transport.mpc.program.constraints.softened_user_constraints import softened_problem
from transport.mpc.program.user_expressions import UserConstraints, Variable
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Note

# Largest violation that is rounding, in units of the expression.
HELD = 1e-6


def own_constraints(setup: Setup, series: Series, log: RunLog) -> list[dict[str, Any]]:
    """Return each own constraint with its largest violation and its time, in the scenario's order.

    The violation of an inequality is the value of its expression where that is positive, of an
    equality its magnitude, in the unit of the expression; None where it is not finite. With it is
    the number of agents' steps in which a hard one was softened, as no plan met it.
    """
    softened = Counter(note.problem for note in log.of(Note))
    found: dict[str, dict[str, Any]] = {}
    points_on: Mapping[Variable, Array] = {"state": series.x, "input": series.u}
    for on, points in points_on.items():
        constraints = UserConstraints(setup.settings.constraint, setup.system, on)
        if not constraints.texts or not len(points):
            continue
        violations, instants = _largest(constraints, points)
        for text, violation, k in zip(constraints.texts, violations, instants, strict=True):
            found[text] = {
                "expression": text,
                "violation_max": float(violation) if np.isfinite(violation) else None,
                "at_s": float(series.times_s[k]),
                "softened_steps": softened[softened_problem(text)],
            }
    given = setup.settings.constraint
    return [found[each.expression] for each in given if each.expression in found]


def _largest(constraints: UserConstraints, points: Array) -> tuple[Array, npt.NDArray[np.intp]]:
    """Return the largest violations, (c,), and their rows in points, (k, n) or (k, m).

    One that is not finite counts as the largest.
    """
    values = np.array([constraints.at(point)[0] for point in points])
    violations = np.maximum(np.where(constraints.equality, np.abs(values), values), 0.0)
    instants = np.argmax(np.where(np.isnan(violations), np.inf, violations), axis=0)
    return violations[instants, np.arange(len(instants))], instants
