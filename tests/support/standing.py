"""ArduCopters on a stand: the world of `flight` without a run, whose team is never let go."""

import threading
import time
from pathlib import Path
from types import TracebackType

import numpy as np

from tests.support.runs import SCENARIOS
from transport.flight.local_processes import free_udp_ports
from transport.flight.roles import plant_run
from transport.model.arrays import Array
from transport.model.state import INPUTS
from transport.plant.autopilot.autopilot_processes import Autopilots
from transport.plant.autopilot.node import PlayedPlant
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup


class Watched(Autopilots):
    """Autopilots whose newest thrusts are known, (N,), N."""

    thrusts_N: Array = np.zeros(1)

    def inputs(self) -> Array:
        """Return thrust and moments of the motors."""
        inputs = super().inputs()
        self.thrusts_N = inputs[::INPUTS]
        return inputs


class Standing:
    """Starts with the context and ends with it.

    Attributes:
        port: UDP port that the autopilot of UAV 1 calls; then UAV 2, ...
        bank: The autopilots.
    """

    def __init__(self, **parameters: float) -> None:
        self.port = free_udp_ports(4)
        scenario = SCENARIOS / "flight.toml"
        pairs = ",".join(f"{name}={value}" for name, value in parameters.items())
        settings = ("plant.autopilot=ardupilot", f"vehicles.parameters={{{pairs}}}")
        run = plant_run(Setup.of(read_scenario(Path(scenario), settings), str(scenario)))
        self.bank = Watched(run, self.port)
        self._plant = PlayedPlant(run, self.bank)
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._play, daemon=True)

    def __enter__(self) -> "Standing":
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._is_over.set()
        self._thread.join()

    def _play(self) -> None:
        while not self._is_over.is_set():
            self._plant.poll(time.monotonic_ns())
            time.sleep(0.002)
