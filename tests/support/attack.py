"""Attackers: sessions with chosen certificates, and a flood on the attacker's own key."""

import json
import queue
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import zenoh

from protocol.wire.codec import decode, encode
from protocol.wire.keys import Keys
from protocol.wire.messages import Plan

_REMOTE, _BLOCK = zenoh.Locality.REMOTE, zenoh.CongestionControl.BLOCK


def tls(folder: Path | None, name: str, authority: Path | None = None) -> dict[str, Any]:
    """Return Zenoh's TLS section with the certificate of a name, or without certificate.

    Args:
        folder: Folder of keys; None for no certificate.
        name: Name of the certificate.
        authority: Trusted authority, by default the folder's own.
    """
    if folder is None:
        return {"root_ca_certificate": str(authority)}
    certificate, key = str(folder / f"{name}.pem"), str(folder / f"{name}.key")
    return {
        "root_ca_certificate": str(authority or folder / "ca.pem"),
        "enable_mtls": True,
        "connect_certificate": certificate,
        "connect_private_key": key,
    }


@contextmanager
def session(
    endpoints: Sequence[str], secure: dict[str, Any] | None, timeout_s: float = 10.0
) -> Iterator[zenoh.Session]:
    """Open a session with connections to all endpoints.

    Args:
        endpoints: Endpoints of the processes of a run.
        secure: Zenoh's TLS section, or None.
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
        configuration["transport"] = {"link": {"tls": secure}}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(configuration))) as opened:
        yield opened


def say(opened: zenoh.Session, key: str, data: bytes) -> None:
    """Send data to all other sessions; wait rather than lose it."""
    opened.put(key, data, congestion_control=_BLOCK, allowed_destination=_REMOTE)


def flood(opened: zenoh.Session, keys: Keys, agent: int, rate_hz: float, sort: str) -> int:
    """Repeat an agent's newest plan until the end of the run, and return the number of messages sent.

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
        opened.declare_subscriber(f"{keys.prefix}/{Plan.kind}/*", lambda sample: _own(sample, key, received)),
        opened.declare_subscriber(f"{keys.prefix}/control", over.put),
    ]
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
        for _ in range(due - sent):
            publisher.put(data)
        sent = due
        time.sleep(0.005)
    for subscriber in kept:
        subscriber.undeclare()  # type: ignore[no-untyped-call]
    return sent


def _own(sample: zenoh.Sample, key: str, received: queue.SimpleQueue[bytes]) -> None:
    if str(sample.key_expr) == key:
        received.put(sample.payload.to_bytes())


def main() -> None:
    """Flood in a separate process: RUN, AGENT, RATE, SORT, FOLDER of keys or `-`, ENDPOINT ..."""
    run, agent, rate, sort, folder, *endpoints = sys.argv[1:]
    secure = None if folder == "-" else tls(Path(folder), f"agent{agent}")
    with session(endpoints, secure, 60.0) as opened:
        sys.stdout.write(f"{flood(opened, Keys(run), int(agent), float(rate), sort)}\n")


if __name__ == "__main__":
    main()
