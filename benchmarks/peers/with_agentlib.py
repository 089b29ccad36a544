"""The team in AgentLib-MPC, an agent for each UAV.

Every agent plans the inputs of its UAV with the model of the whole team, and consensus by ADMM
makes equal what the agents assume of each other's inputs. AgentLib's agents, local communicator and
environment run as they are; the plant is this project's, as a module. Its problems have no terminal
cost, no limits on changes of inputs and no separation.
"""

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import casadi as ca
import numpy as np
import pandas as pd
from agentlib.core import AgentVariable, BaseModule, BaseModuleConfig
from agentlib.utils.multi_agent_system import LocalMASAgency
from agentlib_mpc.models.casadi_model import (
    CasadiInput,
    CasadiModel,
    CasadiModelConfig,
    CasadiOutput,
    CasadiState,
)

from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.physics.dynamics import motion
from transport.model.physics.outputs_and_sensors import outputs
from transport.model.physics.symbols import Symbols
from transport.model.state import INPUTS
from transport.mpc.program.stage_cost import Cost
from transport.protocol.scenario.setup.run_setup import Setup

_FILE = Path(__file__).resolve()
# Shares of a sampling period before the plant reads the inputs, when all agents have answered, and after.
_BEFORE_READING = 0.9
_AFTER_READING = 0.1
_STEPS = 10  # of the plant's integration in a sampling period
# Settings of AgentLib: penalty of ADMM, tolerance of IPOPT, order of collocation, and its pauses, s.
_PENALTY = 1e-2
_TOLERANCE = 1e-3
_ORDER = 2
_SYNC_DELAY_S = 5e-4
_REGISTRATION_S = (
    0.0  # the default of 2 s is subtracted from the sampling period: time for one iteration only
)
_BEFORE_END_S = 1e-3  # of the last period, at which the run ends: no further instant begins


@dataclass(slots=True)
class Flight:
    """The run in this process, as modules and models read it.

    AgentLib makes these itself, from names of classes, and cannot pass them a setup: they read
    `Flight.now`, which `fly` sets.
    """

    setup: Setup
    iterations: int
    X: list[Array] = field(default_factory=list)
    U: list[Array] = field(default_factory=list)
    now: ClassVar["Flight"]


class Team(CasadiModel):
    """The whole team as one agent sees it; the agents' objectives sum to that of the team."""

    agent: ClassVar[int]

    def setup_system(self) -> Any:
        """Set the model, x' = f(x, u); return the agent's share of the stage cost, (21)."""
        setup = Flight.now.setup
        cost = Cost(setup.settings.weights, setup.system, setup.hover)
        x = self._symbols("x", len(setup.hover.x))
        u = self._symbols("u", len(setup.hover.u))
        y_ref = self._symbols("y", len(cost.Q))

        # f and the outputs with these symbols, the numbers of the team, and no external forces.
        symbols = Symbols.of(*setup.system.kind)
        arguments = [symbols.x, symbols.u, symbols.p, symbols.F]
        values = [x, u, ca.DM(setup.system.vector()), ca.DM.zeros(symbols.F.shape)]
        derivative = ca.Function("value", arguments, [motion(symbols).derivative])(*values)
        y = ca.Function("value", arguments, [outputs(symbols)])(*values)

        for k in range(len(setup.hover.x)):
            getattr(self, f"x_{k}").ode = derivative[k]
        # Outputs w equal the own inputs u: ADMM couples an agent's outputs with the others' inputs.
        for j in range(INPUTS * self.agent, INPUTS * (self.agent + 1)):
            getattr(self, f"w_{j}").alg = 1.0 * getattr(self, f"u_{j}")
        # ((y - y_ref)' Q (y - y_ref) + (u - u_hover)' R (u - u_hover)) / N
        effort = u - setup.hover.u
        return (ca.dot(cost.Q, (y - y_ref) ** 2) + ca.dot(cost.R, effort**2)) / setup.system.N

    def _symbols(self, name: str, size: int) -> Any:
        """Return the symbols of AgentLib's variables `name`_0, `name`_1, ... as a column, (size,)."""
        return ca.vertcat(*(getattr(self, f"{name}_{k}").sym for k in range(size)))


def model_of(agent: int, setup: Setup) -> type[Team]:
    """Return the model class of an agent, 0-based."""
    own = range(INPUTS * agent, INPUTS * (agent + 1))
    outputs_y = setup.Y_ref.shape[1]

    class Config(CasadiModelConfig):
        inputs: list[CasadiInput] = [
            *(CasadiInput(name=f"u_{j}", value=float(v)) for j, v in enumerate(setup.hover.u)),
            *(CasadiInput(name=f"y_{k}", value=0.0) for k in range(outputs_y)),
        ]
        states: list[CasadiState] = [
            CasadiState(name=f"x_{k}", value=float(v)) for k, v in enumerate(setup.hover.x)
        ]
        outputs: list[CasadiOutput] = [
            CasadiOutput(name=f"w_{j}", value=float(setup.hover.u[j])) for j in own
        ]

    return type(f"Team{agent}", (Team,), {"agent": agent, "__annotations__": {"config": Config}})


