"""What a process sends and when: in real time each message alone, in lockstep also bundles.

The coordinator sends the plans of tick k with tick k + 1: an agent sends one message per tick and
receives two.
"""

from collections.abc import Callable, Mapping, Set

from transport.protocol.wire import messages as wire
from transport.protocol.wire.bundles import Answer, Bundle, Instant, Record, Relay
from transport.protocol.wire.codec import encode
from transport.protocol.wire.key_expressions import Keys
from transport.protocol.wire.names import AGENT, COORDINATOR, PLANT
from transport.protocol.wire.node_interface import RunShape
from transport.protocol.wire.outbox import Outbox

Put = Callable[[str, bytes], None]  # sends an encoded message under a key
Entry = tuple[str, bytes]  # key without the prefix of the run, encoded message


def exchange_of(shape: RunShape, name: str, incarnation: int, keys: Keys, put: Put) -> "Exchange":
    """Return the exchange of a process, in a run whose messages have a shape."""
    if not shape.relayed:
        return Exchange(name, incarnation, keys, put)
    by_name = {COORDINATOR: _CoordinatorExchange, PLANT: _PlantExchange}
    kind = by_name.get(name, _AgentExchange)
    return kind(name, incarnation, keys, put)


class Exchange:
    """Sends the messages of one process, each alone and at once."""

    bundled: tuple[type[wire.Message], ...] = ()  # kinds of messages that are kept for a bundle

    def __init__(self, name: str, incarnation: int, keys: Keys, put: Put) -> None:
        self._keys = keys
        self._put = put
        self._out = Outbox(name, incarnation)  # bundles have sequence numbers of their own
        self._kept: list[Entry] = []
        self._tick = 0  # of the newest message kept

    def received(self, event: wire.Event, bundle: Bundle | None) -> None:
        """Note an event that the node has accepted, and the bundle it came in."""

    def send(self, message: wire.Message) -> None:
        """Send a message, or keep it for a bundle; proposals of a negotiation are sent at once."""
        key = self._keys.of(message)
        data = encode(message)
        is_proposal = bool(getattr(message, "negotiation", 0))
        if is_proposal or not isinstance(message, self.bundled):
            self._put(key, data)
            return

        if message.incarnation != self._out.incarnation:
            self._out = Outbox(message.sender, message.incarnation)
        self._kept.append((self._keys.end(key), data))
        self._tick = message.tick

    def flush(self) -> None:
        """Send the bundle of the messages kept, whatever it waits for: before a process ends."""

    def settle(self) -> None:
        """Send the bundle if it need not wait: all messages received together are handled."""
        self.flush()

    def _send_bundle(self, kind: type[Bundle], entries: list[Entry], **fields: int) -> None:
        """Send entries in a bundle, if there are any; forget the messages kept."""
        self._kept = []
        if entries:
            keys, parts = zip(*entries, strict=True)
            bundle = self._out.stamp(kind, tick=self._tick, keys=keys, parts=parts, **fields)
            self._put(self._keys.of(bundle), encode(bundle))


class _AgentExchange(Exchange):
    """Sends plan and report of a tick to the coordinator alone."""

    bundled = (wire.Plan, wire.StepReport)

    def flush(self) -> None:
        agent = int(self._out.sender.removeprefix(AGENT))
        self._send_bundle(Answer, self._kept, agent=agent)


class _PlantExchange(Exchange):
    """Sends measurements and relayed plans to the agents, then its state to the record."""

    bundled = (wire.Measurement, wire.PlantState, wire.ActualInputs)

    # Accepted plans, and reports of the radio, for the agents since the last measurement.
    _shared: tuple[Entry, ...] = ()

    def received(self, event: wire.Event, bundle: Bundle | None) -> None:
        if bundle is None or not isinstance(event, wire.Plan | wire.Airtime):
            return
        if isinstance(event, wire.Airtime) or event.shared:
            key = self._keys.end(self._keys.of(event))
            part = bundle.parts[bundle.keys.index(key)]
            self._shared = (*self._shared, (key, part))

    def flush(self) -> None:
        recorded = self._kept
        measured = [entry for entry in recorded if entry[0].startswith(wire.Measurement.kind)]
        if measured:
            self._send_bundle(Instant, [*self._shared, *measured])
            self._shared = ()
        self._send_bundle(Record, recorded)


class _CoordinatorExchange(Exchange):
    """Relays the answers of a tick with the next one; at once if all are here before it opens."""

    bundled = (wire.Airtime, wire.Tick)

    _answers: Mapping[int, Answer] = {}  # accepted answers, by agent
    _awaited: Set[int] = frozenset()  # agents that are to answer the open tick

    def received(self, event: wire.Event, bundle: Bundle | None) -> None:
        if isinstance(event, wire.Plan) and isinstance(bundle, Answer):
            self._awaited -= {event.agent}
            self._answers = {**self._answers, event.agent: bundle}
            self._tick = bundle.tick

    def send(self, message: wire.Message) -> None:
        if isinstance(message, wire.Roster):
            self._awaited &= set(message.agents)
        if isinstance(message, wire.Control):
            self.flush()
        super().send(message)
        if isinstance(message, wire.Tick):
            self._awaited = set(message.members)
            self.flush()

    def flush(self) -> None:
        entries: list[Entry] = []
        for _, answer in sorted(self._answers.items()):
            for key, part in zip(answer.keys, answer.parts, strict=True):
                # A relay may carry more than an answer, such as a tick: no agent may send one.
                if answer.may_carry(key):
                    entries.append((key, part))
        self._answers = {}
        self._send_bundle(Relay, [*entries, *self._kept])

    def settle(self) -> None:
        if not self._awaited:
            self.flush()
