"""The world outside: physics of a team and autopilots, which know nothing of a run but its first state.

`python -m tests.support.outside SCENARIO PORT SPEED [SETTING ...]` plays until it is killed, or falls behind.
A pilot arms all, they hover by themselves, and the team is let go once their thrust carries it. In the folder
of the autopilots `truth.csv` has tick, place of the payload, m, and its largest angle, deg.
"""

import os
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TextIO

import numpy as np
import psutil

from transport.flight.roles import plant_run
from transport.model import state
from transport.model.arrays import Array
from transport.model.state import INPUTS
from transport.plant.autopilot.autopilot_processes import Autopilots
from transport.plant.autopilot.node import PlayedPlant
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Message, PlantState

BEHIND = 3  # exit code of a world that cannot keep its pace
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
    """Physics that are let go as soon as all autopilots carry their UAVs; truth is a file for the record."""

    truth: TextIO

    @property
    def is_behind(self) -> bool:
        """Whether this machine is too busy to play a world at this speed: the UAVs would stand still in the air."""
        return bool(self._autopilots.failure)

    def poll(self, now_ns: int) -> Sequence[Message]:
        """Play on; let the team go."""
        bank = self._autopilots
        assert isinstance(bank, Hovering)
        if self._first is None and np.all(
            bank.thrusts_N > CARRIES * self._setup.run.hover.u[::INPUTS]
        ):
            self._let_go_after(0, now_ns)
        told = super().poll(now_ns)
        for message in told:
            if isinstance(message, PlantState):
                place = message.x[state.R0].tolist()
                tilt = float(np.degrees(np.abs(message.x[state.THETA0]).max()))
                print(message.tick, *place, tilt, sep=",", file=self.truth, flush=True)
        return told


def main(file: str, port: int, speed: float, *changes: str) -> None:
    """Play until killed."""
    settings = (
        "plant.kind=simulated",
        "plant.autopilot=stand_in",
        f"clock.speed={speed}",
        "vehicles.parameters={STAND_PILOT=1.0}",
        *changes,
    )
    with suppress(PermissionError):  # the world outside does not wait for other tests
        os.nice(-10)
    setup = Setup.of(read_scenario(Path(file), settings), file)
    outside = Outside(plant_run(setup), Hovering(plant_run(setup), port))
    # Where sessions share the processors (Linux's autogroup), `nice` counts within one session alone.
    for process in (psutil.Process(), *psutil.Process().children()):
        with suppress(OSError):
            Path(f"/proc/{process.pid}/autogroup").write_text("-10")
    outside.truth = (Path(os.environ["TRANSPORT_AUTOPILOTS"]) / "truth.csv").open("w")
    while not outside.is_behind:
        outside.poll(time.monotonic_ns())
        time.sleep(0.005)
    sys.exit(BEHIND)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), *sys.argv[4:])
