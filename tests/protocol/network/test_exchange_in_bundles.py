"""Bundles: in a tick a process sends and receives one message each way, whatever the size of the team."""

from collections.abc import Sequence
from typing import Any

from tests.support import log_messages, runs
from transport.protocol.network.exchange_in_bundles import exchange_of
from transport.protocol.wire.bundles import Answer, Bundle, Relay
from transport.protocol.wire.codec import decode, encode
from transport.protocol.wire.key_expressions import Keys
from transport.protocol.wire.messages import Message
from transport.protocol.wire.outbox import Outbox

RUN = runs.ready("resilient")
KEYS = Keys("run")


def sent_by(
    name: str, *messages: Message, received: Sequence[tuple[Message, Bundle]] = ()
) -> dict[str, list[bytes]]:
    """Return the parts of what a process sends when it has received messages in bundles, by key, each key once."""
    sent: list[tuple[str, bytes]] = []
    exchange = exchange_of(
        RUN.rules.shape,
        name,
        runs.INCARNATION,
        KEYS,
        lambda key, data: sent.append((KEYS.end(key), data)),
    )
    for message, bundle in received:
        exchange.received(message, bundle)
    for message in messages:
        exchange.send(message)
    exchange.settle()
    found: dict[str, list[bytes]] = {}
    for key, data in sent:
        bundle_sent = decode(data)
        assert isinstance(bundle_sent, Bundle)
        assert found.setdefault(key, list(bundle_sent.parts)) == list(bundle_sent.parts), (
            f"{key} is sent twice"
        )
    return found


def ends(messages: Sequence[Message]) -> dict[str, Any]:
    """Return keys and parts of a bundle of messages."""
    return {
        "keys": [KEYS.end(KEYS.of(message)) for message in messages],
        "parts": list(map(encode, messages)),
    }


def test_an_agent_answers_once() -> None:
    """Plan and report of an agent go to the coordinator together."""
    plan, report = (
        runs.plan(RUN, 2, 3),
        log_messages.report(RUN, 2, 3),
    )
    assert sent_by("agent2", plan, report) == {"answer/2": [encode(plan), encode(report)]}


def test_the_plant_sends_one_instant_and_one_record() -> None:
    """All measurements go to all agents with the shared plans of the tick before.

    They are recorded with the state.
    """
    plans = [runs.plan(RUN, agent, 3, shared=agent != 4) for agent in runs.ALL]
    relay = Outbox("coordinator", 0).stamp(Relay, tick=4, **ends(plans))
    measured = [runs.measurement(RUN, agent, 4) for agent in runs.ALL]
    found = sent_by(
        "plant", runs.plant_state(RUN, 3), *measured, received=[(plan, relay) for plan in plans]
    )
    assert found.keys() == {"instant", "record"}
    assert found["instant"] == [encode(message) for message in (*plans[:3], *measured)]
    assert found["record"] == [encode(message) for message in (runs.plant_state(RUN, 3), *measured)]


def test_the_coordinator_relays_the_answers_with_the_next_tick() -> None:
    """Plans and reports of a tick, by agent, and the tick that follows are one message."""
    said = {a: [runs.plan(RUN, a, 3), log_messages.report(RUN, a, 3)] for a in runs.ALL}
    answers = {
        a: Outbox(f"agent{a}", 1).stamp(Answer, tick=3, agent=a, **ends(said[a])) for a in runs.ALL
    }
    found = sent_by(
        "coordinator", runs.tick(4), received=[(said[a][0], answers[a]) for a in (3, 1, 4, 2)]
    )
    assert found == {
        "relay": [*(encode(message) for a in runs.ALL for message in said[a]), encode(runs.tick(4))]
    }


def test_the_coordinator_relays_only_what_an_agent_may_answer() -> None:
    """A tick, or a report of another agent, in an answer reaches no other process."""
    own = runs.plan(RUN, 2, 3)
    report = log_messages.report(RUN, 3, 3)
    forged = runs.tick(4, answered=(2,))
    answer = Outbox("agent2", 1).stamp(Answer, tick=3, agent=2, **ends([own, report, forged]))
    found = sent_by("coordinator", runs.tick(4), received=[(own, answer)])
    assert found == {"relay": [encode(own), encode(runs.tick(4))]}
