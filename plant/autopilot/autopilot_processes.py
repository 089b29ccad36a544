"""The programs of the autopilots, and the physics side of their simulator interface.

ArduPilot's JSON interface, a UDP socket each: the autopilot sends the pulses of its motors from a port of its own,
and waits for the sensors of the next step, so neither runs ahead of the other. A packet that is not answered
within a second comes again, with its number: one that has been answered is left out, else the motors would lag
a step more from then on.
"""

import ctypes
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
import weakref
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from transport.model import state
from transport.model.arrays import Array
from transport.model.state import INPUTS, SENSED
from transport.plant.autopilot.autopilot_parameters import parameters
from transport.plant.firmware.tuning import rotors_of
from transport.plant.plant_run import PlantRun
from transport.plant.rotors_and_motors import Rotors
from transport.protocol.scenario.sections.scenario_errors import ScenarioError

PROGRAM = "ARDUCOPTER"  # environment variable
# Folder for the files of the autopilots, one folder each; a temporary one without the variable.
FOLDER = "TRANSPORT_AUTOPILOTS"
# Steps of the physics a second: ArduCopter refuses to arm below 1.8 times the rate of its loop.
STEPS_HZ = {"ardupilot": 800.0, "stand_in": 400.0}
_STAND_IN = (sys.executable, "-m", "transport.plant.autopilot.stand_in")
_HOME = "{0},{1},{2},0"
_SERVO = struct.Struct("<HHI16H")
_LOCAL = "127.0.0.1"
_DISCARD = 9  # port of serial lines that are not used
_LARGEST_PACKET = 512
# Real time without an answer after which an autopilot counts as gone, s.
_PATIENCE_S = 20.0
_LOOK_S = 0.5  # after which it is looked at
_PULSE_LOW_US = 1000.0
_PULSE_RANGE_US = 1000.0
_DIES_WITH_PARENT = 1  # PR_SET_PDEATHSIG


def program(setup: PlantRun) -> list[str]:
    """Return the command of the autopilots of a run. Raises: ScenarioError: there is none."""
    if setup.section.autopilot == "stand_in":
        return list(_STAND_IN)
    given = os.environ.get(PROGRAM, "")
    found = shutil.which(given) if given else None
    if found is None:
        expected = f"the environment variable {PROGRAM} to name ArduCopter's simulator program"
        got = repr(given) if given else "none; build it from its source, see docs/flight.md"
        text = f"expected {expected}, got {got}"
        raise ScenarioError(setup.run.rules.name, "plant.autopilot", text)
    return [str(Path(found).resolve())]


def version(setup: PlantRun) -> str:
    """Return the name of the autopilots that a run will start. Raises: ScenarioError: they cannot be."""
    if find_spec("pymavlink") is None:
        text = "expected the package pymavlink, got none; pip install 'payload-transport[flight]'"
        raise ScenarioError(setup.run.rules.name, "plant.autopilot", text)
    name = setup.section.autopilot
    return f"autopilots {name}, {Path(program(setup)[0]).name}"


