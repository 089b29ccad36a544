"""Key expressions: senders and receivers of every kind of message."""

import pytest

from tests.support.messages import sample
from transport.protocol.wire.bundles import BUNDLES, Answer, Instant, Record, Relay
from transport.protocol.wire.errors_and_exit_codes import MessageError, TransportError
from transport.protocol.wire.key_expressions import Keys, Token, matches
from transport.protocol.wire.messages import (
    KINDS,
    ActualInputs,
    Airtime,
    Control,
    FaultNote,
    LinkChange,
    Measurement,
    Message,
    Note,
    Plan,
    PlantState,
    Rejected,
    Roster,
    Schedule,
    StepReport,
    Target,
    Tick,
    VehicleStatus,
)
from transport.protocol.wire.names import agent_name, vehicle_name

KEYS = Keys("run-1")
AGENTS = (1, 2, 12, 123)  # ids that begin with each other
NAMES = (
    *("coordinator", "plant", "recorder", "watcher"),
    *map(agent_name, AGENTS),
    *map(vehicle_name, AGENTS),
)

OWNERS = {
    "tick": "coordinator",
    "roster": "coordinator",
    "link": "coordinator",
    "control": "coordinator",
    "measurement": "plant",
    "plant_state": "plant",
    "fault": "recorder",
    "target": "coordinator",
    "airtime": "coordinator",
    "schedule": "coordinator",
    "vehicle": "vehicle2",
    "actual_inputs": "plant",
    "plan": "agent2",
    "report": "agent2",
    "note": "agent2",
    "rejected": "agent2",
    "answer": "agent2",
    "relay": "coordinator",
    "instant": "plant",
    "record": "plant",
}
ALL_KINDS = KINDS | BUNDLES


def listeners(message: Message) -> set[str]:
    """Names of the processes that a message reaches, its sender not counted."""
    key = KEYS.of(message)
    hearing = {
        name
        for name in NAMES
        if any(matches(expression, key) for expression in KEYS.subscriptions(name))
    }
    return hearing - {message.sender}


ALL_AGENTS = {agent_name(agent) for agent in AGENTS}
ALL_VEHICLES = {vehicle_name(uav) for uav in AGENTS}
READERS = {"recorder", "watcher"}
ALL_BUT_COORDINATOR = {"plant", *READERS, *ALL_AGENTS, *ALL_VEHICLES}


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        (Tick, {"plant", *READERS}),
        (Roster, ALL_BUT_COORDINATOR),
        (LinkChange, ALL_BUT_COORDINATOR),
        (Target, ALL_BUT_COORDINATOR),
        (FaultNote, set()),
        (Control, ALL_BUT_COORDINATOR),
        (Airtime, {"plant", *READERS, *ALL_AGENTS}),
        (Schedule, {"plant", *READERS, *ALL_VEHICLES}),
        (VehicleStatus, {"coordinator", "plant", *READERS, *ALL_VEHICLES} - {"vehicle2"}),
        (Measurement, {"agent2", "recorder"}),
        (Plan, {"coordinator", "plant", "recorder", "vehicle2", *ALL_AGENTS} - {"agent2"}),
        (StepReport, READERS),
        (Note, READERS),
        (Rejected, READERS),
        (PlantState, {"coordinator", *READERS}),
        (ActualInputs, {"recorder"}),
        (Answer, {"coordinator"}),
        (Relay, {"plant", *READERS}),
        (Instant, ALL_AGENTS),
        (Record, {"coordinator", *READERS}),
    ],
)
def test_receivers(kind: type[Message], expected: set[str]) -> None:
    """Each message reaches exactly the roles of its route.

    The recorder receives every message that is sent.
    """
    assert listeners(sample(kind)) == expected


def test_unshared_plans_reach_no_other_agent() -> None:
    """They go to the coordinator, the plant and the vehicle of their agent."""
    reached = listeners(sample(Plan, shared=False))
    assert reached == {"coordinator", "plant", "recorder", "vehicle2"}


@pytest.mark.parametrize("kind", ALL_KINDS.values())
def test_only_the_owner_of_a_message_may_publish_under_its_key(kind: type[Message]) -> None:
    """Access rights follow; measurements may come from the process of the UAV, and notes of the log from none."""
    key = KEYS.of(sample(kind))
    may = {name for name in NAMES if any(matches(one, key) for one in KEYS.publications(name))}
    owners = {OWNERS[kind.kind]}
    if kind is Measurement:
        owners.add("vehicle2")
    assert may == owners - {"recorder"}


def test_keys_are_as_documented() -> None:
    """Keys and tokens are spelled as the protocol documents them: other programs read them."""
    expected = {
        "tick": "transport/run-1/tick",
        "roster": "transport/run-1/roster",
        "link": "transport/run-1/roster",  # who has the roster that follows a change has the change
        "fault": "transport/run-1/fault",
        "control": "transport/run-1/control",
        "measurement": "transport/run-1/measurement/2",
        "plant_state": "transport/run-1/plant_state",
        "plan": "transport/run-1/plan/2",
        "report": "transport/run-1/report/2",
        "rejected": "transport/run-1/rejected/agent2",
        "answer": "transport/run-1/answer/2",
        "relay": "transport/run-1/relay",
        "instant": "transport/run-1/instant",
        "record": "transport/run-1/record",
    }
    assert {kind: KEYS.of(sample(ALL_KINDS[kind])) for kind in expected} == expected
    assert KEYS.alive("agent2", 3, "0123ab", 5) == "transport/run-1/alive/agent2/3/0123ab/5"
    assert KEYS.ready("plant", 0) == "transport/run-1/ready/plant/0"


@pytest.mark.parametrize("kind", [ALL_KINDS[kind] for kind in OWNERS if kind != Rejected.kind])
def test_forged_senders_are_refused(kind: type[Message]) -> None:
    """A message that claims any other sender than its key's owner is refused; the text names both."""
    for name in NAMES:
        message = sample(kind, sender=name)
        owner = OWNERS[kind.kind]
        if kind is Measurement and name in ALL_VEHICLES:
            owner = "vehicle2"  # in place of the plant
        if name == owner:
            KEYS.check_sender(KEYS.of(message), message)
            continue
        with pytest.raises(
            MessageError, match=f"{kind.kind} from {name}, expected it from {owner}"
        ):
            KEYS.check_sender(KEYS.of(message), message)


def test_tokens_are_read() -> None:
    """A token is read back as it was written."""
    assert KEYS.token(KEYS.alive("agent2", 3, "0123ab", 5)) == Token("agent2", 3, "0123ab", 5)
    assert KEYS.token(KEYS.ready("plant", 0)) == Token("plant", 0, None, None)


@pytest.mark.parametrize(
    "run", ["", "a/b", "a b", "*", "a*", "**", "$*", "a#", "a?b", "\u00e4", "a\n", "x" * 81]
)
def test_wrong_run_names(run: str) -> None:
    """Anything that would change the meaning of a key expression is refused; the text shows it."""
    with pytest.raises(TransportError) as caught:
        Keys(run)
    assert (
        str(caught.value)
        == f"run name: expected at most 80 letters, digits, '_', '.', '-', got {run!r}"
    )
