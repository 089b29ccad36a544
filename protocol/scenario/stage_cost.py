"""Stage cost of a run at each tick, for the report, the figures and the displays of an active run."""

from bisect import bisect_right

from transport.model.arrays import Array
from transport.model.hover import failed_hover
from transport.model.parameters import ParameterError
from transport.model.state import input_indices
from transport.mpc.cost import Cost
from transport.protocol.scenario.faults import failures
from transport.protocol.scenario.setup import Setup


class StageCost:
    """Stage cost of the UAVs that scripted failures leave, whose inputs count against their own hover."""

    def __init__(self, setup: Setup) -> None:
        found = failures(setup.faults)
        self._begins = sorted({0, *(fault.tick for fault in found)})
        self._teams = []  # cost after each failure, and the inputs of released UAVs, which do not count
        for begin in self._begins:
            off = {fault.uav for fault in found if fault.tick <= begin}
            released = {
                fault.uav for fault in found if fault.tick <= begin and fault.do == "release"
            }
            try:
                equilibrium = failed_hover(setup.system, off, released) if off else setup.hover
            except ParameterError:
                equilibrium = (
                    setup.hover
                )  # the rest cannot hover; the control law keeps this one, too
            cost = Cost(setup.settings.weights, setup.system, equilibrium, off, released)
            self._teams.append((cost, input_indices(sorted(released))))

    def at(self, tick: int, y: Array, y_ref: Array, u: Array) -> float:
        """Return the stage cost of a tick, (21), of output y, its reference, (4 N + 9,), and input u, (4 N,)."""
        cost, uncounted = self._teams[bisect_right(self._begins, tick) - 1]
        if len(uncounted):
            u = u.copy()
            u[uncounted] = cost.u_target[uncounted]
        return cost.stage(y, y_ref, u)
