"""Systems, states and closed-loop simulations for the tests of the controller."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.path.hover_reference import HoverReference
from transport.model.path.maneuver import Maneuver
from transport.model.path.phase import Phase
from transport.model.physics.hover import Hover, hover
from transport.model.physics.parameters import Payload, System, Uav, table_1
from transport.model.section import Section
from transport.mpc.controller import Controller, Horizon, StepResult
from transport.mpc.settings_period_horizon_weights import ControllerSettings

S = TypeVar("S", bound=Section)

# Dormand-Prince steps per 0.05 s: the local error is then far below every tolerance here.
INTEGRATION_STEPS = 5

# Initial altitude, m up: not zero, so that a missing offset is detected.
START_I = (0.0, 0.0, -10.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """A system with its model and equilibrium.

    Attributes:
        x: Hover at START_I, (n,).
    """

    system: System
    model: Model
    hover: Hover
    x: Array


def changed(settings: S, **changes: Any) -> S:
    """Return settings with changes, unchecked."""
    return settings.model_copy(update=changes)


@dataclass(frozen=True, slots=True, kw_only=True)
class Situation:
    """The arguments of one controller step."""

    x: Array
    u: Array
    U: Array
    y_ref: Array


def ring(N: int) -> System:
    """Return N UAVs on vertical rods around the payload's centre of mass.

    A single UAV is above the centre of mass.
    """
    angles = 2.0 * np.pi * np.arange(N) / N
    radius = 0.0 if N == 1 else 0.5
    return System(
        payload=Payload(mass=0.75 * N, inertia=[0.5, 0.5, 0.6]),
        uavs=[
            Uav(
                mass=1.5,
                inertia=[0.029, 0.029, 0.055],
                rho=[radius * np.cos(angle), radius * np.sin(angle), -0.1],
                rod_length=3.2,
            )
            for angle in angles
        ],
    )


@lru_cache
def ring_setup(N: int) -> Setup:
    """Return a ring of N UAVs with model and equilibrium."""
    return _setup(ring(N))


@lru_cache
def paper_setup() -> Setup:
    """Return the system of the paper's Table I with model and equilibrium."""
    return _setup(table_1())


def _setup(system: System) -> Setup:
    equilibrium = hover(system)
    x = equilibrium.x.copy()
    x[state.R0] += START_I
    x.setflags(write=False)
    return Setup(system=system, model=Model(system), hover=equilibrium, x=x)


def disturbed(setup: Setup, rng: np.random.Generator, size: float) -> Array:
    """Return hover at START_I with every state disturbed by about `size`, with |e| = 1 and e .

    Omega = 0 kept.
    """
    x = setup.x + size * rng.standard_normal(setup.system.n)
    for i in range(setup.system.N):
        block = x[state.uav_slice(i)]
        e = block[state.E] / np.linalg.norm(block[state.E])
        block[state.E] = e
        block[state.ROD_RATE] -= e * (e @ block[state.ROD_RATE])
    return x


def situation(
    setup: Setup, settings: ControllerSettings, seed: int, size: float = 0.05
) -> Situation:
    """Return a step away from equilibrium.

    State, inputs, announced plans and reference are disturbed differently.
    """
    rng = np.random.default_rng(seed)
    steps, u_hover = settings.horizon, setup.hover.u
    half = (settings.upper(setup.system.N) - settings.lower(setup.system.N)) / 2.0
    x = disturbed(setup, rng, size)
    u = u_hover + size * half * rng.standard_normal(setup.system.m)
    U = u_hover + size * half * rng.standard_normal((steps, setup.system.m))
    y_ref = setup.model.outputs(setup.x) + size * rng.standard_normal((steps + 1, setup.system.p))
    return Situation(x=x, u=u, U=U, y_ref=y_ref)


def controller(setup: Setup, settings: ControllerSettings, owned: Sequence[int]) -> Controller:
    """Return a controller of some UAVs of the system."""
    return Controller(setup.model, setup.hover, settings, owned)


