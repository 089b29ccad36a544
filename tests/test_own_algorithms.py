"""The algorithms of examples/controllers, written by the interface of an own class alone."""

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import transport
from tests.support.runs import setup
from transport.agent.own_run import run_of
from transport.model.arrays import Array
from transport.protocol.wire.messages import Plan

CONTROLLERS = Path(__file__).resolve().parents[1] / "examples" / "controllers"
MODULES = (
    *("prediction", "program", "paper", "sequential", "admm", "event_triggered", "alone", "nmpc"),
)
MOST_LINES = 120

# Two solvers of one program end in the same optimum; what is left is rounding, over 500 steps.
SAME_COST = 1e-9
# Largest difference of an input over the horizon, in units of half its range.
NEAR_OPTIMUM = 1e-4
ITERATIONS = 60  # by then ADMM is there, from a start without any information
# Of the sequential plan against the centralized one; the parallel one is 48 % above it.
SEQUENTIAL_EXCESS = 0.25
# ADMM with ten exchanges a tick against the built-in centralized controller, which has rate limits.
ADMM_EXCESS = 0.01

# The gains and equations of `alone` are those of the built-in one, over 100 steps of hover.
SAME_LAW = 1e-9
# Nonlinear model against one linearised anew at each tick, over a maneuver of small angles.
NONLINEAR = 0.05

HOVER_AND_CLIMB = [
    {"name": "hover", "duration_s": 0.5, "displacement_m": [0.0, 0.0, 0.0]},
    {"name": "climb", "duration_s": 1.0, "displacement_m": [0.0, 0.0, -0.5]},
]


