"""The attacker: sessions with chosen keys that hear a run, repeat messages, and send bad ones."""

import csv
import json
import queue
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zenoh

from protocol.wire.codec import decode
from protocol.wire.keys import Keys, matches
from protocol.wire.messages import Bundle, MessageError, Plan
from tests.support.garbage import Garbage
from transport.analysis.steps import WALL_CLOCK

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
        self._subscribers = [session.declare_subscriber(key, self._inbox.put) for key in expressions]

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
    keys: Keys, endpoints: Sequence[str], secure: dict[str, Any] | None = None, hears: Sequence[str] = ()
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
    burst: int,
    pause_s: float,
    timeout_s: float,
) -> Iterator[tuple[str, str, bytes]]:
    """Send bad messages to a run, and yield sort, key and bytes of each.

    Args:
        mesh: Session with connections to all processes.
        source: Generator of the messages.
        process: The run; its end ends the attack.
        awaited: Keys under which messages must have come before the first shot: they prove the connections.
        shots: Number of messages.
        until_tick: Tick of the run that ends the attack.
        burst: Number of messages at a time.
        pause_s: Time between bursts, s.
        timeout_s: Time that ends the attack, s.
    """
    sent, known, until = 0, set[str](), time.monotonic() + timeout_s
    while source.tick < until_tick and time.monotonic() < until and process.poll() is None and sent < shots:
        for key, data in mesh.heard():
            source.heard(key, data)
            known.add(key)
        if source.tick < 1 or not awaited <= known:
            time.sleep(0.01)
            continue
        for _ in range(min(burst, shots - sent)):
            sort, key, data = source.next()
            mesh.put(key, data)
            sent += 1
            yield sort, key, data
        time.sleep(pause_s)


class Deliveries:
    """Counts of bad messages by the processes that they reach.

    Args:
        keys: Keys of the run.
        names: Processes that the intruder is connected to.
        relayed: Whether plans are relayed.
        may_send: Key expressions that the intruder has the right to; all by default.

    Attributes:
        single: Messages at each process that it counts as one refusal.
        bundles: Bundles at each process, of which it counts every message by itself, if it reads them.
    """

    # Messages in a bundle: plan and report of four agents, and a tick.
    MOST_PARTS = 9

    def __init__(
        self, keys: Keys, names: Sequence[str], *, relayed: bool, may_send: Sequence[str] | None = None
    ) -> None:
        self.single, self.bundles = dict.fromkeys(names, 0), dict.fromkeys(names, 0)
        self._hears = {name: keys.subscriptions(name, relayed=relayed) for name in names}
        self._may_send = may_send
        self._reached: dict[str, list[str]] = {}  # processes, by key

    @property
    def total(self) -> int:
        """All messages, each counted once for every process it reached."""
        return sum(self.single.values()) + sum(self.bundles.values())

    def add(self, key: str, data: bytes) -> None:
        """Count a message that was sent."""
        if key not in self._reached:
            passes = self._may_send is None or any(matches(expression, key) for expression in self._may_send)
            self._reached[key] = [
                name
                for name, expressions in self._hears.items()
                if passes and any(matches(expression, key) for expression in expressions)
            ]
        counts = self.bundles if self._reached[key] and _is_bundle(data) else self.single
        for name in self._reached[key]:
            counts[name] += 1

    def accepted(self, refused: Mapping[str, int]) -> dict[str, tuple[int, int, int]]:
        """Return the processes that have not counted every message as refused, or more than they received.

        Args:
            refused: Refusals that each process counted.
        Returns: Refusals counted, single messages and bundles received, of these processes.
        """
        return {
            name: (refused[name], single, self.bundles[name])
            for name, single in self.single.items()
            if not 0 <= refused[name] - single <= self.MOST_PARTS * self.bundles[name]
        }


def _is_bundle(data: bytes) -> bool:
    """Return whether bytes can be read as a bundle."""
    try:
        return isinstance(decode(data), Bundle)
    except MessageError:
        return False


def proofs_of_connection(keys: Keys, agents: Sequence[int], *, relayed: bool) -> set[str]:
    """Return keys of messages that coordinator, plant and every agent publish at every tick."""
    ends = ("relay", "record") if relayed else ("tick", "plant_state")
    each = "answer" if relayed else "plan"
    return {f"{keys.prefix}/{end}" for end in (*ends, *(f"{each}/{agent}" for agent in agents))}


def table(folder: Path) -> list[dict[str, str]]:
    """Return the step table without its wall-clock columns."""
    with (folder / "steps.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    return [{name: value for name, value in row.items() if not name.endswith(WALL_CLOCK)} for row in rows]


def main() -> None:
    """Repeat messages in a separate process: RUN, AGENT, RATE, FOLDER of keys, ENDPOINT ..."""
    run, agent, rate, folder, *endpoints = sys.argv[1:]
    with session(endpoints, tls(Path(folder), f"agent{agent}"), 60.0) as opened:
        sys.stdout.write(f"{repeat(opened, Keys(run), int(agent), float(rate))}\n")


if __name__ == "__main__":
    main()
