"""The team in AgentLib (benchmarks/peers): model, coupling and plant, with stand-ins for AgentLib's classes."""

import importlib
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from tests.support import runs
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.mpc.program.stage_cost import Cost

NAME = "benchmarks.peers.with_agentlib"
RUN = runs.setup(runs.SHORT)
PERIOD_S = RUN.settings.sampling_period_s


class StandIn(SimpleNamespace):
    """A class of AgentLib that keeps what it is given."""


# Modules of AgentLib, which not every machine has, with the names that the program imports.
MODULES = {
    "agentlib": (),
    "agentlib.core": ("AgentVariable", "BaseModule", "BaseModuleConfig"),
    "agentlib.utils": (),
    "agentlib.utils.multi_agent_system": ("LocalMASAgency",),
    "agentlib_mpc": (),
    "agentlib_mpc.models": (),
    "agentlib_mpc.models.casadi_model": (
        "CasadiInput", "CasadiModel", "CasadiModelConfig", "CasadiOutput", "CasadiState",
    ),
}  # fmt: skip


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The program, imported with the stand-ins."""
    for name, classes in MODULES.items():
        module: Any = ModuleType(name)
        for one in classes:
            setattr(module, one, type(one, (StandIn,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(sys.modules, NAME, None)
    del sys.modules[NAME]  # it goes with the stand-ins
    found: Any = importlib.import_module(NAME)
    found.Flight.now = found.Flight(RUN, 5)
    return found


def test_agents_are_coupled_by_the_inputs_of_all(program: Any) -> None:
    """The own ones as outputs, the others' as inputs of the model, each under its alias and within its limits."""
    found = program._controller(RUN, 1, 5)
    lower, upper = RUN.settings.lower(4), RUN.settings.upper(4)
    names = [f"{'w' if j in range(4, 8) else 'u'}_{j}" for j in range(16)]
    assert [one["name"] for one in found["couplings"]] == names
    assert [one["alias"] for one in found["couplings"]] == [f"c_{j}" for j in range(16)]
    assert [one["name"] for one in found["controls"]] == [f"u_{j}" for j in range(4, 8)]
    for some, j in ((found["couplings"], slice(0, 16)), (found["controls"], slice(4, 8))):
        for key, expected in (("value", RUN.hover.u), ("lb", lower), ("ub", upper)):
            np.testing.assert_array_equal([one[key] for one in some], expected[j])

    y_ref = np.array([one["value"].to_numpy() for one in found["inputs"]])
    np.testing.assert_array_equal(y_ref.T, RUN.Y_ref)
    instants_s = found["inputs"][0]["value"].index.to_numpy()
    np.testing.assert_allclose(instants_s[:3], [0.0, PERIOD_S, 2 * PERIOD_S])
    numbers = ("time_step", "prediction_horizon", "max_iterations")
    assert [found[name] for name in numbers] == [PERIOD_S, RUN.settings.horizon, 5]
    start = [one["value"] for one in found["states"]]
    np.testing.assert_array_equal(start, RUN.initial_state())

    agents = program._agents(RUN, 5)
    assert [one["id"] for one in agents] == ["uav1", "uav2", "uav3", "uav4", "plant"]
    models = [
        one["modules"][1]["optimization_backend"]["model"]["type"]["class_name"]
        for one in agents[:-1]
    ]
    assert models == ["Team0", "Team1", "Team2", "Team3"]