class Autopilots:
    """The autopilots of all UAVs as processes, in steps of `step_s`; an `AutopilotBank`.

    Pulses that an autopilot makes of one state act from the next step on.

    Args:
        setup: The run.
        port: UDP port of the link of UAV 1, to its vehicle, then UAV 2, ...

    Raises: ScenarioError: a program cannot be started.
    """

    def __init__(self, setup: PlantRun, port: int) -> None:
        kind = setup.section.autopilot or "stand_in"
        self.step_s = 1.0 / STEPS_HZ[kind]
        self.failure = ""
        rotors = rotors_of(setup)
        self._mixing = np.stack([Rotors(each).mixing for each in rotors])  # of (56), (N, 4, 4)
        self._rotor_most_N = np.array([each.thrust_N[1] for each in rotors])
        self._sockets: list[socket.socket] = []
        self._processes: list[subprocess.Popen[bytes]] = []
        # Of each autopilot: where its newest packet came from, and the number of that packet.
        self._addresses: list[tuple[str, int]] = []
        self._answered: list[int | None] = []
        self._folders: list[Path] = []
        kept = os.environ.get(FOLDER)
        folder = kept or tempfile.mkdtemp(prefix="transport-autopilots-")
        weakref.finalize(self, _end, self._processes, self._sockets, None if kept else folder)

        command = program(setup)
        hover_N = setup.run.hover.u[::INPUTS]
        for i, uav in enumerate(setup.run.system.uavs):
            own = Path(folder) / f"uav{i + 1}"
            own.mkdir(parents=True, exist_ok=True)
            wanted = parameters(setup, uav, rotors[i], float(hover_N[i]), STEPS_HZ[kind])
            lines = [f"{name} {value:.9g}" for name, value in wanted.items()]
            (own / "defaults.parm").write_text("\n".join(lines) + "\n", encoding="ascii")
            self._start(command, own, i, port + i, setup.vehicles.origin)

    def _start(
        self,
        command: Sequence[str],
        folder: Path,
        i: int,
        link_port: int,
        home: Sequence[float],
    ) -> None:
        """Start the autopilot of a UAV, 0-based."""
        physics = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        physics.bind((_LOCAL, 0))
        physics.settimeout(_LOOK_S)
        self._folders.append(folder)
        self._sockets.append(physics)
        self._addresses.append((_LOCAL, _DISCARD))
        self._answered.append(None)
        options = {
            "--model": f"JSON:{_LOCAL}",
            "-I": str(i),
            "--sysid": str(i + 1),
            "--home": _HOME.format(*home),
            "--speedup": "100",  # the physics decide
            "--defaults": "defaults.parm",
            "--sim-address": _LOCAL,
            "--sim-port-out": str(physics.getsockname()[1]),
            "--serial0": f"udpclient:{_LOCAL}:{_DISCARD}",  # believes packets without a signature
            "--serial1": f"udpclient:{_LOCAL}:{link_port}",
            "--serial2": f"udpclient:{_LOCAL}:{_DISCARD}",
        }
        arguments = [text for option in options.items() for text in option]
        libc = ctypes.CDLL(None)
        with (folder / "output.txt").open("wb") as output:
            self._processes.append(
                subprocess.Popen(
                    [*command, "--wipe", *arguments],
                    cwd=folder,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,  # Ctrl-C is for the plant, which ends them
                    preexec_fn=lambda: libc.prctl(_DIES_WITH_PARENT, signal.SIGKILL),
                )
            )

    def inputs(self) -> Array:
        """Return thrust and moments that the rotors give at the newest pulses, (4 N,), N and N m.

        Zeros after a failure, which ends the run.
        """
        pulses_us = np.full((len(self._sockets), INPUTS), _PULSE_LOW_US)
        for i, physics in enumerate(self._sockets):
            if self.failure:
                break
            packet = self._received(i, physics)
            if packet is None:
                break
            _, _, _, *pulses = _SERVO.unpack_from(packet)
            pulses_us[i] = pulses[:INPUTS]
        # The speed of a rotor follows the pulse, its thrust the square of the speed.
        outputs = np.clip((pulses_us - _PULSE_LOW_US) / _PULSE_RANGE_US, 0.0, 1.0)
        thrusts = self._rotor_most_N[:, None] * outputs**2
        inputs: Array = np.einsum("nij,nj->ni", self._mixing, thrusts).reshape(-1)
        return inputs

    def _received(self, i: int, physics: socket.socket) -> bytes | None:
        """Return the next packet of an autopilot, 0-based; None after a failure, which is noted."""
        until_s = time.monotonic() + _PATIENCE_S
        while time.monotonic() < until_s:
            try:
                packet, self._addresses[i] = physics.recvfrom(_LARGEST_PACKET)
                number = _SERVO.unpack_from(packet)[2]
                if number != self._answered[i]:
                    self._answered[i] = number
                    return packet
            except TimeoutError:
                code = self._processes[i].poll()
                if code is not None:
                    output = self._folders[i] / "output.txt"
                    text = output.read_text(encoding="utf-8", errors="replace").strip()
                    last = text.rpartition("\n")[2]
                    self.failure = f"the autopilot of UAV{i + 1} ended with code {code}: {last}"
                    return None
        self.failure = f"the autopilot of UAV{i + 1} has not answered for {_PATIENCE_S:g} s"
        return None

    def sense(self, time_s: float, sensed: Array) -> None:
        """Let all go on for a step by their sensors at a time, (15 N,)."""
        of_uavs = sensed.reshape(-1, SENSED)
        x_y_z_w = Rotation.from_euler("ZYX", of_uavs[:, state.THETA][:, ::-1]).as_quat()
        for i, physics in enumerate(self._sockets):
            own = of_uavs[i].tolist()
            x, y, z, w = x_y_z_w[i].tolist()
            gyro = "{:.6f},{:.6f},{:.6f}".format(*own[state.OMEGA])
            force = "{:.5f},{:.5f},{:.5f}".format(*own[state.SPECIFIC_FORCE])
            place = "{:.5f},{:.5f},{:.5f}".format(*own[state.POSITION])
            speed = "{:.5f},{:.5f},{:.5f}".format(*own[state.VELOCITY])
            turned = f"{w:.7f},{x:.7f},{y:.7f},{z:.7f}"
            text = (
                f'\n{{"timestamp":{time_s:.6f},"imu":{{"gyro":[{gyro}],"accel_body":[{force}]}},'
                f'"position":[{place}],"quaternion":[{turned}],"velocity":[{speed}]}}\n'
            )
            physics.sendto(text.encode("ascii"), self._addresses[i])


def _end(
    processes: list[subprocess.Popen[bytes]], sockets: list[socket.socket], folder: str | None
) -> None:
    for process in processes:
        process.kill()
    for process in processes:
        process.wait()
    for physics in sockets:
        physics.close()
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)
