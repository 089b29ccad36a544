"""Messages that must be refused.

Made from a seed, from what a receiver has heard and from nothing at all.
"""

import struct
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import msgpack
import numpy as np
from msgspec.structs import replace

from transport.protocol.wire.bundles import Answer, Bundle, Instant, Record, Relay
from transport.protocol.wire.codec import VERSION, decode, encode
from transport.protocol.wire.key_expressions import Keys, matches
from transport.protocol.wire.messages import (
    Measurement,
    Message,
    Plan,
    PlantState,
    Rejected,
    Roster,
    StepReport,
    Tick,
)

T = TypeVar("T")

# Number of delivered messages to choose from.
REMEMBERED = 60

# Replacements for any field: values of every msgpack type, extension types included.
VALUES: list[Any] = [
    None, True, -1, 0.5, float("nan"), float("inf"), 2**48 + 1, 2**63, 2**64 - 1, -(2**63), "", "x" * 2000, "plant2",
    b"", b"\xff" * 9, [], [[]], [None], {}, {"a": {"b": []}}, [1] * 300, [2, 1], [0], msgpack.Timestamp(1, 2),
    msgpack.ExtType(1, b""), msgpack.ExtType(1, struct.pack("<4I", 2, 3, 4, 0)), msgpack.ExtType(9, bytes(24)),
    msgpack.ExtType(1, struct.pack("<4I", 9, 1, 1, 1)), msgpack.ExtType(1, struct.pack("<4Id", 1, 1, 0, 0, 0.0)),
]  # fmt: skip
NOT_FINITE = [np.nan, np.inf, -np.inf]


class UnheardError(LookupError):
    """No message has been delivered that could be changed."""


