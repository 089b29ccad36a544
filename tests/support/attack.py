"""Attackers with keys of their own choice: sessions that claim to be somebody, and a flood on one's own key."""

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
    """Zenoh's TLS section of somebody with the certificate of a name from a folder, or of nobody.

    Args:
        folder: Of keys; None for no certificate at all.
        name: Whose.
        authority: Whom he believes, by default the folder's own.
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
    """A session that calls all of the endpoints, or fails.

    Args:
        endpoints: Of the processes of a run.
        secure: Zenoh's TLS section, or None.
        timeout_s: How long it tries.
    Raises: zenoh.ZError: one of them does not let it in.
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
    """Say something to whoever else listens, and wait rather than lose it."""
    opened.put(key, data, congestion_control=_BLOCK, allowed_destination=_REMOTE)


def flood(opened: zenoh.Session, keys: Keys, agent: int, rate_hz: float, sort: str) -> int:
    """Send what an agent has said, again and again, until the run's end has been heard; how often.

    Args:
        opened: With the keys of that agent.
        keys: Of the run.
        agent: Which agent.
        rate_hz: Messages per second.
        sort: replayed: the newest plan as it was; renumbered: with a new number; future: of the tick to come, too.
    """
    heard: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    over: queue.SimpleQueue[object] = queue.SimpleQueue()
    key = f"{keys.prefix}/{Plan.kind}/{agent}"
    kept = [
        opened.declare_subscriber(f"{keys.prefix}/{Plan.kind}/*", lambda sample: _own(sample, key, heard)),
        opened.declare_subscriber(f"{keys.prefix}/control", over.put),
    ]
    publisher = opened.declare_publisher(key, congestion_control=_BLOCK, allowed_destination=_REMOTE)
    data, sent, number = heard.get(timeout=60.0), 0, 10**6
    begun_s = time.monotonic()
    while over.empty():
        while not heard.empty():
            data = heard.get()
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


def _own(sample: zenoh.Sample, key: str, heard: queue.SimpleQueue[bytes]) -> None:
    if str(sample.key_expr) == key:
        heard.put(sample.payload.to_bytes())


def main() -> None:
    """A flood as a process: RUN, AGENT, RATE, SORT, FOLDER of keys or `-`, ENDPOINT ..."""
    run, agent, rate, sort, folder, *endpoints = sys.argv[1:]
    secure = None if folder == "-" else tls(Path(folder), f"agent{agent}")
    with session(endpoints, secure, 60.0) as opened:
        sys.stdout.write(f"{flood(opened, Keys(run), int(agent), float(rate), sort)}\n")


if __name__ == "__main__":
    main()
