"""Consensus ADMM: the optimum of the whole team, by agents that each know a part of the cost.

The cost of the team is a sum over agents, J(z) = sum_i J_i(z): agent i has the outputs and efforts of
its own UAVs and a share of the payload's attitude. z are the inputs of all UAVs over the horizon, in
units of half their range, and Z the box of their limits. Each agent has a copy z_i, duals l_i and

    z_i  <-  argmin J_i(z_i) + rho/2 |z_i - z + l_i|^2      = (H_i + rho I)^-1 (rho (z - l_i) - g_i)
    z    <-  projection of the mean of z_j + l_j on Z       from the data z_j + l_j of all agents
    l_i  <-  l_i + z_i - z

An exchange is one such iteration; copies and duals go on from tick to tick, shifted by a period. The
plan is z. Late or lost data are used shifted, the last row held.

In this folder: transport run paper --set agents.controller=admm:ADMM
    --set controller.negotiation_iterations=10
Source: Boyd, Parikh, Chu, Peleato, Eckstein, Distributed optimization and statistical learning via
the alternating direction method of multipliers, Found. Trends Mach. Learn. 3 (2011), section 7.
"""

import numpy as np
from paper import Paper
from program import Program
from scipy.linalg import cho_factor, cho_solve

RHO = 2.0  # penalty of the copies, in units of the cost, for inputs in units of half their range


class ADMM(Paper):
    """Part of one agent in a consensus about the inputs of all UAVs."""

    def start(self, run):
        """Declare the data, (N_p, 4 N) inputs, and take the agent's part of the cost."""
        super().start(run)
        N = run.system.N
        run.share((run.horizon, 4 * N))
        self.program = Program(run, range(N))
        self.own = [4 * uav + j for uav in run.owned for j in range(4)]
        is_own = np.isin(np.arange(N), run.owned)
        share = len(run.owned) / N

        # Outputs: positions of the UAVs, attitude of the payload, yaw rates, motion of the payload.
        self.program.Q *= np.concatenate(
            [np.repeat(is_own, 3), np.full(3, share), is_own, np.full(6, share)]
        )
        self.program.R *= np.repeat(is_own, 4)
        self.U = np.tile(run.u_hover, (run.horizon, 1))  # z as inputs
        self.l = np.zeros_like(self.U)
        self.heard = {}  # newest data of each agent with their tick

    def step(self, measurement, messages):  # noqa: ARG002  # the estimate has the measurement
        """Form the own problem about the present state, and go on with the shifted iterates."""
        self.program.about(self.estimate.x_start, self.estimate.u_before)
        H, self.g = self.program.cost(self.U, self.reference())
        self.factor = cho_factor(H + RHO * np.eye(len(H)))
        self.lower, self.upper = self.program.bounds()
        self.U = shifted(self.U, 1)
        self.l = shifted(self.l, 1)
        return self.iterate(messages)

    def negotiate(self, iteration, messages):  # noqa: ARG002
        """Iterate once with the data of this exchange."""
        return self.iterate(messages)

    def iterate(self, messages):
        """Return the own part of the consensus, and the data of the own copy."""
        for plan in messages:
            if plan.data.size:
                self.heard[plan.agent] = plan.tick, plan.data
        if self.run.agent in self.heard:
            self.agree()

        #   z_i = (H_i + rho I)^-1 (rho (z - l_i) - g_i)
        z = self.scaled(self.U)
        self.copy = cho_solve(self.factor, RHO * (z - self.l.reshape(-1)) - self.g)
        data = self.inputs(self.copy) + self.l * self.program.range
        self.heard[self.run.agent] = self.run.tick, data
        return self.U[:, self.own], data, {"disagreement": np.abs(self.copy - z).max()}

    def agree(self):
        """Take the projected mean of all agents' data as z, and move the duals."""
        present = [agent for agent in self.heard if agent in self.run.agents]
        data = [shifted(W, self.run.tick - tick) for tick, W in map(self.heard.get, present)]
        z = np.clip(self.scaled(np.mean(data, axis=0)), self.lower, self.upper)
        own_tick, own = self.heard[self.run.agent]
        moved = self.scaled(shifted(own, self.run.tick - own_tick)) - z
        self.l = moved.reshape(self.l.shape)  # l_i + z_i - z, as the own data are z_i + l_i
        self.U = self.inputs(z)

    def scaled(self, U):
        """Return inputs in units of half their range about those in force, flat."""
        return ((U - self.program.u0) / self.program.range).reshape(-1)

    def inputs(self, z):
        """Return inputs from such units, (N_p, 4 N)."""
        return self.program.u0 + z.reshape(-1, len(self.program.u0)) * self.program.range


def shifted(rows, ticks):
    """Return rows some ticks later, the last one held."""
    return rows[np.minimum(np.arange(len(rows)) + ticks, len(rows) - 1)]
