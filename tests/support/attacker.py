"""The attacker: sessions with chosen keys that hear a run, repeat messages, and send bad ones."""

import csv
import json
import queue
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zenoh

from tests.support.garbage import Garbage
from transport.analysis.steps import WALL_CLOCK
from transport.protocol.wire.bundles import Bundle
from transport.protocol.wire.codec import decode
from transport.protocol.wire.key_expressions import Keys
from transport.protocol.wire.messages import Plan

# Messages at a time, and time between, s: below the rate at which receivers slow a sender down for
# good.
BURST, PAUSE_S = 200, 0.01

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
    endpoints: Sequence[str], secure: dict[str, Any] | None, timeout_s: float | None = 10.0
) -> Iterator[zenoh.Session]:
    """Open a session with connections to all endpoints.

    Args:
        endpoints: Endpoints of the processes of a run.
        secure: Zenoh's section `transport`, from `tls` or with a password, or None.
        timeout_s: Timeout of the connections, s; None to go on trying in the background.
    Raises: zenoh.ZError: one of them refuses the connection.
    """
    connect: dict[str, Any] = {"endpoints": list(endpoints)}
    if timeout_s is not None:
        connect |= {"timeout_ms": round(1e3 * timeout_s), "exit_on_failure": True}
    else:
        retry = {"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 1.5}
        connect |= {"timeout_ms": -1, "retry": retry}
    configuration: dict[str, Any] = {
        "mode": "peer",
        "connect": connect,
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


def repeat(opened: zenoh.Session, keys: Keys, agent: int, rate_hz: float) -> int:
    """Repeat an agent's newest answer until the end of the run; return the number of messages.

    Args:
        opened: Session with the keys of that agent.
        keys: Keys of the run's messages.
        agent: 1-based.
        rate_hz: Messages per second.
    """
    heard: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    over: queue.SimpleQueue[object] = queue.SimpleQueue()
    plan = f"{keys.prefix}/{Plan.kind}/{agent}"
    kept = [
        opened.declare_subscriber(f"{keys.prefix}/instant", heard.put),
        opened.declare_subscriber(f"{keys.prefix}/control", over.put),
    ]
    data, sent, begun_s = _plan_in(heard.get(timeout=60.0), keys.end(plan)), 0, time.monotonic()
    while over.empty():
        while not heard.empty():
            data = _plan_in(heard.get(), keys.end(plan)) or data
        due = int((time.monotonic() - begun_s) * rate_hz)
        for _ in range(sent, due if data else sent):
            say(opened, plan, data)
        sent = due
        time.sleep(0.005)
    for subscriber in kept:
        subscriber.undeclare()  # type: ignore[no-untyped-call]
    return sent


def _plan_in(sample: zenoh.Sample, end: str) -> bytes:
    """Return the plan under a key in an instant, or nothing."""
    instant = decode(sample.payload.to_bytes())
    assert isinstance(instant, Bundle)
    return dict(zip(instant.keys, instant.parts, strict=True)).get(end, b"")


class Mesh:
    """A session with connections to every process of a run, and the messages it receives.

    Args:
        session: Session with connections to all processes.
        keys: Keys of the run.
        hears: Key expressions to subscribe to; all of the run by default.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, hears: Sequence[str] = ()) -> None:
        self.session, self.keys = session, keys
        self._inbox: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        expressions = hears or [f"{keys.prefix}/**"]
        self._subscribers = [
            session.declare_subscriber(key, self._inbox.put) for key in expressions
        ]

    def heard(self) -> Iterator[tuple[str, bytes]]:
        """Return keys and bytes of the messages received since the last call."""
        while not self._inbox.empty():
            sample = self._inbox.get()
            yield str(sample.key_expr), sample.payload.to_bytes()

    def put(self, key: str, data: bytes) -> None:
        """Send bytes to all subscribers of a key; wait rather than lose them."""
        say(self.session, key, data)


@contextmanager
def intruding(
    keys: Keys,
    endpoints: Sequence[str],
    secure: dict[str, Any] | None = None,
    hears: Sequence[str] = (),
) -> Iterator[Mesh]:
    """Connect to every process of a run like an observer, with Zenoh's section `transport` if it needs one."""
    with session(endpoints, secure, None) as opened:
        yield Mesh(opened, keys, hears)


def bombard(
    mesh: Mesh,
    source: Garbage,
    process: "subprocess.Popen[str]",
    awaited: set[str],
    *,
    shots: int,
    until_tick: int,
) -> Iterator[str]:
    """Send bad messages to a run until a tick, or its end, and yield the sort of each.

    Args:
        mesh: Session with connections to all processes.
        source: Generator of the messages.
        process: The run.
        awaited: Keys under which messages must have come before the first shot: they prove the
            connections.
        shots: Number of messages at most.
        until_tick: Tick of the run that ends the attack.
    """
    sent, known = 0, set[str]()
    while source.tick < until_tick and process.poll() is None and sent < shots:
        for key, data in mesh.heard():
            source.heard(key, data)
            known.add(key)
        if source.tick >= 1 and awaited <= known:
            for _ in range(min(BURST, shots - sent)):
                sort, key, data = source.next()
                mesh.put(key, data)
                sent += 1
                yield sort
        time.sleep(PAUSE_S)


def proofs_of_connection(keys: Keys, agents: Sequence[int]) -> set[str]:
    """Return keys of messages that coordinator, plant and every agent publish at every tick."""
    return {
        f"{keys.prefix}/{end}"
        for end in ("relay", "record", *(f"answer/{agent}" for agent in agents))
    }


def table(folder: Path) -> list[dict[str, str]]:
    """Return the step table without its wall-clock columns."""
    with (folder / "steps.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    return [
        {name: value for name, value in row.items() if not name.endswith(WALL_CLOCK)}
        for row in rows
    ]


def main() -> None:
    """Repeat messages in a separate process: RUN, AGENT, RATE, FOLDER of keys, ENDPOINT ..."""
    run, agent, rate, folder, *endpoints = sys.argv[1:]
    with session(endpoints, tls(Path(folder), f"agent{agent}"), 60.0) as opened:
        sys.stdout.write(f"{repeat(opened, Keys(run), int(agent), float(rate))}\n")


if __name__ == "__main__":
    main()
