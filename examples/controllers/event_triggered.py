"""Event-triggered linear-quadratic control with a distributed observer.

Every agent runs the nonlinear model of the whole team under the control law that all have,

    u = u_hover - K (x_i - x_ref),    x_i(k+1) = f(x_i(k), u)

puts its measurements in place of what they measure, and moves towards the estimates x_j of others
that arrive, compared at the tick k_j that they were made at:

    x_i(k)  <-  x_i(k) + L_j (x_j(k_j) - x_i(k_j)),    L_j: OWN for what j measures, REST elsewhere

It sends its estimate when the others, who have predicted it since the last one, are wrong by more
than a limit in units of the cost-to-go, with P of the Riccati equation:

    (x_i - x_told)' P (x_i - x_told) > LIMIT,    x_told(k+1) = f(x_told(k), u(x_told))

In this folder: transport run resilient --set agents.controller=event_triggered:EventTriggered
Source: Garcia, Antsaklis, Model-based event-triggered control for systems with quantization and
time-varying network delays, IEEE Trans. Autom. Control 58 (2013); Olfati-Saber, Distributed Kalman
filtering for sensor networks, CDC 2007.
"""

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from transport import Step

OWN, REST = 0.2, 0.05  # gain on the entries that the sender measures, and on the others
LIMIT = 1e-2  # of the cost-to-go of the others' error
HISTORY = 64  # ticks: later estimates are not used


class EventTriggered:
    """Controller of the UAVs that an agent owns, which sends only news."""

    version = "1"
    arena = {"tuned": "gains of the observer and limit by hand, on the scenario resilient"}

    def start(self, run):
        """Compute the gain; declare the data, an estimate of the team."""
        n = len(run.x_hover)
        m = len(run.u_hover)
        run.share(n)
        linear = run.model.linearise(run.x_hover, run.u_hover)
        generator = np.zeros((n + m, n + m))
        generator[:n] = np.hstack([linear.A_c, linear.B_c])
        held = expm(run.period_s * generator)

        # The rods hang: the third entries of their unit direction and of its rate cannot change.
        free = [i for i in range(n) if i < 12 or (i - 12) % 12 not in (2, 5)]
        A = held[np.ix_(free, free)]
        B = held[free, n:]
        C = linear.C[:, free]
        Q = C.T @ (run.settings.weights.Q(run.system.N)[:, None] * C) + 1e-3 * np.eye(len(A))
        R = np.diag(run.settings.weights.R(run.system))

        #   P = A' P A - A' P B (R + B' P B)^-1 B' P A + Q,    K = (R + B' P B)^-1 B' P A
        P = solve_discrete_are(A, B, Q, R)
        self.K = np.zeros((m, n))
        self.K[:, free] = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        self.P = np.zeros((n, n))
        self.P[np.ix_(free, free)] = P
        self.run = run
        self.x = run.reference(0)
        self.told = run.reference(0)
        self.past = {}  # own estimates by tick
        self.columns = [4 * uav + j for uav in run.owned for j in range(4)]

    def step(self, measurement, messages):
        """Return one row of inputs, the estimate, and whether it is news."""
        run = self.run
        if self.past:
            self.x = self.predicted(self.x)
            self.told = self.predicted(self.told)
        for plan in messages:
            if plan.data.size and plan.tick in self.past:
                self.x += self.gain(plan.uavs) * (plan.data - self.past[plan.tick])
        run.write(self.x, measurement)
        self.past[run.tick] = self.x.copy()
        self.past.pop(run.tick - HISTORY, None)

        error = self.x - self.told
        news = error @ self.P @ error
        send = bool(news > LIMIT or run.must_send)
        if send:
            self.told = self.x.copy()
        inputs = self.inputs(self.x, run.tick + run.delay)[self.columns]
        return Step(inputs=inputs, data=self.x, numbers={"news": news, "sent": send}, send=send)

    def inputs(self, x, tick):
        """Return the inputs of all UAVs by the law."""
        u = self.run.u_hover - self.K @ (x - self.run.reference(tick))
        limits = self.run.settings
        return np.clip(u, limits.lower(self.run.system.N), limits.upper(self.run.system.N))

    def predicted(self, x):
        """Return a state one period later under the law."""
        u = self.inputs(x, self.run.tick - 1 + self.run.delay)
        return self.run.model.integrate(x, u, self.run.period_s, 2)[0].copy()

    def gain(self, uavs):
        """Return the gain on an estimate of the agent with these UAVs, counted from 1, (n,)."""
        L = np.full(len(self.x), REST)
        for uav in uavs:
            L[12 * uav : 12 * uav + 12] = OWN
        return L

    def stop(self):
        """Nothing is open."""
