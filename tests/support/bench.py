"""An autopilot on a bench: its process, with physics that hold it at a place, level."""

import socket
import struct
import subprocess
import sys
import threading
from pathlib import Path
from types import TracebackType

import numpy as np

# Parameters with which the checks of the project pass.
FITTING = {
    "GUID_OPTIONS": 8.0,
    "GUID_TIMEOUT": 0.5,
    "MOT_THST_EXPO": 1.0,
    "MOT_SPIN_MIN": 0.0,
    "MOT_SPIN_MAX": 1.0,
    "ATC_ANGLE_BOOST": 0.0,
    "EK3_POS_I_GATE": 200.0,
}
STEP_S = 1 / 400
_SERVO = struct.Struct("<HHI16H")
_LOCAL = "127.0.0.1"


def free_udp_port() -> int:
    """Return a UDP port that is free at the moment."""
    with socket.socket(type=socket.SOCK_DGRAM) as probe:
        probe.bind((_LOCAL, 0))
        port: int = probe.getsockname()[1]
        return port


class Bench:
    """Starts with the context and ends with it.

    Attributes:
        port: UDP port that the autopilot calls, for `--link udp:127.0.0.1:PORT`.
        folder: Its working folder, with `setpoints.csv`.
        thrusts: Shares of thrust of the rotors, (4,), at the newest step.
    """

    def __init__(
        self, folder: Path, *, system: int = 1, key: Path | None = None, **parameters: float
    ) -> None:
        self.folder = folder
        self.port = free_udp_port()
        self.thrusts = np.zeros(4)
        lines = [f"{name} {value}" for name, value in {**FITTING, **parameters}.items()]
        (folder / "defaults.parm").write_text("\n".join(lines) + "\n")
        self._physics = socket.socket(type=socket.SOCK_DGRAM)
        self._physics.bind((_LOCAL, 0))
        self._physics.settimeout(0.5)
        options = {
            "--sysid": system,
            "--home": "47.0,8.0,400,0",
            "--defaults": "defaults.parm",
            "--sim-port-out": self._physics.getsockname()[1],
            "--serial1": f"udpclient:{_LOCAL}:{self.port}",
            **({} if key is None else {"--signing-key": key.resolve()}),
        }
        arguments = [str(part) for option in options.items() for part in option]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "transport.plant.autopilot.stand_in", *arguments], cwd=folder
        )
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._play, daemon=True)

    def __enter__(self) -> "Bench":
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
        self._process.kill()
        self._process.wait()
        self._physics.close()

    @property
    def setpoints(self) -> list[list[float]]:
        """Setpoints that it obeyed: time, time of their knowledge, thrust, body rates."""
        text = (self.folder / "setpoints.csv").read_text()
        return [list(map(float, line.split(","))) for line in text.splitlines()]

    def _play(self) -> None:
        """Answer each step with the sensors of a body at rest, in real time."""
        time_s = 0.0
        while not self._is_over.is_set():
            try:
                packet, there = self._physics.recvfrom(512)
            except TimeoutError:
                continue
            _, _, _, *pulses = _SERVO.unpack_from(packet)
            self.thrusts = ((np.array(pulses[:4]) - 1000.0) / 1000.0) ** 2
            time_s += STEP_S
            self._is_over.wait(STEP_S)
            self._physics.sendto(
                b'\n{"timestamp":%.6f,"imu":{"gyro":[0,0,0],"accel_body":[0,0,-9.81]},'
                b'"position":[1,2,-10],"quaternion":[1,0,0,0],"velocity":[0,0,0]}\n' % time_s,
                there,
            )
