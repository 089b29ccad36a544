"""The algorithm of the paper by the interface of an own class.

Every agent solves its own program with the inputs of the others fixed to their last plans
(docs/equations.md (22)-(30)), all at once and once per tick:

    U_i(k) = argmin J(U_i | U_j(k-1), j != i)

Estimate and alignment of the plans are those of the project (`run.estimator`), prediction and
program are those of program.py. Its cost is that of the built-in controller.

In this folder: transport run paper --set agents.controller=paper:Paper
Source: the paper, section IV; docs/equations.md.
"""

import numpy as np
from program import Program


class Paper:
    """Distributed model predictive control of the UAVs that an agent owns."""

    version = "1"
    arena = {"tuned": "nothing: the cost is the task's"}

    def start(self, run):
        """Ask for the project's estimate of the team."""
        self.run = run
        self.estimate = run.estimator()
        self.program = Program(run, run.owned)

    def step(self, measurement, messages):  # noqa: ARG002  # the estimate has both
        """Return the inputs over the horizon."""
        estimate = self.estimate
        self.program.about(estimate.x_start, estimate.u_before)
        return self.program.solve(estimate.announced(self.run.horizon), self.reference())

    def reference(self):
        """Return the reference outputs at steps 1..N_p."""
        run = self.run
        first = run.tick + run.delay + 1
        ticks = range(first, first + run.horizon)
        return np.array([run.model.outputs(run.reference(tick)) for tick in ticks])

    def stop(self):
        """Nothing is open."""
