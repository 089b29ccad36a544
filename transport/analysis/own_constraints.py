"""The user's own constraints on the actual trajectory of a run."""

from collections import Counter
from typing import Any, Literal

import numpy as np

from transport.analysis.series import Series
from transport.log.run_log import RunLog
from transport.model.arrays import Array
from transport.mpc.expressions import UserConstraints
from transport.mpc.softening import softened_problem
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.messages import Note

# Largest violation that is rounding, in units of the expression.
HELD = 1e-6


def own_constraints(setup: Setup, series: Series, log: RunLog) -> list[dict[str, Any]]:
    """Return each own constraint with its largest violation and its time, in the scenario's order.

    The violation of an inequality is the value of its expression where that is positive, of an
    equality its magnitude, in the unit of the expression; None where it is not finite. With it is
    the number of agents' steps in which a hard one was softened, as no plan met it.
    """
    problems = Counter(note.problem for note in log.of(Note))
    settings, system = setup.settings, setup.system
    found: dict[str, dict[str, Any]] = {}
    points_of: dict[Literal["state", "input"], Array] = {"state": series.x, "input": series.u}
    for on, points in points_of.items():
        constraints = UserConstraints(settings.constraint, system, on)
        if not len(constraints.texts) or not len(points):
            continue
        values = np.array([constraints.at(point)[0] for point in points])
        excess = np.maximum(np.where(constraints.equality, np.abs(values), values), 0.0)
        worst = np.argmax(np.where(np.isnan(excess), np.inf, excess), axis=0)
        for column, text in enumerate(constraints.texts):
            violation = float(excess[worst[column], column])
            found[text] = {
                "expression": text,
                "violation_max": violation if np.isfinite(violation) else None,
                "at_s": float(series.times_s[worst[column]]),
                "softened_steps": problems[softened_problem(text)],
            }
    return [found[each.expression] for each in settings.constraint if each.expression in found]
