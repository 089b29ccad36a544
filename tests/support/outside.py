"""The world outside: physics of a team and autopilots, which know nothing of a run but its first state.

`python -m tests.support.outside SCENARIO PORT SPEED` plays until it is killed. A pilot arms all, they
hover by themselves, and the team is let go once their thrust carries it.
"""

import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from transport.flight.roles import plant_run
from transport.model.arrays import Array
from transport.model.state import INPUTS
from transport.plant.autopilot.autopilot_processes import Autopilots
from transport.plant.autopilot.node import PlayedPlant
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Message

CARRIES = 0.95  # share of the thrust of hover


class Hovering(Autopilots):
    """Autopilots whose newest thrusts are known, (N,), N."""

    thrusts_N: Array = np.zeros(1)

    def inputs(self) -> Array:
        """Return thrust and moments of the motors."""
        inputs = super().inputs()
        self.thrusts_N = inputs[::INPUTS]
        return inputs


class Outside(PlayedPlant):
    """Physics that are let go as soon as all autopilots carry their UAVs."""

    def poll(self, now_ns: int) -> Sequence[Message]:
        """Play on; let the team go."""
        bank = self._autopilots
        assert isinstance(bank, Hovering)
        if self._first is None and np.all(
            bank.thrusts_N > CARRIES * self._setup.run.hover.u[::INPUTS]
        ):
            self._first = self._played
        return super().poll(now_ns)


def main(file: str, port: int, speed: float) -> None:
    """Play until killed."""
    settings = (
        "plant.kind=simulated",
        "plant.autopilot=stand_in",
        f"clock.speed={speed}",
        "vehicles.parameters={STAND_PILOT=1.0}",
    )
    setup = Setup.of(read_scenario(Path(file), settings), file)
    outside = Outside(plant_run(setup), Hovering(plant_run(setup), port))
    while True:
        outside.poll(time.monotonic_ns())
        time.sleep(0.002)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
