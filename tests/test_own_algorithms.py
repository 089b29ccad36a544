"""The algorithms of examples/controllers, which use the interface of an own class alone."""

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import transport
from tests.support.runs import ALL, setup
from transport.agent.user_class.run_for_user import Run, run_of
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.wire.messages import Plan

CONTROLLERS = Path(__file__).resolve().parents[1] / "examples" / "controllers"
PARTS = ("prediction", "program")  # modules that the algorithms share
ALGORITHMS = ("paper", "sequential", "admm", "event_triggered", "alone", "nmpc")
MODULES = (*PARTS, *ALGORITHMS)
MOST_LINES = 120  # of a file, so that it can be read in one go

AGENTS = len(ALL)

# Two solvers of one program end in the same optimum. What is left is rounding, which grows over the
# 500 ticks of the paper's maneuver.
SAME_COST = 1e-9  # relative
# The built-in `alone` and the example have the same gains and equations. What is left is rounding
# over the 40 ticks of the gusty hover.
SAME_LAW = 1e-9  # relative, of the cost

# The same solver on the same program, N and N m.
SAME_INPUTS = 1e-9

# Largest difference of a planned input from the optimum, in units of half the input's range: the
# first plans of ADMM are far from the optimum, those of the last iteration near.
FAR_FROM_OPTIMUM = 0.1
NEAR_OPTIMUM = 1e-4
ADMM_ITERATIONS = 60  # the step itself is the first

# Costs over the paper's maneuver above that of the built-in centralized controller, relative.
# One solve of each agent after the other; the parallel solves of `paper` are 48 % above.
MOST_SEQUENTIAL_EXCESS = 0.25
# ADMM with ten iterations a tick ends near the optimum. Unlike the built-in controller it has no
# limits on later changes of the inputs and on distances.
ADMM_DIFFERENCE = 0.01
# The nonlinear model against one that is linearised anew at each tick: angles are small.
NONLINEAR_DIFFERENCE = 0.05

# In gusts of 0.5 m/s an event-triggered agent sends less than this share of its plans.
MOST_SENT_SHARE = 0.5

HOVER = {"name": "hover", "duration_s": 0.5, "displacement_m": [0.0, 0.0, 0.0]}
CLIMB = {"name": "climb", "duration_s": 1.0, "displacement_m": [0.0, 0.0, -0.5]}
LONG_HOVER = {**HOVER, "duration_s": 2.0}
HOVER_AND_CLIMB = [HOVER, CLIMB]


@pytest.fixture(autouse=True)
def _folder_of_the_examples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in the folder of the examples; they are imported from there, anew in each test."""
    monkeypatch.chdir(CONTROLLERS)
    monkeypatch.syspath_prepend(str(CONTROLLERS))
    for name in MODULES:
        monkeypatch.delitem(sys.modules, name, raising=False)


def cost_without_failure(scenario: str, controller: str, **settings: Any) -> float:
    """Return the mean cost of a run, which has to be completed without a failed step."""
    changes = {"agents.controller": controller, **settings}
    run = transport.fly(scenario, changes, progress=False)
    assert run.completed, run.summary["reason"]
    assert run.summary["solver"]["failures"] == 0
    return float(run.summary["cost"]["mean"])


def test_they_are_short() -> None:
    """The folder has the modules of this test and no others, each of at most `MOST_LINES` lines."""
    lengths = {
        path.stem: len(path.read_text(encoding="utf-8").splitlines())
        for path in CONTROLLERS.glob("*.py")
    }
    assert set(lengths) == set(MODULES)
    assert max(lengths.values()) <= MOST_LINES


@pytest.mark.parametrize(
    "settings",
    [
        {"maneuver.phase": HOVER_AND_CLIMB},
        {"maneuver.phase": HOVER_AND_CLIMB, "clock.actuation": "next_tick"},
        {"maneuver.phase": HOVER_AND_CLIMB, "links.loss": 0.1},
    ],
    ids=["perfect", "next tick", "10 % loss"],
)
def test_the_paper_by_the_interface(settings: dict[str, Any]) -> None:
    """The example's cost is that of the built-in controller: the interface suffices for the project's own."""
    built_in = cost_without_failure("paper", "mpc", **settings)
    example = cost_without_failure("paper", "paper:Paper", **settings)
    assert example == pytest.approx(built_in, rel=SAME_COST)


@pytest.mark.slow
@pytest.mark.pages
@pytest.mark.parametrize("delay_s", [0.0, 0.05])
def test_the_paper_over_the_maneuver(delay_s: float) -> None:
    """The costs are the same over the paper's maneuver, on a perfect network and with 50 ms delay."""
    built_in = cost_without_failure("paper", "mpc", **{"links.delay_s": delay_s})
    example = cost_without_failure("paper", "paper:Paper", **{"links.delay_s": delay_s})
    assert example == pytest.approx(built_in, rel=SAME_COST)


