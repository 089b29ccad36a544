"""Comparison of a recorded run with the same run in this process, bit for bit, up to a tick.

The run in this process is simulated to that tick only, as a recorded one may have been interrupted.
"""

from collections.abc import Iterable
from pathlib import Path

from tests.support.runs import begun
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Message, Plan, PlantState


def simulated_before(tick: int, scenario: Path, setting: str) -> list[Message]:
    """Return the messages of all ticks before one, of a run of a scenario with a setting in this process."""
    return begun(Setup.of(read_scenario(scenario, [setting]), str(scenario)), tick)


def before(tick: int, messages: Iterable[Message]) -> list[Message]:
    """Return the messages of all ticks before one."""
    return [message for message in messages if message.tick < tick]


def flight_bits(messages: Iterable[Message]) -> list[tuple[int, str, bytes]]:
    """Return tick, sender and bytes of plant states and plans, sorted.

    These decide the flight. Other kinds are left out, such as reports, which have wall-clock times.
    Sorted, as the processes of a run are recorded in any order within a tick.
    """
    bits = []
    for message in messages:
        match message:
            case PlantState():
                numbers = message.x.tobytes() + message.u.tobytes()
            case Plan():
                arrays = (message.uav_states, message.inputs, message.corrections)
                numbers = b"".join(array.tobytes() for array in arrays)
            case _:
                continue
        bits.append((message.tick, message.sender, numbers))
    return sorted(bits)
