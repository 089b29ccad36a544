"""The exchange of messages as bytes, here in one process, gives the in-memory run bit for bit."""

from collections import Counter
from pathlib import Path

import pytest
from msgspec.structs import replace

from protocol.scenario.setup import Setup
from protocol.wire.codec import encode
from protocol.wire.messages import Message, Roster
from tests.support.runs import SHORT, ready, recorded, reproducible
from tests.support.troubles import HEAVY, ITERATIONS, NEXT_TICK
from tests.support.wire import Wire, without_network
from tests.transport.test_garbage import recording
from transport.log.run_log import read_log

SHARED_ON_CHANGE = ("controller.share=on_change", "controller.share_threshold=0.02", "controller.share_heartbeat_s=0.4")
RELEASED = "faults.event=[{at_s=0.5,do='motor_off',target='uav3'},{at_s=0.55,do='release',target='uav3'}]"
MOTORS = (
    "plant.motors={lag_s=0.06,thrust_step_N=0.1,rotors={arm_m=0.25,drag_to_thrust_m=0.016,thrust_N=[0.5,6.0]}}",
    "controller.motor_lag_s=0.05",
    "faults.event=[{at_s=0.5,do='degrade',target='uav2',efficiency=0.95}]",
)
CASES = {
    "plain": (),
    "impaired negotiation": (HEAVY, ITERATIONS, NEXT_TICK),
}
SLOW = {
    "shared on change with motors": (*SHARED_ON_CHANGE, *MOTORS, "links.loss=0.3"),
    "negotiation": (ITERATIONS,),
    "two UAVs each": ("agents.owned=[[1,2],[3,4]]",),
    "released": (RELEASED,),
}


def run_of(*changes: str) -> Setup:
    """Return a run of 1.5 s of the ready scenario with the shared control law."""
    return ready("resilient", SHORT, *changes)


def said(messages: list[Message]) -> dict[tuple[str, int], bytes]:
    """Return the messages by sender and number, without incarnations and wall-clock times; bundles bring some twice."""
    found: dict[tuple[str, int], bytes] = {}
    for message in messages:
        plain = replace(reproducible(message), incarnation=0)
        if isinstance(plain, Roster):
            plain = replace(plain, incarnations=(0,) * len(plain.agents))
        assert found.setdefault((plain.sender, plain.sequence), encode(plain)) == encode(plain)
    return found


def simulated(run: Setup, folder: Path) -> Wire:
    """Simulate a run as bytes and return it."""
    folder.mkdir()
    with recording(run, folder / "run.mcap") as witness:
        wire = Wire(run, witness)
        assert wire.simulate().outcome == "completed"
    return wire


@pytest.fixture(autouse=True)
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let buses open sessions without a network."""
    without_network(monkeypatch)


@pytest.mark.parametrize(
    "changes",
    [
        *(pytest.param(changes, id=name) for name, changes in CASES.items()),
        *(pytest.param(changes, id=name, marks=pytest.mark.slow) for name, changes in SLOW.items()),
    ],
)
def test_the_exchange_keeps_all_bits(changes: tuple[str, ...], tmp_path: Path) -> None:
    """Every message equals the in-memory run's, and is in the log once: plans, reports, measurements, states."""
    memory = said(recorded(run_of(*changes)))
    wire = simulated(run_of(*changes), tmp_path / "run")
    assert said(wire.sent) == memory
    log = read_log(tmp_path / "run" / "run.mcap")
    assert said([entry.message for entry in log.messages]) == memory
    assert len(log.messages) == len(memory)
    assert sum(receiver.gate.rejections.total for receiver in wire.receivers.values()) == 0


def test_messages_of_a_tick(tmp_path: Path) -> None:
    """In a tick an agent receives one message and sends one, whatever the size of the team."""
    run, counts = run_of(), Counter[str]()

    def count(_: Wire, name: str, key: str, data: bytes) -> None:
        counts[f"{name} {key.split('/')[2]}"] += 1

    with recording(run, tmp_path / "run.mcap") as witness:
        assert Wire(run, witness, count).simulate().outcome == "completed"
    ticks = run.ticks
    for agent in run.agents:
        found = {end: counts[f"agent{agent} {end}"] for end in ("instant", "measurement", "relay", "plan", "unshared")}
        assert found == {"instant": ticks, "measurement": 0, "relay": 0, "plan": 0, "unshared": 0}
    assert counts["coordinator answer"] == len(run.agents) * ticks
    assert counts["recorder relay"] == ticks + 1
    assert counts["recorder record"] <= ticks + 1
    assert counts["recorder report"] == counts["recorder plan"] == counts["recorder measurement"] == 0
