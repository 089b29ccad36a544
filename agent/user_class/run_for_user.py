"""Team and run as a controller of the user knows them."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from operator import index
from typing import SupportsIndex

import numpy as np

from transport.agent.received import Received
from transport.agent.user_class.state_accessors import Layout
from transport.agent.user_class.user_estimate import OwnEstimate
from transport.model.arrays import Array, frozen
from transport.model.linear.linearisation import Model
from transport.model.path.target_and_stop import PathTarget
from transport.model.physics.obstacles import Obstacle
from transport.model.physics.parameters import System
from transport.mpc.settings_period_horizon_weights import ControllerSettings
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.messages import MAX_DATA, Plan


@dataclass(slots=True, kw_only=True)
class Run(Layout):
    """Team and run as a controller of the user knows them.

    The parameters are those that the scenario states, not the plant's.

    UAVs are numbered from 0, as in arrays, agents from 1. `tick`, `agents`, `failed` and `must_send`
    are renewed before each step. Arrays are read-only.
    """

    agent: int  # of this object
    owned: tuple[int, ...]  # its UAVs
    system: System  # masses, inertias, attachment points and rod lengths; N is `system.N`
    model: Model  # equations of motion; `model.linearise(x, u)` has the derivatives
    settings: ControllerSettings  # `[controller]`: weights, limits, distances
    x_hover: Array  # state of the hover at the origin, (12 + 12 N,)
    u_hover: Array  # inputs of the hover, (4 N,), N and N m
    lower: Array  # smallest inputs of the owned UAVs, (4 owned,); inputs are clipped to them
    upper: Array  # largest ones
    period_s: float  # sampling period
    ticks: int  # sampling instants of the run
    horizon: int  # most rows of a plan
    # Ticks from the present one to the first that a plan acts at: 0, or 1 with clock.actuation
    # "next_tick".
    delay: int
    seed: int  # of the run, for random numbers that are the same in every run of a scenario
    tick: int = 0  # the present one; a measurement may be older (`links.measurement`)
    agents: tuple[int, ...] = ()  # on the roster
    failed: tuple[int, ...] = ()  # UAVs whose motors are off
    # Whether the others get the plan of this tick even if the class decides not to send it: the
    # first plan, and the first one under each roster, since a receiver may know none yet.
    must_send: bool = True
    data_shape: tuple[int, ...] | None = None  # of the own data; None if none are declared
    _setup: TeamRun
    _seen: tuple[Obstacle, ...] = ()
    _estimate: OwnEstimate | None = None  # None unless the class has asked for it
    _is_starting: bool = True

    def share(self, shape: SupportsIndex | Iterable[SupportsIndex]) -> None:
        """Declare the shape of the own data, float64, that each plan has for the others, in `start`.

        Every agent declares the same. Others find them as `plan.data` in this shape.
        Raises: ValueError: more than 4 KB, no shape, or after `start`.
        """
        self._check_starting("share")
        lengths = tuple(shape) if isinstance(shape, Iterable) else (shape,)
        declared = tuple(index(length) for length in lengths)
        numbers = math.prod(declared)
        if any(length < 1 for length in declared) or numbers > MAX_DATA:
            limit = f"a shape of 1 to {MAX_DATA} numbers ({8 * MAX_DATA} bytes)"
            raise ValueError(f"run.share: expected {limit}, got {declared}")
        self.data_shape = declared

    def estimator(self) -> OwnEstimate:
        """Return the project's estimate of the team, asked for in `start`, which follows the run.

        It takes computation at each tick. Raises: ValueError: after `start`.
        """
        self._check_starting("estimator")
        if self._estimate is None:
            self._estimate = OwnEstimate(self._setup, self.agent)
        return self._estimate

    def _check_starting(self, method: str) -> None:
        if not self._is_starting:
            raise ValueError(f"run.{method}: expected a call in start, got one after it")

    def started(self) -> None:
        """End the start of the class, in which it may declare data and ask for the estimate."""
        self._is_starting = False

    def reference(self, tick: int) -> Array:
        """Return the reference state at a tick, (12 + 12 N,), held after the maneuver."""
        X_ref = self._setup.X_ref
        return np.array(X_ref[min(tick, len(X_ref) - 1)])

    @property
    def targets(self) -> tuple[PathTarget, ...]:
        """Targets that this agent knows and follows, in the order in which they were told."""
        return self._setup.maneuver.targets

    @property
    def seen(self) -> tuple[Obstacle, ...]:
        """Obstacles with `seen_within_m` that UAVs of this agent have seen, in the order of the scenario."""
        return self._seen

    def see(self, seen: tuple[Obstacle, ...]) -> None:
        """Take over what UAVs of this agent have seen."""
        self._seen = seen

    def follow(self, setup: TeamRun) -> None:
        """Take the reference from a run with a further target."""
        self._setup = setup
        if self._estimate is not None:
            self._estimate.follow(setup)

    def begin(self, received: Received, *, must_send: bool) -> None:
        """Take in the tick, the roster and, with an estimate, all that has arrived."""
        self.tick = received.tick
        self.agents = tuple(sorted(received.agents))
        self.failed = tuple(sorted(received.off))
        self.must_send = must_send
        if self._estimate is not None:
            self._estimate.update(received)

    def announce(self, plan: Plan) -> None:
        """Take the own plan of the present tick into the estimate, if there is one."""
        if self._estimate is not None:
            self._estimate.announce(plan)


def run_of(setup: TeamRun, agent: int) -> Run:
    """Return team and run for the controller of an agent, 1-based."""
    owned = setup.owned[agent - 1]
    settings = setup.settings
    x_hover = setup.hover.x.copy()
    u_hover = setup.hover.u.copy()
    lower = np.array(settings.lower(len(owned)))
    upper = np.array(settings.upper(len(owned)))
    frozen(x_hover, u_hover, lower, upper)
    return Run(
        agent=agent,
        owned=owned,
        system=setup.system,
        model=setup.model,
        settings=settings,
        x_hover=x_hover,
        u_hover=u_hover,
        lower=lower,
        upper=upper,
        period_s=settings.sampling_period_s,
        ticks=setup.ticks,
        horizon=settings.horizon,
        delay=int(setup.rules.clock.next_tick),
        seed=setup.rules.seed,
        _setup=setup,
    )
