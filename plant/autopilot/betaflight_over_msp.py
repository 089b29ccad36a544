"""Betaflights on their real links, one for each UAV, in lockstep with the physics: an `AutopilotBank`.

The firmwares run in virtual time as those of `plant.firmware.betaflight`, but their receivers are MSP
on a TCP port, where the process of the UAV speaks to them as to a flight controller on a serial line.
A motion capture tells each process position, velocity and attitude over UDP.
"""

import math
import socket
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from transport.model import state
from transport.model.arrays import Array
from transport.model.state import INPUTS, SENSED
from transport.plant.firmware.firmware_process import (
    FirmwareError,
    Process,
    eeprom_after,
    executable,
    virtual_time,
)
from transport.plant.firmware.tuning import IDLE, IDLE_THROTTLE_US, SETTINGS, rotors_of, tuning
from transport.plant.plant_run import PlantRun
from transport.plant.rotors_and_motors import Rotors
from transport.protocol.network.mavlink import Endpoint, MavlinkLink, messages
from transport.protocol.scenario.sections.scenario_errors import ScenarioError

_LOCAL = "127.0.0.1"
_STEP_S = 1e-3
_POSE_STEPS = 10  # between two words of the motion capture: 100 Hz
_CAMERA = 197  # component of a visual-inertial odometry
_RECEIVER_HZ = 1000  # of its serial ports: each command is answered in a turn of its own
_TENTHS = 10.0


class Betaflights:
    """The firmwares of all UAVs.

    Args:
        setup: The run.
        port: TCP port of the MSP of UAV 1, and UDP port of its motion capture; then UAV 2, ...

    Attributes:
        step_s: Time between two exchanges, s.
        failure: Why the run ends; empty while all answer.

    Raises: ScenarioError: a firmware cannot be started.
    """

    def __init__(self, setup: PlantRun, port: int) -> None:
        self.step_s = _STEP_S
        self.failure = ""
        rotors = rotors_of(setup)
        self._mixing = np.stack([Rotors(each).mixing for each in rotors])  # of (56), (N, 4, 4)
        self._rotor_most_N = np.array([each.thrust_N[1] for each in rotors])
        self._step = 0
        self._processes: list[Process] = []
        self._poses = [
            MavlinkLink(Endpoint(True, _LOCAL, port + i), (i + 1, _CAMERA), 0)
            for i in range(len(rotors))
        ]
        weakref.finalize(self, _end, self._processes, self._poses)
        try:
            self._start(setup, port)
        except (FirmwareError, OSError) as error:
            raise ScenarioError(setup.run.rules.name, "plant.autopilot", str(error)) from error

    def _start(self, setup: PlantRun, port: int) -> None:
        """Start the firmwares, each with the gains of its UAV. Raises: FirmwareError, OSError."""
        made: dict[tuple[str, ...], bytes] = {}
        thrusts_N = setup.run.hover.u[::INPUTS]
        with tempfile.TemporaryDirectory() as name:
            for i, (uav, section) in enumerate(
                zip(setup.run.system.uavs, rotors_of(setup), strict=True)
            ):
                gains = tuning(setup, uav, section, float(thrusts_N[i]))
                output = math.sqrt(float(thrusts_N[i]) / (INPUTS * section.thrust_N[1]))
                lines = (*SETTINGS, *_links(setup.vehicles.setpoint_timeout_s, output), *gains)
                if lines not in made:
                    made[lines] = eeprom_after(lines, _STEP_S)
                folder = Path(name) / str(i)
                folder.mkdir()
                (folder / "eeprom.bin").write_bytes(made[lines])
                with socket.create_server((_LOCAL, port + i)) as listener:
                    listener.setblocking(False)
                    self._processes.append(Process(folder, _STEP_S, listener))
            # Its settings are read before its first exchange.
            for process in self._processes:
                process.outputs()
                process.give()

    def inputs(self) -> Array:
        """Return thrust and moments that the rotors give at the newest outputs, (4 N,), N and N m.

        The speed of a rotor follows the output, its thrust the square. Zeros after a failure, which
        ends the run.
        """
        outputs = np.zeros((len(self._processes), INPUTS))
        if not self.failure:
            try:
                outputs = np.array([process.outputs() for process in self._processes])
            except FirmwareError as error:
                self.failure = str(error)
        thrusts_N = self._rotor_most_N[:, None] * np.clip(outputs, 0.0, 1.0) ** 2
        inputs: Array = np.einsum("nij,nj->ni", self._mixing, thrusts_N).reshape(-1)
        return inputs

    def sense(self, time_s: float, sensed: Array) -> None:
        """Let all go on for a step by their sensors at a time since their start, (15 N,)."""
        uavs = sensed.reshape(-1, SENSED)
        attitudes = Rotation.from_euler("ZYX", uavs[:, state.THETA][:, ::-1])
        quaternions = attitudes.as_quat()[:, [3, 0, 1, 2]]
        if self._step % _POSE_STEPS == 0:
            for i, link in enumerate(self._poses):
                link.send(_pose(time_s, uavs[i], quaternions[i].tolist()))
        self._step += 1
        # The packet has the acceleration about forward, left, up, negated, and the attitude of these
        # axes in a world with z up.
        felt = uavs[:, state.SPECIFIC_FORCE] * [-1.0, 1.0, 1.0]
        turned = quaternions * [1.0, 1.0, -1.0, -1.0]
        packets = np.column_stack([uavs[:, state.OMEGA], felt, turned]).tolist()
        try:
            for process, packet in zip(self._processes, packets, strict=True):
                process.give(packet)
        except FirmwareError as error:
            self.failure = self.failure or str(error)


def _links(setpoint_timeout_s: float, hover: float) -> Sequence[str]:
    """Return the settings of a firmware that hears its receiver by MSP, with a fail-safe that levels.

    Without setpoints the throttle is held, and then that of a hover, whose output of a rotor is given.
    """
    throttle_us = IDLE_THROTTLE_US + (2000 - IDLE_THROTTLE_US) * (hover - IDLE) / (1.0 - IDLE)
    return (
        f"set serial_update_rate_hz = {_RECEIVER_HZ}",
        f"set failsafe_delay = {max(math.floor(_TENTHS * setpoint_timeout_s), 1)}",
        "set failsafe_procedure = AUTO-LAND",
        f"set failsafe_throttle = {round(throttle_us)}",
        "set failsafe_recovery_delay = 1",
        "rxfail 3 h",
    )


def _pose(time_s: float, uav: Array, quaternion: Sequence[float]) -> object:
    """Return the word of a motion capture about one UAV, (15,), in the common frame."""
    m = messages()
    frame = m.MAV_FRAME_LOCAL_NED
    place, velocity = uav[state.POSITION].tolist(), uav[state.VELOCITY].tolist()
    unknown = [math.nan, *[0.0] * 20]
    rates = uav[state.OMEGA].tolist()
    return m.MAVLink_odometry_message(
        round(1e6 * time_s), frame, frame, *place, quaternion, *velocity, *rates, unknown, unknown
    )


def version(setup: PlantRun) -> str:
    """Return name and version of the firmware that a run will start. Raises: ScenarioError: none usable."""
    try:
        executable()
        virtual_time()
    except FirmwareError as error:
        raise ScenarioError(setup.run.rules.name, "plant.autopilot", str(error)) from error
    return f"betaflight on its links, {executable().name}"


def _end(processes: Sequence[Process], poses: Sequence[MavlinkLink]) -> None:
    for process in processes:
        process.end()
    for link in poses:
        link.close()