def test_the_objectives_of_all_agents_sum_to_that_of_the_team(program: Any) -> None:
    """Each has the model of the whole team, and outputs that equal its own inputs."""
    cost = Cost(RUN.settings.weights, RUN.system, RUN.hover)
    sizes = {"x": len(RUN.hover.x), "u": len(RUN.hover.u), "y": len(cost.Q)}
    model = program.model_of(2, RUN)
    team = model.__new__(model)
    columns = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    for name, column in columns.items():
        for k in range(sizes[name]):
            setattr(team, f"{name}_{k}", _Symbol(column[k]))
    for j in range(sizes["u"]):
        setattr(team, f"w_{j}", StandIn())

    objective = team.setup_system()
    derivative = ca.vertcat(*(getattr(team, f"x_{k}").ode for k in range(sizes["x"])))
    own = [hasattr(getattr(team, f"w_{j}"), "alg") for j in range(sizes["u"])]
    assert own == [j in range(8, 12) for j in range(16)]
    outputs = ca.vertcat(*(getattr(team, f"w_{j}").alg for j in range(8, 12)))
    evaluate = ca.Function("f", [*columns.values()], [objective, derivative, outputs])

    u = RUN.hover.u + 0.1
    y_ref = Model(RUN.system).outputs(RUN.hover.x) + 0.2
    share, x_dot, w = (np.array(one).ravel() for one in evaluate(RUN.hover.x, u, y_ref))
    expected = 0.04 * cost.Q.sum() + 0.01 * cost.R.sum()
    assert 4.0 * share[0] == pytest.approx(expected)
    np.testing.assert_array_equal(w, u[8:12])
    at_rest = np.array(evaluate(RUN.hover.x, RUN.hover.u, y_ref)[1]).ravel()
    np.testing.assert_allclose(at_rest, 0.0, atol=1e-9)
    assert np.abs(x_dot).max() > 0.1


class _Symbol(StandIn):
    """A variable of a model, which counts as its symbol in expressions."""

    def __init__(self, sym: Any) -> None:
        super().__init__(sym=sym)

    def __rmul__(self, factor: float) -> Any:
        return factor * self.sym


def test_inputs_act_from_the_instant_for_which_they_were_found(program: Any) -> None:
    """The plant sends its state, reads the inputs shortly before the next instant, and integrates with them."""
    u = RUN.hover.u + 0.1
    sent: dict[str, float] = {}
    plant = program.Plant(env=SimpleNamespace(timeout=lambda wait_s: wait_s))
    plant.set = sent.__setitem__
    plant.get_value = lambda name: u[int(name.removeprefix("u_"))]

    def state() -> Array:
        return np.array([sent[f"x_{k}"] for k in range(len(RUN.hover.x))])

    process = plant.process()
    assert next(process) == pytest.approx(0.9 * PERIOD_S)
    x = RUN.initial_state()
    np.testing.assert_array_equal(state(), x)
    assert program.Flight.now.X == []
    assert next(process) == pytest.approx(0.1 * PERIOD_S)
    next(process)
    after, _ = Model(RUN.system).integrate(x, u, PERIOD_S, 10)
    np.testing.assert_array_equal(state(), after)
    np.testing.assert_array_equal(program.Flight.now.X, [x])
    np.testing.assert_array_equal(program.Flight.now.U, [u])


def test_a_run_ends_within_its_last_period(program: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """AgentLib finds models and plant in this module; states and inputs are those of the run, by tick."""
    until_s: list[float] = []

    class Agency:
        def __init__(self, **given: Any) -> None:
            assert [one["id"] for one in given["agent_configs"]][-1] == "plant"

        def run(self, until: float) -> None:
            until_s.append(until)
            program.Flight.now.X.append(RUN.hover.x)
            program.Flight.now.U.append(RUN.hover.u)

    monkeypatch.setattr(program, "LocalMASAgency", Agency)
    before = {*sys.modules}
    X, U, used_s = program.fly(RUN, 5)
    new = [name for name in {*sys.modules} - before if sys.modules[name] is program]
    assert [name.rpartition(".")[2] for name in new] == ["with_agentlib"]
    for name in new:
        del sys.modules[name]
    assert until_s == [pytest.approx(RUN.ticks * PERIOD_S - 1e-3)]
    assert (X.shape, U.shape) == ((1, len(RUN.hover.x)), (1, len(RUN.hover.u)))
    assert used_s >= 0.0
    assert all(getattr(program, f"Team{agent}").agent == agent for agent in range(4))