def team(
    setup: Setup, settings: ControllerSettings, teams: Sequence[Sequence[int]]
) -> list[Controller]:
    """Return one controller for each set of owned UAVs."""
    return [controller(setup, settings, owned) for owned in teams]


def step(owner: Controller, at: Situation) -> StepResult:
    """Run one controller step and return its result."""
    return owner.step(at.x, at.u, Horizon(U=at.U, y_ref=at.y_ref))


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """The result of a closed-loop simulation.

    Attributes:
        X: States, (steps + 1, n).
        U: Applied inputs, (steps, m).
        mean_cost: Mean stage cost of the whole system over the simulation.
        statuses: Statuses of all solves.
    """

    X: Array
    U: Array
    mean_cost: float
    statuses: frozenset[str]


def simulate(setup: Setup, controllers: Sequence[Controller], start_s: float, steps: int) -> Flight:
    """Simulate the paper's maneuver from `start_s` on for that many sampling periods, from rest at START_I."""
    X, U, costs, statuses = [setup.x], [], [], set()
    cost = controllers[0].cost
    for at, optima, x in _loop(setup, controllers, start_s, steps):
        u = np.zeros(setup.system.m)
        for owner, optimum in zip(controllers, optima, strict=True):
            u[owner.own] = optimum.U[0]
            statuses.add(optimum.solution.status)
        costs.append(cost.stage(setup.model.outputs(at.x), at.y_ref[0], u))
        U.append(u)
        X.append(x)
    return Flight(
        X=np.array(X), U=np.array(U), mean_cost=float(np.mean(costs)), statuses=frozenset(statuses)
    )


def situations(
    setup: Setup, controllers: Sequence[Controller], start_s: float, steps: int
) -> Iterator[Situation]:
    """Yield the arguments of the controllers in such a simulation."""
    for at, _, _ in _loop(setup, controllers, start_s, steps):
        yield at


def _loop(
    setup: Setup, controllers: Sequence[Controller], start_s: float, steps: int
) -> Iterator[tuple[Situation, list[StepResult], Array]]:
    settings = controllers[0].settings
    period, horizon = settings.sampling_period_s, settings.horizon
    reference = HoverReference(setup.system, setup.hover, _from_start(paper_maneuver()))
    x, u = setup.x, setup.hover.u
    U = np.tile(u, (horizon, 1))
    for k in range(steps):
        y_ref = reference.outputs(
            start_s + period * np.arange(k, k + horizon + 1, dtype=np.float64)
        )
        at = Situation(x=x, u=u, U=U, y_ref=y_ref)
        optima = [step(owner, at) for owner in controllers]
        announced = np.empty_like(U)
        for owner, optimum in zip(controllers, optima, strict=True):
            announced[:, owner.own] = optimum.U
        u = announced[0]
        x, _ = setup.model.integrate(x, u, period, INTEGRATION_STEPS)
        # The paper's shift: every plan moves on by one step, and its last input is held.
        U = np.vstack([announced[1:], announced[-1:]])
        yield at, optima, x


def paper_maneuver() -> Maneuver:
    """Return the maneuver of section V.

    Hover, climb 2.5 m, translate 2.5 m in +x, descend 2.5 m, hover, 5 s each.
    """
    legs = {
        "hover": (0, 0, 0),
        "climb": (0, 0, -2.5),
        "translate": (2.5, 0, 0),
        "descend": (0, 0, 2.5),
    }
    order = ["hover", "climb", "translate", "descend", "hover"]
    return Maneuver(
        start_I=[0.0, 0.0, -10.0],
        phases=[Phase(name=name, duration_s=5.0, displacement_I=legs[name]) for name in order],
    )


def _from_start(maneuver: Maneuver) -> Maneuver:
    return Maneuver(start_I=START_I, phases=maneuver.phases, profile=maneuver.profile)
