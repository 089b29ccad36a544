"""Team and run as a controller of the user knows them."""

from dataclasses import dataclass

import numpy as np

from transport.model.arrays import Array
from transport.model.linearisation import Model
from transport.model.parameters import System
from transport.protocol.scenario.setup import Setup


@dataclass(slots=True, kw_only=True)
class Run:
    """Team and run as a controller of the user knows them.

    The parameters are those that the scenario states, not the plant's.

    UAVs are numbered from 0, as in arrays, agents from 1. `tick`, `agents` and `failed` are renewed
    before each step.
    """

    agent: int  # of this object
    owned: tuple[int, ...]  # its UAVs
    system: System  # masses, inertias, attachment points and rod lengths; N is `system.N`
    model: Model  # equations of motion; `model.linearise(x, u)` has the derivatives
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
    _X_ref: Array

    def reference(self, tick: int) -> Array:
        """Return the reference state at a tick, (12 + 12 N,), held after the maneuver."""
        return np.array(self._X_ref[min(tick, len(self._X_ref) - 1)])

    def follow(self, setup: Setup) -> None:
        """Take the reference from a run with a further target."""
        self._X_ref = setup.X_ref


def run_of(setup: Setup, agent: int) -> Run:
    """Return team and run for the controller of an agent, 1-based."""
    owned = setup.owned[agent - 1]
    settings = setup.settings
    return Run(
        agent=agent,
        owned=owned,
        system=setup.system,
        model=setup.model,
        x_hover=setup.hover.x.copy(),
        u_hover=setup.hover.u.copy(),
        lower=settings.lower(len(owned)),
        upper=settings.upper(len(owned)),
        period_s=settings.sampling_period_s,
        ticks=setup.ticks,
        horizon=settings.horizon,
        delay=int(setup.scenario.clock.next_tick),
        seed=setup.scenario.seed,
        _X_ref=setup.X_ref,
    )
