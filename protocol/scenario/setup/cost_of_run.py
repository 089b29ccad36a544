"""Stage cost of a run at each tick, for the report, the figures and the displays of a run."""

from bisect import bisect_right
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from transport.model.arrays import Array
from transport.model.physics.hover import hover_after_failures
from transport.model.physics.parameters import ParameterError
from transport.model.state import input_indices
from transport.mpc.program.stage_cost import Cost
from transport.protocol.scenario.faults.faults_by_tick import Fault, failures
from transport.protocol.scenario.setup.run_setup import Setup


@dataclass(frozen=True, slots=True)
class TeamCost:
    """Cost of the UAVs that a failure leaves."""

    cost: Cost
    uncounted: npt.NDArray[np.intp]  # inputs of released UAVs


class StageCost:
    """Stage cost of the UAVs remaining after scripted failures, with inputs relative to their own hover."""

    def __init__(self, setup: Setup) -> None:
        failed = failures(setup.faults)
        self._first_ticks = sorted({0, *(fault.tick for fault in failed)})
        self._teams = [
            _team_cost(setup, [fault for fault in failed if fault.tick <= first_tick])
            for first_tick in self._first_ticks
        ]

    def at(self, tick: int, y: Array, y_ref: Array, u: Array) -> float:
        """Return the stage cost of a tick, docs/equations.md (21).

        Given are output y and its reference, (4 N + 9,), and input u, (4 N,).
        """
        team = self._teams[bisect_right(self._first_ticks, tick) - 1]
        if len(team.uncounted):
            u = u.copy()
            u[team.uncounted] = team.cost.u_target[team.uncounted]
        return team.cost.stage(y, y_ref, u)


def _team_cost(setup: Setup, failed: list[Fault]) -> TeamCost:
    """Return the cost after some failures."""
    off = {fault.uav for fault in failed}
    released = {fault.uav for fault in failed if fault.do == "release"}

    equilibrium = setup.hover
    if off:
        # If the rest cannot hover, the control law keeps the hover of all as well.
        with suppress(ParameterError):
            equilibrium = hover_after_failures(setup.system, off, released)

    cost = Cost(setup.settings.weights, setup.system, equilibrium, off, released)
    return TeamCost(cost, input_indices(sorted(released)))
