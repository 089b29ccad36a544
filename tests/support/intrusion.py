"""Intruders in a run with processes: sessions that hear all messages and send bad ones."""

import csv
import json
import queue
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zenoh

from protocol.wire.codec import decode
from protocol.wire.keys import Keys, matches
from protocol.wire.messages import Bundle, MessageError
from tests.support.garbage import Garbage
from transport.analysis.steps import WALL_CLOCK


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
        remote, block = zenoh.Locality.REMOTE, zenoh.CongestionControl.BLOCK
        self.session.put(key, data, congestion_control=block, allowed_destination=remote)


@contextmanager
def intruding(
    keys: Keys, endpoints: Sequence[str], secure: dict[str, Any] | None = None, hears: Sequence[str] = ()
) -> Iterator[Mesh]:
    """Connect to every process of a run like an observer, with Zenoh's section `transport` if it needs one."""
    configuration = {
        "mode": "peer",
        "connect": {
            "endpoints": list(endpoints),
            "timeout_ms": -1,
            "retry": {"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 1.5},
        },
        "listen": {"endpoints": []},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    if secure is not None:
        configuration["transport"] = secure
    with zenoh.open(zenoh.Config.from_json5(json.dumps(configuration))) as session:
        yield Mesh(session, keys, hears)


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