class PlantConfig(BaseModuleConfig):
    """Variables of the plant: all states, which it sends, and all inputs, which it takes."""

    x: list[AgentVariable] = []
    u: list[AgentVariable] = []
    shared_variable_fields: list[str] = ["x"]


class Plant(BaseModule):
    """The plant of this project in AgentLib's environment.

    The inputs of an instant are read shortly before the next one: they act from the instant for
    which the agents have found them.
    """

    config: PlantConfig

    def register_callbacks(self) -> None:
        """Inputs are read when they act."""

    def process(self) -> Iterator[Any]:
        """Send the state, wait until shortly before the next instant, integrate."""
        flight = Flight.now
        setup = flight.setup
        model = Model(setup.system)
        x = setup.initial_state()
        while True:
            for k, value in enumerate(x):
                self.set(f"x_{k}", float(value))
            yield self.env.timeout(_BEFORE_READING * setup.settings.sampling_period_s)
            u = np.array([self.get_value(f"u_{j}") for j in range(len(setup.hover.u))])
            flight.X.append(x)
            flight.U.append(u)
            x, _ = model.integrate(x, u, setup.settings.sampling_period_s, _STEPS)
            yield self.env.timeout(_AFTER_READING * setup.settings.sampling_period_s)


def _agents(setup: Setup, iterations: int) -> list[dict[str, Any]]:
    """Return the configurations of all agents, one for each UAV, and of the plant."""
    modules = {
        f"uav{agent + 1}": _controller(setup, agent, iterations) for agent in range(setup.system.N)
    }
    modules["plant"] = {
        "module_id": "plant",
        "type": {"file": str(_FILE), "class_name": "Plant"},
        "x": _start(setup),
        "u": [{"name": f"u_{j}", "value": float(v)} for j, v in enumerate(setup.hover.u)],
    }
    return [
        {"id": name, "modules": [{"type": "local_broadcast"}, module]}
        for name, module in modules.items()
    ]


def _start(setup: Setup) -> list[dict[str, Any]]:
    """Return the states at t = 0 as AgentLib's variables."""
    return [{"name": f"x_{k}", "value": float(v)} for k, v in enumerate(setup.initial_state())]


def _controller(setup: Setup, agent: int, iterations: int) -> dict[str, Any]:
    """Return the configuration of the controller of an agent, 0-based: consensus by ADMM.

    Coupled are the inputs of all UAVs: the own ones as outputs w of the model, the others' as its
    inputs u, both under the alias c.
    """
    own = range(INPUTS * agent, INPUTS * (agent + 1))
    period_s = setup.settings.sampling_period_s
    instants_s = period_s * np.arange(len(setup.Y_ref))
    references = [
        {"name": f"y_{k}", "value": pd.Series(y_ref, index=instants_s)}
        for k, y_ref in enumerate(setup.Y_ref.T)
    ]
    bounds = zip(
        setup.settings.lower(setup.system.N), setup.settings.upper(setup.system.N), strict=True
    )
    limits = [{"lb": float(lower), "ub": float(upper)} for lower, upper in bounds]
    couplings = [
        {
            "name": f"{'w' if j in own else 'u'}_{j}",
            "alias": f"c_{j}",
            "value": float(v),
            **limits[j],
        }
        for j, v in enumerate(setup.hover.u)
    ]
    backend = {
        "type": "casadi_admm",
        "model": {"type": {"file": str(_FILE), "class_name": f"Team{agent}"}},
        "discretization_options": {"collocation_order": _ORDER, "collocation_method": "legendre"},
        "solver": {"name": "ipopt", "options": {"ipopt.print_level": 0, "ipopt.tol": _TOLERANCE}},
    }
    return {
        "module_id": "admm",
        "type": "agentlib_mpc.admm_local",
        "optimization_backend": backend,
        "time_step": period_s,  # s
        "prediction_horizon": setup.settings.horizon,
        "max_iterations": iterations,
        "penalty_factor": _PENALTY,
        "sync_delay": _SYNC_DELAY_S,
        "registration_period": _REGISTRATION_S,
        "inputs": references,
        "controls": [
            {"name": f"u_{j}", "value": float(setup.hover.u[j]), **limits[j]} for j in own
        ],
        "states": _start(setup),
        "couplings": couplings,
    }


def fly(setup: Setup, iterations: int) -> tuple[Array, Array, float]:
    """Return states and inputs at each tick, (ticks, n) and (ticks, m), and the processor time."""
    Flight.now = flight = Flight(setup, iterations)
    # AgentLib imports the file of a class under a module name made from its path. With this module
    # registered there, it uses this module's `Flight.now` and the agents' models made below.
    sys.modules[".".join([*(folder.name for folder in _FILE.parents[:-1]), _FILE.stem])] = (
        sys.modules[__name__]
    )
    globals().update({f"Team{agent}": model_of(agent, setup) for agent in range(setup.system.N)})
    begin = time.process_time()
    agency = LocalMASAgency(
        agent_configs=_agents(setup, iterations), env={"rt": False}, variable_logging=False
    )
    agency.run(until=setup.ticks * setup.settings.sampling_period_s - _BEFORE_END_S)
    return np.array(flight.X), np.array(flight.U), time.process_time() - begin
