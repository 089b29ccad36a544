"""Sequential (Gauss-Seidel) distributed model predictive control.

Within a tick the agents solve one after the other, each with the newest plans of the others:

    U_i <- argmin J(U_i | U_1 .. U_{i-1} of this tick, U_{i+1} .. U_M of the tick before)

As every agent improves the plan of the team that it finds, the cost of that plan never grows, for
any number of agents and without relaxation. In return a tick takes M exchanges, one after the other.
Agents beyond the number of exchanges solve together in the last one.

In this folder: transport run paper --set agents.controller=sequential:Sequential
    --set controller.negotiation_iterations=4
Source: Richards, How, Robust distributed model predictive control, Int. J. Control 80 (2007).
"""

import numpy as np
from paper import Paper


class Sequential(Paper):
    """The agent's turn comes in the exchange that its place on the roster says."""

    arena = {
        "tuned": "nothing: the cost is the task's",
        "settings": ["controller.negotiation_iterations=4"],
    }

    def step(self, measurement, messages):  # noqa: ARG002  # the estimate has both
        """Begin with the plans of the tick before; the first agent solves."""
        estimate = self.estimate
        self.program.about(estimate.x_start, estimate.u_before)
        self.Y_ref = self.reference()
        self.U = np.array(estimate.announced(self.run.horizon))
        return self.in_turn(0)

    def negotiate(self, iteration, messages):
        """Take the others' newest plans of this tick; the agent whose turn it is solves."""
        for plan in messages:
            columns = [4 * (uav - 1) + j for uav in plan.uavs for j in range(4)]
            rows = min(len(plan.inputs), len(self.U))
            self.U[:rows, columns] = plan.inputs[:rows]
            self.U[rows:, columns] = plan.inputs[-1]
        return self.in_turn(iteration)

    def in_turn(self, iteration):
        """Return the own inputs, solved anew if it is the agent's turn."""
        own = self.program.own
        last = self.run.settings.negotiation_iterations - 1
        turn = min(self.run.agents.index(self.run.agent), last)
        if iteration == turn:
            self.U[:, own] = self.program.solve(self.U.copy(), self.Y_ref)
        return self.U[:, own]