# One tick of a team whose agents exchange proposals in memory


def disturbed() -> Array:
    """Return a state near hover, at rest, displaced and tilted so that limits are active."""
    x = setup().initial_state()
    x[state.R0] += [0.5, -0.25, 0.4]
    x[state.THETA0] = [0.1, -0.05, 0.05]
    return x


def team(controller: Any, x: Array, **settings: Any) -> list[Any]:
    """Return the controllers of all agents at tick 0, all with a state as their estimate and plans of hover."""
    scenario = setup(*[f"{key}={value}" for key, value in settings.items()])
    controllers = []
    for agent in scenario.agents:
        run = run_of(scenario.run, agent)
        run.agents = scenario.agents
        of_agent = controller()
        of_agent.start(run)

        hover = hover_inputs(run)
        of_agent.estimate = SimpleNamespace(
            x_start=x, u_before=run.u_hover, announced=lambda _, hover=hover: hover
        )
        controllers.append(of_agent)
    return controllers


def hover_inputs(run: Run) -> Array:
    """Return the hover inputs of the whole team over the horizon, (N_p, 4 N)."""
    return np.tile(run.u_hover, (run.horizon, 1))


def first_results(controllers: Sequence[Any]) -> list[Any]:
    """Return the result of the step of each agent, to which no message has arrived."""
    return [of_agent.step(None, []) for of_agent in controllers]


def negotiated(controllers: Sequence[Any], iteration: int, results: Sequence[Any]) -> list[Any]:
    """Return the results of an iteration, in which each agent has the others' results of the one before."""
    plans = []
    for agent, result in enumerate(results, start=1):
        inputs, data = result[:2] if isinstance(result, tuple) else (result, np.zeros(0))
        plans.append(SimpleNamespace(agent=agent, tick=0, uavs=(agent,), inputs=inputs, data=data))
    return [
        of_agent.negotiate(iteration, [plan for plan in plans if plan.agent != of_agent.run.agent])
        for of_agent in controllers
    ]


def program_of(run: Run, x: Array, uavs: Sequence[int]) -> Any:
    """Return the program of some UAVs, 0-based, linearised about a state and the hover inputs."""
    program = importlib.import_module("program").Program(run, uavs)
    program.about(x, run.u_hover)
    return program


def team_program(run: Run, x: Array) -> Any:
    """Return the program of the whole team, linearised about a state and the hover inputs."""
    return program_of(run, x, range(run.system.N))


def optimum_within_bounds(program: Any, Y_ref: Array) -> Array:
    """Return the optimal inputs of the whole team without limits on later changes and distances, (N_p, 4 N)."""
    H, g = program.cost(hover_inputs(program.run), Y_ref)
    lower, upper = program.bounds()
    no_rows = np.zeros((0, len(g)))
    z = importlib.import_module("program").solved(H, g, no_rows, [lower], [upper])
    return np.asarray(program.inputs(z))


def is_at_a_bound(program: Any, U: Array) -> bool:
    """Return whether any input of the team is at a bound."""
    z = program.scaled(U)
    lower, upper = program.bounds()
    return bool(np.isclose(z, lower).any() or np.isclose(z, upper).any())


def test_admm_converges_to_the_centralized_optimum() -> None:
    """The plans of all agents together tend to the optimum of the team's program, with active limits."""
    x = disturbed()
    agents = team(importlib.import_module("admm").ADMM, x)
    program = team_program(agents[0].run, x)
    best = optimum_within_bounds(program, agents[0].reference())
    assert is_at_a_bound(program, best)

    results = first_results(agents)
    distances = []
    for iteration in range(1, ADMM_ITERATIONS):
        results = negotiated(agents, iteration, results)
        U = np.hstack([inputs for inputs, _, _ in results])
        distances.append(np.abs((U - best) / program.range).max())
    assert distances[0] > FAR_FROM_OPTIMUM
    assert distances[-1] < NEAR_OPTIMUM


def sequential_team(x: Array) -> list[Any]:
    """Return the controllers of a team whose agents have a turn each within a tick."""
    controller = importlib.import_module("sequential").Sequential
    return team(controller, x, **{"controller.negotiation_iterations": AGENTS})