@pytest.fixture(autouse=True)
def _folder(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in the folder of the examples; they are imported from there."""
    monkeypatch.chdir(CONTROLLERS)
    monkeypatch.syspath_prepend(str(CONTROLLERS))
    for name in MODULES:
        monkeypatch.delitem(sys.modules, name, raising=False)


def cost(scenario: str, controller: str, **settings: Any) -> float:
    """Return the mean cost of a completed flight without failed steps."""
    changes = {"agents.controller": controller, **settings}
    run = transport.fly(scenario, changes, progress=False)
    assert run.completed, run.summary["reason"]
    assert run.summary["solver"]["failures"] == 0
    return float(run.summary["cost"]["mean"])


def test_they_are_short() -> None:
    """Each file is at most 120 lines."""
    lengths = {
        path.name: len(path.read_text(encoding="utf-8").splitlines())
        for path in CONTROLLERS.glob("*.py")
    }
    assert len(lengths) == len(MODULES)
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
    """Its cost is that of the built-in controller: the interface suffices for the project's own."""
    built_in = cost("paper", "mpc", **settings)
    assert cost("paper", "paper:Paper", **settings) == pytest.approx(built_in, rel=SAME_COST)


@pytest.mark.slow
@pytest.mark.pages
@pytest.mark.parametrize("delay_s", [0.0, 0.05])
def test_the_paper_over_the_maneuver(delay_s: float) -> None:
    """The same over the paper's maneuver, on a perfect network and with plans 50 ms late."""
    built_in = cost("paper", "mpc", **{"links.delay_s": delay_s})
    own = cost("paper", "paper:Paper", **{"links.delay_s": delay_s})
    assert own == pytest.approx(built_in, rel=SAME_COST)


def disturbed() -> Array:
    """Return a state near hover, at rest, displaced and tilted so that limits are active."""
    x = setup().initial_state()
    x[:3] += [0.5, -0.25, 0.4]
    x[6:9] = [0.1, -0.05, 0.05]
    return x


def team(module: Any, x: Array, **settings: Any) -> list[Any]:
    """Return the objects of all agents at tick 0, which estimate a state exactly."""
    objects = []
    scenario = setup(*[f"{key}={value}" for key, value in settings.items()])
    for agent in scenario.agents:
        run = run_of(scenario, agent)
        run.agents = scenario.agents
        one = module()
        one.start(run)
        U = np.tile(run.u_hover, (run.horizon, 1))
        one.estimate = SimpleNamespace(x_start=x, u_before=run.u_hover, announced=lambda _, U=U: U)
        objects.append(one)
    return objects


def proposals(results: Sequence[Any]) -> list[Any]:
    """Return the results of a call of all agents as the plans that the others get."""
    plans = []
    for agent, result in enumerate(results, start=1):
        inputs, data = result[:2] if isinstance(result, tuple) else (result, np.zeros(0))
        plans.append(SimpleNamespace(agent=agent, tick=0, uavs=(agent,), inputs=inputs, data=data))
    return plans


def optimum(one: Any, x: Array, *, with_rates: bool) -> tuple[Any, Array]:
    """Return the program of the whole team and its optimal inputs, (N_p, 4 N)."""
    program_of = importlib.import_module("program")
    program = program_of.Program(one.run, range(4))
    program.about(x, one.run.u_hover)
    U = np.tile(one.run.u_hover, (one.run.horizon, 1))
    Y_ref = one.reference()
    if with_rates:
        return program, program.solve(U, Y_ref)
    H, g = program.cost(U, Y_ref)
    lower, upper = program.bounds()
    z = program_of.solved(H, g, np.zeros((0, len(g))), [lower], [upper])
    assert np.isclose(z, lower).any() or np.isclose(z, upper).any()
    return program, program.inputs(z)


def test_admm_converges_to_the_centralized_optimum() -> None:
    """All copies tend to the optimum of the team's program, with active limits."""
    x = disturbed()
    agents = team(importlib.import_module("admm").ADMM, x)
    program, best = optimum(agents[0], x, with_rates=False)
    results = [one.step(None, []) for one in agents]
    distances = []
    for iteration in range(1, ITERATIONS):
        plans = proposals(results)
        results = [
            one.negotiate(iteration, [plan for plan in plans if plan.agent != one.run.agent])
            for one in agents
        ]
        U = np.hstack([inputs for inputs, _, _ in results])
        distances.append(np.abs((U - best) / program.range).max())
    assert distances[0] > 1e3 * NEAR_OPTIMUM
    assert distances[-1] < NEAR_OPTIMUM


def test_sequential_plans_never_get_worse() -> None:
    """Each solve in turn lowers the cost of the team's plan, down to no less than the optimum."""
    x = disturbed()
    agents = team(
        importlib.import_module("sequential").Sequential,
        x,
        **{"controller.negotiation_iterations": 4},
    )
    program, best = optimum(agents[0], x, with_rates=True)
    H, g = program.cost(np.tile(agents[0].run.u_hover, (20, 1)), agents[0].reference())

    def value(U: Array) -> float:
        z = program.scaled(U)
        return float(0.5 * z @ H @ z + g @ z)

    results = [one.step(None, []) for one in agents]
    values = [0.0, value(np.hstack(results))]
    for iteration in range(1, 4):
        plans = proposals(results)
        results = [
            one.negotiate(iteration, [plan for plan in plans if plan.agent != one.run.agent])
            for one in agents
        ]
        values.append(value(np.hstack(results)))
    assert (np.diff(values) < 0.0).all()
    assert values[-1] > value(best)


@pytest.mark.slow
@pytest.mark.pages
def test_costs_over_the_maneuver() -> None:
    """Sequential solves are between the parallel and the centralized ones; ADMM is centralized."""
    centralized = cost("centralized", "mpc")
    four = {"controller.negotiation_iterations": 4}
    sequential = cost("paper", "sequential:Sequential", **four)
    assert centralized < sequential < (1.0 + SEQUENTIAL_EXCESS) * centralized
    ten = {"controller.negotiation_iterations": 10}
    consensus = cost("paper", "admm:ADMM", **ten)
    assert consensus == pytest.approx(centralized, rel=ADMM_EXCESS)


@pytest.mark.parametrize(("delay_s", "loss"), [(0.0, 0.0), (0.2, 0.3)])
def test_events(delay_s: float, loss: float) -> None:
    """Without disturbance only the first plan is sent, with gusts a few; the team is flown as well."""
    flights = {}
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
        flights[gust_mps] = [plan.shared for plan in run.log.of(Plan)]
    assert sum(flights[0.0]) == 4
    assert 4 < sum(flights[0.5]) < 0.5 * len(flights[0.5])


@pytest.mark.parametrize("settings", [{}, {"links.loss": 1.0}], ids=["perfect", "no message"])
def test_alone(settings: dict[str, Any]) -> None:
    """In a gusty hover it is the built-in law of a UAV alone, and it sends the first plan only."""
    flights = [
        transport.fly(
            "alone",
            {"agents.controller": name, **settings},
            gust_mps=[1.0] * 3,
            phases=HOVER_AND_CLIMB[:1] * 4,
            progress=False,
        )
        for name in ("alone", "alone:Alone")
    ]
    built_in, own = (run.summary["cost"]["mean"] for run in flights)
    assert own == pytest.approx(built_in, rel=SAME_LAW)
    assert sum(plan.shared for plan in flights[1].log.of(Plan)) == 4


@pytest.mark.slow
@pytest.mark.pages
def test_the_nonlinear_optimum() -> None:
    """On the nonlinear model the centralized controller costs as much as on the linearised one."""
    pytest.importorskip("do_mpc", reason="needs the extra nmpc")
    settings = {"maneuver.phase": HOVER_AND_CLIMB}
    linearised = cost("centralized", "mpc", **settings)
    nonlinear = cost("centralized", "nmpc:NMPC", **settings)
    assert nonlinear == pytest.approx(linearised, rel=NONLINEAR)
