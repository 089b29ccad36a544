"""Arguments with which the harness starts each process of a run."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from transport.flight.local_processes import Harness, arguments_of
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.scenario.sections.lockstep_and_realtime_section import LONGEST_WAIT_S

PLACE = Endpoints(listen=["tcp/127.0.0.1:7001"], connect=["tcp/127.0.0.1:7000"])
NAMES = "coordinator", "recorder", "plant", "agent3", "vehicle2"
LOCAL = Harness("r1", Path("scenario.toml"), dict.fromkeys(NAMES, PLACE), Path("logs"))
MAVLINK = replace(LOCAL, vehicle_port=14550, autopilot="px4")
BETAFLIGHT = replace(LOCAL, vehicle_port=5761, autopilot="betaflight")
# Of every process.
COMMON = (
    *("--scenario", "scenario.toml"),
    *("--run", "r1"),
    *("--incarnation", "2"),
    *("--join-timeout", str(LONGEST_WAIT_S)),
    *("--listen", "tcp/127.0.0.1:7001"),
    *("--connect", "tcp/127.0.0.1:7000"),
)


@pytest.mark.parametrize(
    ("harness", "name", "command", "settings"),
    [
        (LOCAL, "coordinator", "coordinator --observer recorder", []),
        (LOCAL, "plant", "plant", []),
        (LOCAL, "agent3", "agent --id 3", []),
        (MAVLINK, "agent3", "agent --id 3", []),
        (MAVLINK, "plant", "plant", ["network.vehicle_port=14550"]),
        (
            MAVLINK,
            "vehicle2",
            "vehicle --uav 2 --link udp:127.0.0.1:14551",
            ["network.vehicle_port=14550"],
        ),
        (
            replace(MAVLINK, stands=True),
            "vehicle2",
            "vehicle --uav 2 --link udp:127.0.0.1:14551 --stands",
            ["network.vehicle_port=14550"],
        ),
        (
            BETAFLIGHT,
            "vehicle2",
            "vehicle --uav 2 --autopilot betaflight --link tcp:127.0.0.1:5762 --pose udp:127.0.0.1:5762",
            ["network.vehicle_port=5761"],
        ),
        (replace(LOCAL, keys=Path("my keys")), "plant", "plant", ['network.keys="my keys"']),
        (
            replace(MAVLINK, keys=Path("k")),
            "plant",
            "plant",
            ["network.vehicle_port=14550", 'network.keys="k"'],
        ),
    ],
)
def test_arguments_follow_from_role_number_and_place(
    harness: Harness, name: str, command: str, settings: Sequence[str]
) -> None:
    """The command comes first, then the options of all processes, with the settings of the role."""
    arguments = arguments_of(harness, name, 2)
    words = command.split()
    assert arguments[: len(words) + 1] == [*words, "--allow-large"]

    options = arguments[len(words) + 1 :]
    values = [value for option, value in itertools.pairwise(options) if option == "--set"]
    assert values == settings
    assert [text for text in options if text not in ("--set", *settings)] == list(COMMON)