class Garbage:
    """Generator of bad messages for one receiver.

    Args:
        name: Name of the receiver.
        keys: Keys of the run.
        rng: Random number generator.
        delay: Number of later messages after which all processes have received a message.

    Attributes:
        tick: Newest tick known to all processes.
    """

    def __init__(self, name: str, keys: Keys, rng: np.random.Generator, *, delay: int) -> None:
        self._name, self._keys, self._rng, self._delay = name, keys, rng, delay
        self._coming: deque[tuple[str, bytes]] = deque()  # messages of the run in transit
        self._delivered: deque[tuple[str, bytes]] = deque(maxlen=REMEMBERED)
        self._first: dict[str, bytes] = {}  # first delivered message of each key
        self.tick = 0
        self._sequence = 10**6  # of forged new messages
        self._keys_here = [expression.replace("*", "2") for expression in keys.subscriptions(name)]
        self.sorts: dict[str, Callable[[], tuple[str, bytes]]] = {
            "noise": self._noise,
            "truncated": self._truncated,
            "another version": self._other_version,
            "another kind": self._other_kind,
            "strange fields": self._strange_fields,
            "not finite": self._not_finite,
            "deep": self._deep,
            "replayed": self._replayed,
            "past": self._past,
            "another key": self._other_key,
            "another sender": self._other_sender,
            "absurd": self._absurd,
        }
        self._single = list(self.sorts)
        self.sorts |= {"bad parts": self._bad_parts, "renumbered bundle": self._renumbered_bundle}

    def heard(self, key: str, data: bytes) -> None:
        """Note a message of the run before its delivery, but no notice of refusals.

        A changed one is a valid one.
        """
        if self._keys.end(key).startswith(f"{Rejected.kind}/"):
            return
        self._coming.append((key, data))
        if len(self._coming) > self._delay:
            delivered = self._coming.popleft()
            self._delivered.append(delivered)
            self._first.setdefault(*delivered)
            message = decode(delivered[1])
            self.tick = max(self.tick, message.tick)
            if isinstance(message, Bundle):
                self._delivered.extend(self._opened(message))

    def _opened(self, bundle: Bundle) -> list[tuple[str, bytes]]:
        """Return keys and bytes of the messages of a bundle that are for this receiver."""
        own = self._keys.publications(self._name)
        parts = [
            (f"{self._keys.prefix}/{end}", data)
            for end, data in zip(bundle.keys, bundle.parts, strict=True)
        ]
        hears = self._keys.subscriptions(self._name)
        return [
            part
            for part in parts
            if part[0] not in own and any(matches(one, part[0]) for one in hears)
        ]

    def next(self) -> tuple[str, str, bytes]:
        """Return sort, key and bytes of the next bad message."""
        sort = self._one_of(list(self.sorts))
        try:
            return sort, *self.sorts[sort]()
        except UnheardError:
            return sort, *self._noise()

    def _one_of(self, values: Iterable[T]) -> T:
        choice = list(values)
        return choice[int(self._rng.integers(len(choice)))]

    def _old(self) -> tuple[str, bytes]:
        """Return key and bytes of a delivered message.

        Raises: UnheardError: there is none.
        """
        if not self._delivered:
            raise UnheardError
        return self._one_of(self._first.items() if self._rng.random() < 0.1 else self._delivered)

    def _message(self, *kinds: type[Message]) -> tuple[str, Message]:
        """Return a delivered message of one of the given kinds, or of any kind if none is given.

        Raises: UnheardError: none was found.
        """
        names = {kind.kind for kind in kinds}
        for _ in range(20):
            key, data = self._old()
            if not names or key.split("/")[2] in names:
                return key, decode(data)
        raise UnheardError

    def _new(self, message: Message, **changes: Any) -> Message:
        self._sequence += 1
        return replace(message, sequence=self._sequence, **changes)

    def _wire(self, data: bytes) -> list[Any]:
        wire: list[Any] = msgpack.unpackb(data[1:])
        return wire

    def _packed(self, values: list[Any]) -> bytes:
        body: bytes = msgpack.packb(values)
        return bytes([VERSION]) + body

    def _noise(self) -> tuple[str, bytes]:
        return self._one_of(self._keys_here), self._rng.bytes(int(self._rng.integers(0, 200)))

    def _truncated(self) -> tuple[str, bytes]:
        key, data = self._old()
        return key, data[: int(self._rng.integers(len(data)))]

    def _other_version(self) -> tuple[str, bytes]:
        key, data = self._old()
        return key, bytes([self._one_of([0, VERSION - 1, VERSION + 1, 255])]) + data[1:]

    def _other_kind(self) -> tuple[str, bytes]:
        key, data = self._old()
        return key, self._packed(
            [
                self._one_of(["ticks", "", "PLAN", "plant_state", "tick", "x" * 500]),
                *self._wire(data)[1:],
            ]
        )

    def _strange_fields(self) -> tuple[str, bytes]:
        key, data = self._old()
        values = self._wire(data)
        for _ in range(int(self._rng.integers(1, 4))):
            values[int(self._rng.integers(len(values)))] = self._one_of(VALUES)
        return key, self._packed(values)

    def _not_finite(self) -> tuple[str, bytes]:
        key, message = self._message(Measurement, Plan, PlantState, StepReport)
        values = self._wire(encode(self._new(message, tick=self.tick + 1)))
        arrays = [
            i
            for i, value in enumerate(values)
            if isinstance(value, msgpack.ExtType) and len(value.data) > 16
        ]
        at = self._one_of(arrays)
        data = bytearray(values[at].data)
        place = 16 + 8 * int(self._rng.integers((len(data) - 16) // 8))
        data[place : place + 8] = struct.pack("<d", self._one_of(NOT_FINITE))
        values[at] = msgpack.ExtType(1, bytes(data))
        return key, self._packed(values)

    def _deep(self) -> tuple[str, bytes]:
        key, data = self._old()
        opening, depth = (
            self._one_of([b"\x91", b"\x81\xa1k"]),
            self._one_of([10, 400, 1000, 1030, 5000]),
        )
        values = [msgpack.packb(value) for value in self._wire(data)]
        values[int(self._rng.integers(len(values)))] = opening * depth + b"\xc0"
        return key, bytes([VERSION, 0xDC]) + struct.pack(">H", len(values)) + b"".join(values)

    def _replayed(self) -> tuple[str, bytes]:
        return self._old()

    def _past(self) -> tuple[str, bytes]:
        """Return a message with a new sequence number and a past tick."""
        key, message = self._message(Tick, Measurement, Plan, PlantState, StepReport, Roster)
        return key, encode(self._new(message))

    def _other_key(self) -> tuple[str, bytes]:
        """Return a message under another message's key."""
        key, message = self._message()
        others = [
            other
            for other in [*self._keys_here, f"{key}/2", f"{key}x", f"{self._keys.prefix}/plan/02"]
            if other != key
        ]
        return self._one_of(others), encode(self._new(message, tick=self.tick + 1))

    def _other_sender(self) -> tuple[str, bytes]:
        key, message = self._message()
        names = [
            "coordinator",
            "plant",
            "recorder",
            "agent1",
            "agent2",
            "agent9",
            "agent256",
            self._name,
        ]
        sender = self._one_of([name for name in names if name != message.sender])
        return key, encode(self._new(message, sender=sender, tick=self.tick + 1))

    def _absurd(self) -> tuple[str, bytes]:
        """Return the next expected message with impossible content."""
        key, message = self._message(Tick, Measurement, Plan, PlantState, Roster, StepReport)
        huge = self._one_of([1e7, -1e200, 1.7e308])
        tick = self.tick + int(self._rng.integers(2))
        match message:
            case Tick():
                changes: list[dict[str, Any]] = [{"members": (9,)}, {"answered": (1, 2, 77)}]
            case Roster():
                changes = [
                    {"agents": (1, 9), "incarnations": (1, 1), "version": message.version + 1}
                ]
            case StepReport():
                changes = [{"peers": tuple(range(200, 200 + len(message.peers)))}]
            case PlantState():
                changes = [{"plan_ticks": (0,), "x": np.zeros(24), "u": np.zeros(4)}]
            case Measurement():
                changes = [
                    {"payload": message.payload * 0.0 + huge},
                    {"uav_states": message.uav_states * 0.0},
                    {"uav_states": message.uav_states * 0.0 + huge},
                    {"inputs": message.inputs * 0.0 + huge},
                    {"uavs": tuple(uav + 1 for uav in message.uavs)},
                    {"answered": (1, 200)},
                ]
            case Plan():
                start = tick + message.start_tick - message.tick
                changes = [
                    {"inputs": message.inputs * 0.0 + huge, "start_tick": start},
                    {"inputs": message.inputs + 50.0, "start_tick": start},
                    {"corrections": message.inputs * 0.0 + huge, "start_tick": start},
                    {"uav_states": message.uav_states * 0.0, "start_tick": start},
                    {"uav_states": message.uav_states * 0.0 + huge, "start_tick": start},
                    {"uavs": tuple(uav + 1 for uav in message.uavs), "start_tick": start},
                    {"start_tick": start + 1},
                    {"start_tick": 2**48},
                    {"negotiation": 19, "start_tick": start},
                ]
            case _:
                raise TypeError(message.kind)
        return key, encode(self._new(message, tick=tick, **self._one_of(changes)))

    def _bad_parts(self) -> tuple[str, bytes]:
        """Return a bundle of the next tick with bad messages in it."""
        key, message = self._message(Answer, Relay, Instant, Record)
        bad = [self.sorts[self._one_of(self._single)]() for _ in range(int(self._rng.integers(4)))]
        if isinstance(message, Answer):  # it holds two messages, under different keys
            bad = list(dict(bad).items())[:2]
        ends, parts = [self._keys.end(key)[:80] for key, _ in bad], [data for _, data in bad]
        return key, encode(self._new(message, tick=self.tick + 1, keys=ends, parts=parts))

    def _renumbered_bundle(self) -> tuple[str, bytes]:
        """Return a bundle of the next tick with messages of an old one, some left out, some twice."""
        key, bundle = self._message(Answer, Relay, Instant, Record)
        assert isinstance(bundle, Bundle)
        kept = [
            int(i) for i in self._rng.integers(len(bundle.parts), size=int(self._rng.integers(4)))
        ]
        if isinstance(bundle, Answer):
            kept = sorted(set(kept))  # it cannot have a key twice
        keys, parts = [bundle.keys[i] for i in kept], [bundle.parts[i] for i in kept]
        return key, encode(self._new(bundle, tick=self.tick + 1, keys=keys, parts=parts))
