"""Centralized nonlinear model predictive control by do-mpc, the reference without approximations.

One agent for all UAVs solves, at every tick, the problem of the team on the nonlinear model f:

    minimise    sum_{k=0..N_p-1} |y(k) - y_ref(k)|^2_Q + |u(k) - u_hover|^2_R  +  |y(N_p) - y_ref(N_p)|^2_{Q_f}
    subject to  x(k+1) = x(k) + T_s f((x(k) + x(k+1)) / 2, u(k)),  x(0) measured,
                y(k) = h(x(k)),  u_min <= u(k) <= u_max

That is direct collocation with one Gauss point for each sampling period, of order 2. IPOPT begins
at the last solution. There are neither limits on changes of inputs nor a smallest distance of UAVs.

Needs do-mpc: pip install 'payload-transport[nmpc]'
In this folder: transport run centralized --set agents.controller=nmpc:NMPC
Source: Fiedler et al., do-mpc: towards FAIR nonlinear and robust model predictive control, Control
Engineering Practice 140 (2023); Waechter, Biegler, On the implementation of an interior-point filter
line-search algorithm for large-scale nonlinear programming, Math. Program. 106 (2006).
"""

import contextlib
import io
import warnings

import casadi as ca
import numpy as np

with warnings.catch_warnings(action="ignore"):  # of parts of do-mpc that are not used
    import do_mpc

from transport.model.physics.dynamics import motion
from transport.model.physics.outputs_and_sensors import outputs
from transport.model.physics.symbols import Symbols

IPOPT = {
    "ipopt.tol": 1e-5,
    "ipopt.max_iter": 30,  # five to ten are needed from the last solution
    "ipopt.mumps_pivtol": 0.0,  # halves the time of the linear solver
}


class NMPC:
    """Controller of all UAVs on the nonlinear model."""

    version = f"do-mpc {do_mpc.__version__}"
    arena = {"tuned": "nothing: the cost is the task's", "centralized": True}

    def start(self, run):
        """State the problem; what do-mpc and CasADi say about each other is silenced."""
        self.run = run
        silent = warnings.catch_warnings(action="ignore", category=FutureWarning)
        with silent, contextlib.redirect_stdout(io.StringIO()):
            self.state_problem()
        self.mpc.x0 = run.reference(0)
        self.mpc.u0 = run.u_hover
        self.mpc.set_initial_guess()

    def state_problem(self):
        """Build model and program."""
        run = self.run
        f, self.h = functions(run.system)
        model = do_mpc.model.Model("continuous", "SX")
        x = model.set_variable("_x", "x", (len(run.x_hover), 1))
        u = model.set_variable("_u", "u", (len(run.u_hover), 1))
        weights = run.settings.weights
        Q = weights.Q(run.system.N)
        y_ref = model.set_variable("_tvp", "y_ref", (len(Q), 1))
        model.set_rhs("x", f(x, u))
        model.setup()

        self.mpc = do_mpc.controller.MPC(model)
        self.mpc.settings.n_horizon = run.horizon
        self.mpc.settings.t_step = run.period_s
        self.mpc.settings.store_full_solution = False
        self.mpc.settings.collocation_type = "legendre"
        self.mpc.settings.collocation_deg = 1
        self.mpc.settings.nlpsol_opts = IPOPT
        self.mpc.settings.supress_ipopt_output()

        error = self.h(x) - y_ref
        effort = u - ca.DM(run.u_hover)
        stage = ca.dot(ca.DM(Q), error**2)
        effort_cost = ca.dot(ca.DM(weights.R(run.system)), effort**2)
        self.mpc.set_objective(lterm=stage + effort_cost, mterm=weights.terminal * stage)
        self.mpc.set_rterm(u=0.0)  # changes of inputs cost nothing
        self.mpc.bounds["lower", "_u", "u"] = run.lower
        self.mpc.bounds["upper", "_u", "u"] = run.upper
        self.ahead = self.mpc.get_tvp_template()
        self.mpc.set_tvp_fun(self.reference)
        self.mpc.setup()

    def reference(self, _):
        """Return the reference outputs at steps 0..N_p."""
        run = self.run
        for k in range(run.horizon + 1):
            self.ahead["_tvp", k] = self.h(run.reference(run.tick + run.delay + k))
        return self.ahead

    def step(self, measurement, messages):  # noqa: ARG002  # there are no others
        """Return the first inputs of the solution."""
        x = np.empty(len(self.run.x_hover))
        self.run.write(x, measurement)
        return np.ravel(self.mpc.make_step(x[:, None]))

    def stop(self):
        """Nothing is open."""


def functions(system):
    """Return f(x, u) and h(x) of a team, docs/equations.md (1)-(13)."""
    symbols = Symbols.of(*system.kind)
    parameters = ca.DM(system.vector())
    still = ca.substitute(motion(symbols).derivative, symbols.F, 0.0)  # no external forces
    f = ca.substitute(still, symbols.p, parameters)
    h = ca.substitute(outputs(symbols), symbols.p, parameters)
    return ca.Function("f", [symbols.x, symbols.u], [f]), ca.Function("h", [symbols.x], [h])