def test_sequential_agents_solve_in_turn() -> None:
    """In each iteration one agent solves, given the newest plans of the others; the others keep theirs."""
    x = disturbed()
    agents = sequential_team(x)
    run = agents[0].run
    Y_ref = agents[0].reference()

    U = hover_inputs(run)
    results = first_results(agents)
    for turn in range(AGENTS):
        if turn > 0:
            results = negotiated(agents, turn, results)
        program = program_of(run, x, [turn])
        U[:, program.own] = program.solve(U.copy(), Y_ref)
        np.testing.assert_allclose(np.hstack(results), U, rtol=0.0, atol=SAME_INPUTS)


def test_sequential_plans_never_get_worse() -> None:
    """Each solve in turn lowers the cost of the team's plan, which stays above the optimum."""
    x = disturbed()
    agents = sequential_team(x)
    run = agents[0].run
    program = team_program(run, x)
    Y_ref = agents[0].reference()
    H, g = program.cost(hover_inputs(run), Y_ref)

    def cost_above_hover(U: Array) -> float:
        """Return the cost of a plan of the team, minus that of the hover inputs, for which z = 0."""
        z = program.scaled(U)
        return float(0.5 * z @ H @ z + g @ z)

    results = first_results(agents)
    costs = [0.0, cost_above_hover(np.hstack(results))]
    for iteration in range(1, AGENTS):
        results = negotiated(agents, iteration, results)
        costs.append(cost_above_hover(np.hstack(results)))
    assert (np.diff(costs) < 0.0).all()

    best = program.solve(hover_inputs(run), Y_ref)
    assert costs[-1] > cost_above_hover(best)


# Runs


@pytest.mark.slow
@pytest.mark.pages
def test_costs_over_the_maneuver() -> None:
    """Sequential solves cost more than the centralized controller, not much more; ADMM costs the same."""
    centralized = cost_without_failure("centralized", "mpc")
    sequential = cost_without_failure(
        "paper", "sequential:Sequential", **{"controller.negotiation_iterations": AGENTS}
    )
    assert centralized < sequential < (1.0 + MOST_SEQUENTIAL_EXCESS) * centralized
    consensus = cost_without_failure(
        "paper", "admm:ADMM", **{"controller.negotiation_iterations": 10}
    )
    assert consensus == pytest.approx(centralized, rel=ADMM_DIFFERENCE)


@pytest.mark.parametrize(
    ("delay_s", "loss"), [(0.0, 0.0), (0.2, 0.3)], ids=["perfect", "200 ms, 30 % loss"]
)
def test_events(delay_s: float, loss: float) -> None:
    """Without disturbance each agent sends its first plan only, with gusts a few more; both runs are completed."""
    is_sent = {}
    for gust_mps in (0.0, 0.5):
        run = transport.fly(
            "resilient",
            {"agents.controller": "event_triggered:EventTriggered"},
            gust_mps=[gust_mps] * 3,
            phases=HOVER_AND_CLIMB,
            delay_s=delay_s,
            loss=loss,
            progress=False,
        )
        assert run.completed
        is_sent[gust_mps] = [plan.shared for plan in run.log.of(Plan)]
    assert sum(is_sent[0.0]) == AGENTS
    assert AGENTS < sum(is_sent[0.5]) < MOST_SENT_SHARE * len(is_sent[0.5])


@pytest.mark.parametrize("settings", [{}, {"links.loss": 1.0}], ids=["perfect", "no message"])
def test_alone(settings: dict[str, Any]) -> None:
    """In a gusty hover the example flies as the built-in `alone`, and each agent sends its first plan only."""
    built_in, example = (
        transport.fly(
            "alone",
            {"agents.controller": controller, **settings},
            gust_mps=[1.0] * 3,
            phases=[LONG_HOVER],
            progress=False,
        )
        for controller in ("alone", "alone:Alone")
    )
    expected = built_in.summary["cost"]["mean"]
    assert example.summary["cost"]["mean"] == pytest.approx(expected, rel=SAME_LAW)
    assert sum(plan.shared for plan in example.log.of(Plan)) == AGENTS


@pytest.mark.slow
@pytest.mark.pages
def test_the_nonlinear_optimum() -> None:
    """On the nonlinear model the centralized controller costs as much as on the linearised one."""
    pytest.importorskip("do_mpc", reason="needs the extra nmpc")
    settings = {"maneuver.phase": HOVER_AND_CLIMB}
    linearised = cost_without_failure("centralized", "mpc", **settings)
    nonlinear = cost_without_failure("centralized", "nmpc:NMPC", **settings)
    assert nonlinear == pytest.approx(linearised, rel=NONLINEAR_DIFFERENCE)
