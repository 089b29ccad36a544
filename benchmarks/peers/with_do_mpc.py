"""The centralized controller of the team in do-mpc.

The whole nonlinear problem, solved by IPOPT at every tick.

`transport run centralized --set agents.controller=benchmarks.peers.with_do_mpc:Centralized` flies
it. What do-mpc does by default stays: collocation of order 2, IPOPT with MUMPS, tolerances; the
solver's output is silenced. Its problem has no limits on changes of inputs and no separation.
"""

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import do_mpc
import numpy as np

import transport
from transport.agent.user_class.run_for_user import Run
from transport.model.arrays import Array
from transport.model.physics.dynamics import motion
from transport.model.physics.outputs_and_sensors import outputs
from transport.model.physics.symbols import Symbols
from transport.mpc.program.stage_cost import Cost
from transport.protocol.wire.messages import Measurement, Plan


class Centralized:
    """Controller of all UAVs."""

    version = f"do-mpc {do_mpc.__version__}"

    def start(self, run: Run) -> None:
        """State the problem: this method is what a user of do-mpc writes."""
        self.run, system = run, run.system
        setup = transport.Scenario("centralized").setup
        weights, cost = setup.settings.weights, Cost(setup.settings.weights, system, setup.hover)
        symbols = Symbols.of(*system.kind)
        derivative, seen = (
            ca.Function(
                "f", [symbols.x, symbols.u], [ca.substitute(of, symbols.p, ca.DM(system.vector()))]
            )
            for of in (ca.substitute(motion(symbols).derivative, symbols.F, 0.0), outputs(symbols))
        )

        model = do_mpc.model.Model("continuous", "SX")
        x = model.set_variable("_x", "x", (len(run.x_hover), 1))
        u = model.set_variable("_u", "u", (len(run.u_hover), 1))
        y_ref = model.set_variable("_tvp", "y_ref", (len(cost.Q), 1))
        model.set_rhs("x", derivative(x, u))
        model.setup()

        mpc = self.mpc = do_mpc.controller.MPC(model)
        mpc.settings.n_horizon, mpc.settings.t_step = run.horizon, run.period_s
        mpc.settings.store_full_solution = False
        mpc.settings.nlpsol_opts = {"ipopt.tol": 1e-3}
        mpc.settings.supress_ipopt_output()
        error, effort = seen(x, u) - y_ref, u - run.u_hover
        stage = ca.dot(cost.Q, error**2)
        mpc.set_objective(lterm=stage + ca.dot(cost.R, effort**2), mterm=weights.terminal * stage)
        mpc.set_rterm(u=0.0)
        mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = run.lower, run.upper
        ahead, self._seen = mpc.get_tvp_template(), seen

        def reference(_: float) -> Any:
            for k in range(run.horizon + 1):
                ahead["_tvp", k] = seen(run.reference(run.tick + k), run.u_hover)
            return ahead

        mpc.set_tvp_fun(reference)
        with Path(os.devnull).open("w") as nowhere, contextlib.redirect_stdout(nowhere):
            mpc.setup()
        mpc.x0, mpc.u0 = run.reference(0), run.u_hover
        mpc.set_initial_guess()

    def step(self, measurement: Measurement, messages: Sequence[Plan]) -> Array:  # noqa: ARG002 - by name
        """Return the first inputs of the solution."""
        x = np.concatenate([measurement.payload, np.ravel(measurement.uav_states)])
        found: Array = np.ravel(self.mpc.make_step(x[:, None]))
        return found

    def stop(self) -> None:
        """Nothing is open."""
