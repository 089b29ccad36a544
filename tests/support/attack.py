"""Attackers: sessions with chosen certificates, and a flood on the attacker's own key."""

import json
import queue
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zenoh
from msgspec.structs import replace

from protocol.wire.codec import decode, encode
from protocol.wire.keys import Keys
from protocol.wire.messages import Answer, Plan, Relay

# Of so many messages of a flood one is an answer to the coordinator, the others are plans to all.
_ANSWERED = 4

_REMOTE, _BLOCK = zenoh.Locality.REMOTE, zenoh.CongestionControl.BLOCK


def tls(folder: Path | None, name: str, authority: Path | None = None) -> dict[str, Any]:
    """Return Zenoh's section `transport` with the certificate of a name, or without certificate.

    Args:
        folder: Folder of keys; None for no certificate.
        name: Name of the certificate.
        authority: Trusted authority, by default the folder's own.
    """
    if folder is None:
        return {"link": {"tls": {"root_ca_certificate": str(authority)}}}
    certificate, key = str(folder / f"{name}.pem"), str(folder / f"{name}.key")
    own = {"enable_mtls": True, "connect_certificate": certificate, "connect_private_key": key}
    return {"link": {"tls": {"root_ca_certificate": str(authority or folder / "ca.pem"), **own}}}


@contextmanager
def session(
    endpoints: Sequence[str], secure: dict[str, Any] | None, timeout_s: float = 10.0
) -> Iterator[zenoh.Session]:
    """Open a session with connections to all endpoints.

    Args:
        endpoints: Endpoints of the processes of a run.
        secure: Zenoh's section `transport`, from `tls` or with a password, or None.
        timeout_s: Timeout of the connections, s.
    Raises: zenoh.ZError: one of them refuses the connection.
    """
    configuration: dict[str, Any] = {
        "mode": "peer",
        "connect": {"endpoints": list(endpoints), "timeout_ms": round(1e3 * timeout_s), "exit_on_failure": True},
        "listen": {"endpoints": []},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    if secure is not None:
        configuration["transport"] = secure
    with zenoh.open(zenoh.Config.from_json5(json.dumps(configuration))) as opened:
        yield opened


def say(opened: zenoh.Session, key: str, data: bytes) -> None:
    """Send data to all other sessions; wait rather than lose it."""
    opened.put(key, data, congestion_control=_BLOCK, allowed_destination=_REMOTE)


def flood(opened: zenoh.Session, keys: Keys, agent: int, rate_hz: float, sort: str) -> int:
    """Repeat an agent's newest plan, alone and in answers, until the end of the run; return the number of messages.

    Args:
        opened: Session with the keys of that agent.
        keys: Keys of the run's messages.
        agent: 1-based.
        rate_hz: Messages per second.
        sort: replayed: unchanged; renumbered: with a new sequence number; future: of the next tick, too.
    """
    received: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    over: queue.SimpleQueue[object] = queue.SimpleQueue()
    key = f"{keys.prefix}/{Plan.kind}/{agent}"
    kept = [
        opened.declare_subscriber(f"{keys.prefix}/{end}", lambda sample: _own(sample, keys, key, received))
        for end in (f"{Plan.kind}/*", Relay.kind)
    ]
    kept.append(opened.declare_subscriber(f"{keys.prefix}/control", over.put))
    answers = opened.declare_publisher(
        f"{keys.prefix}/{Answer.kind}/{agent}", congestion_control=_BLOCK, allowed_destination=_REMOTE
    )
    publisher = opened.declare_publisher(key, congestion_control=_BLOCK, allowed_destination=_REMOTE)
    data, sent, number = received.get(timeout=60.0), 0, 10**6
    begun_s = time.monotonic()
    while over.empty():
        while not received.empty():
            data = received.get()
            if sort != "replayed":
                plan = decode(data)
                assert isinstance(plan, Plan)
                ahead = 1 if sort == "future" else 0
                number += 1
                data = encode(
                    replace(plan, tick=plan.tick + ahead, start_tick=plan.start_tick + ahead, sequence=number)
                )
        due = int((time.monotonic() - begun_s) * rate_hz)
        for number_sent in range(sent, due):
            if number_sent % _ANSWERED == 0:
                answers.put(_answer(data))
            else:
                publisher.put(data)
        sent = due
        time.sleep(0.005)
    for subscriber in kept:
        subscriber.undeclare()  # type: ignore[no-untyped-call]
    return sent


def _own(sample: zenoh.Sample, keys: Keys, key: str, received: queue.SimpleQueue[bytes]) -> None:
    """Keep a plan that travels under a key, alone or in a relay."""
    data = sample.payload.to_bytes()
    if str(sample.key_expr) == key:
        received.put(data)
    elif isinstance(relay := decode(data), Relay):
        for end, part in zip(relay.keys, relay.parts, strict=True):
            if end == keys.end(key):
                received.put(part)


def _answer(data: bytes) -> bytes:
    """Return an answer with a plan."""
    plan = decode(data)
    assert isinstance(plan, Plan)
    return encode(
        Answer(
            sender=plan.sender,
            incarnation=plan.incarnation,
            sequence=plan.sequence,
            tick=plan.tick,
            agent=plan.agent,
            keys=(f"{Plan.kind}/{plan.agent}",),
            parts=(data,),
        )
    )


def main() -> None:
    """Flood in a separate process: RUN, AGENT, RATE, SORT, FOLDER of keys or `-`, ENDPOINT ..."""
    run, agent, rate, sort, folder, *endpoints = sys.argv[1:]
    secure = None if folder == "-" else tls(Path(folder), f"agent{agent}")
    with session(endpoints, secure, 60.0) as opened:
        sys.stdout.write(f"{flood(opened, Keys(run), int(agent), float(rate), sort)}\n")


if __name__ == "__main__":
    main()
