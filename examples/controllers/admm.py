"""Consensus ADMM: the optimum of the whole team, by agents that each have a part of the problem.

The problem of the team is a sum over agents: agent i has the outputs, efforts and limits of its own
UAVs and a share of the payload's attitude. z are the inputs of all UAVs over the horizon, in units of
half their range. Each agent has a copy z_i, duals l_i and, in the common metric M,

    z_i  <-  argmin J_i(z_i) + 1/2 |z_i - z + l_i|^2_M,  own inputs within their limits
    z    <-  mean of z_j + l_j                           from the data z_j + l_j of all agents
    l_i  <-  l_i + z_i - z

An exchange is one such iteration; copies and duals go on from tick to tick, shifted by a period. The
plan is the own part of the copy. Late or lost data are used shifted, the last row held.

The others' inputs are free in the own program: with P = H_i + M and q = M (z - l_i) - g_i, the own
ones minimise 1/2 o' (P_oo - P_of P_ff^-1 P_fo) o - (q_o - P_of P_ff^-1 q_f)' o within their limits.
M is the mean curvature of the parts, so that the number of iterations depends on no weight.

In this folder: transport run paper --set agents.controller=admm:ADMM
    --set controller.negotiation_iterations=10
Source: Boyd, Parikh, Chu, Peleato, Eckstein, Distributed optimization and statistical learning via
the alternating direction method of multipliers, Found. Trends Mach. Learn. 3 (2011), section 7.
"""

import numpy as np
from paper import Paper
from program import Program, solved
from scipy.linalg import cho_factor, cho_solve

PENALTY = 1.0  # of a copy's difference from the consensus, as a multiple of the mean curvature


class ADMM(Paper):
    """Part of one agent in a consensus about the inputs of all UAVs."""

    arena = {
        "tuned": "the penalty by hand, on the maneuver, perfect network",
        "settings": ["controller.negotiation_iterations=10"],
    }

    def start(self, run):
        """Declare the data, (N_p, 4 N) inputs, and take the agent's part of the cost."""
        super().start(run)
        N = run.system.N
        run.share((run.horizon, 4 * N))
        self.team = Program(run, range(N))
        self.part = Program(run, range(N))
        is_own = np.isin(np.arange(N), run.owned)

        # Outputs: positions of the UAVs, attitude of the payload, yaw rates, motion of the payload.
        share = len(run.owned) / N
        outputs = [np.repeat(is_own, 3), np.full(3, share), is_own, np.full(6, share)]
        self.part.Q = self.team.Q * np.concatenate(outputs)
        self.part.R = self.team.R * np.repeat(is_own, 4)
        self.columns = np.flatnonzero(np.repeat(is_own, 4))  # own entries of u
        own = np.tile(np.repeat(is_own, 4), run.horizon)
        self.own = np.flatnonzero(own)  # own entries of z
        self.others = np.flatnonzero(~own)
        self.U = np.tile(run.u_hover, (run.horizon, 1))  # z as inputs
        self.heard = {}  # newest data of each agent with their tick

    def step(self, measurement, messages):  # noqa: ARG002  # the estimate has the measurement
        """Form the own program about the present state, and go on with the shifted iterates."""
        estimate = self.estimate
        for program in (self.team, self.part):
            program.about(estimate.x_start, estimate.u_before)
        Y_ref = self.reference()
        H, self.g = self.part.cost(self.U, Y_ref)
        self.M = PENALTY / self.run.system.N * self.team.cost(self.U, Y_ref)[0]

        P = H + self.M
        o, f = self.own, self.others
        self.P_ff = cho_factor(P[np.ix_(f, f)])
        self.P_of = P[np.ix_(o, f)]
        self.P_o = P[np.ix_(o, o)] - self.P_of @ cho_solve(self.P_ff, self.P_of.T)
        lower, upper = self.team.bounds()
        self.limits = [lower[o]], [upper[o]]
        self.U = shifted(self.U, 1)
        return self.iterate(messages)

    def negotiate(self, iteration, messages):  # noqa: ARG002
        """Iterate once with the data of this exchange."""
        return self.iterate(messages)

    def iterate(self, messages):
        """Return the own part of the copy, and its data."""
        self.heard |= {plan.agent: (plan.tick, plan.data) for plan in messages if plan.data.size}
        duals = np.zeros(len(self.g))
        if self.run.agent in self.heard:
            data = [shifted(W, self.run.tick - tick) for tick, W in self.present()]
            self.U = np.mean(data, axis=0)
            tick, own = self.heard[self.run.agent]
            duals = self.team.scaled(shifted(own, self.run.tick - tick)) - self.team.scaled(self.U)
        z = self.team.scaled(self.U)
        copy = self.minimised(self.M @ (z - duals) - self.g)

        inputs = self.team.inputs(copy)
        data = inputs + duals.reshape(inputs.shape) * self.team.range
        self.heard[self.run.agent] = self.run.tick, data
        return inputs[:, self.columns], data, {"disagreement": np.abs(copy - z).max()}

    def present(self):
        """Return the newest data of the agents on the roster, with their ticks."""
        return [self.heard[agent] for agent in self.run.agents if agent in self.heard]

    def minimised(self, q):
        """Return argmin 1/2 z' P z - q' z with the own inputs within their limits."""
        o, f = self.own, self.others
        q_o = q[o] - self.P_of @ cho_solve(self.P_ff, q[f])
        z_o = solved(self.P_o, -q_o, np.zeros((0, len(o))), *self.limits)
        z = np.empty(len(q))
        z[o] = z_o
        z[f] = cho_solve(self.P_ff, q[f] - self.P_of.T @ z_o)
        return z


def shifted(rows, ticks):
    """Return rows some ticks later, the last one held."""
    return rows[np.minimum(np.arange(len(rows)) + ticks, len(rows) - 1)]
