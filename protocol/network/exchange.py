"""How a process's messages travel: each alone to its receivers, or in bundles that the coordinator relays.

In lockstep the coordinator waits for the plans of tick k before it opens tick k + 1, so that it can send them with it.
An agent then has one message to send and two to receive in a tick, whatever the size of the team.
"""

from collections.abc import Callable

from protocol.scenario.setup import Setup
from protocol.wire.codec import encode
from protocol.wire.keys import Keys
from protocol.wire.messages import (
    ActualInputs,
    Answer,
    Bundle,
    Control,
    Event,
    Measurement,
    Message,
    Plan,
    PlantState,
    Record,
    Relay,
    Roster,
    StepReport,
    Tick,
)
from protocol.wire.names import AGENT, COORDINATOR, PLANT, RECORDER
from protocol.wire.node import Outbox

# Sends encoded messages under a key.
Put = Callable[[str, bytes], None]


def exchange_of(setup: Setup, name: str, incarnation: int, keys: Keys, put: Put) -> "Exchange":
    """Return the exchange of a process."""
    if not setup.scenario.clock.relayed or name == RECORDER:
        return Exchange(keys, put)
    return {COORDINATOR: _Coordinator, PLANT: _Plant}.get(name, _Agent)(name, incarnation, keys, put)


class Exchange:
    """Sends the messages of one process; in real time, each alone and at once."""

    def __init__(self, keys: Keys, put: Put) -> None:
        self._keys, self._put = keys, put

    def received(self, event: Event, bundle: Bundle | None) -> None:
        """Note an event that the node has accepted, and the bundle it came in."""

    def send(self, message: Message) -> None:
        """Send a message, or keep it for a bundle."""
        self._put(self._keys.of(message), encode(message))

    def flush(self) -> None:
        """Send the bundle of the messages kept, whatever it waits for: before a process ends."""

    def settle(self) -> None:
        """Send the bundle if it need not wait any longer: when all messages received together are handled."""
        self.flush()


class _Bundled(Exchange):
    """Exchange of a process that sends bundles."""

    def __init__(self, name: str, incarnation: int, keys: Keys, put: Put) -> None:
        super().__init__(keys, put)
        self._out = Outbox(name, incarnation)  # bundles have sequence numbers of their own
        self._kept: list[tuple[str, bytes]] = []  # keys without the prefix of the run, encoded messages
        self._tick = 0  # of the newest message kept

    def _keep(self, message: Message) -> bytes:
        """Keep a message for the next bundle; return its bytes."""
        data = encode(message)
        self._kept.append((self._keys.end(self._keys.of(message)), data))
        self._tick = message.tick
        return data

    def _take(self) -> dict[str, tuple[str, ...] | tuple[bytes, ...]]:
        """Return the messages kept, as fields of a bundle, and forget them."""
        kept, self._kept = self._kept, []
        return {"keys": tuple([key for key, _ in kept]), "parts": tuple([data for _, data in kept])}


class _Agent(_Bundled):
    """Sends plan and report of a tick to the coordinator alone; proposals of a negotiation to all, at once."""

    def send(self, message: Message) -> None:
        if isinstance(message, StepReport) or (isinstance(message, Plan) and message.negotiation == 0):
            if message.incarnation != self._out.incarnation:
                self._out = Outbox(message.sender, message.incarnation)
            self._keep(message)
        else:
            super().send(message)

    def flush(self) -> None:
        if self._kept:
            agent = int(self._out.sender.removeprefix(AGENT))
            super().send(self._out.stamp(Answer, tick=self._tick, agent=agent, **self._take()))


class _Plant(_Bundled):
    """Sends measurements to their agents at once; state and measurements to the record afterwards."""

    def send(self, message: Message) -> None:
        if isinstance(message, Measurement):
            self._put(self._keys.of(message), self._keep(message))
        elif isinstance(message, PlantState | ActualInputs):
            self._keep(message)
        else:
            super().send(message)

    def flush(self) -> None:
        if self._kept:
            super().send(self._out.stamp(Record, tick=self._tick, **self._take()))


class _Coordinator(_Bundled):
    """Relays the answers of a tick with the next one; at once if all are here and no tick follows yet."""

    def __init__(self, name: str, incarnation: int, keys: Keys, put: Put) -> None:
        super().__init__(name, incarnation, keys, put)
        self._answers: dict[int, Answer] = {}  # accepted answers, by agent
        self._awaited: set[int] = set()  # agents that are to answer the open tick

    def received(self, event: Event, bundle: Bundle | None) -> None:
        if isinstance(event, Plan) and isinstance(bundle, Answer):
            self._awaited.discard(event.agent)
            self._answers[event.agent] = bundle

    def send(self, message: Message) -> None:
        if isinstance(message, Tick):
            self._awaited = set(message.members)
            self._relay(message)
            return
        if isinstance(message, Roster):
            self._awaited &= set(message.agents)
        if isinstance(message, Control):
            self.flush()
        super().send(message)

    def flush(self) -> None:
        if self._answers:
            self._relay(None)

    def settle(self) -> None:
        if not self._awaited:
            self.flush()

    def _relay(self, tick: Tick | None) -> None:
        answers = [answer for _, answer in sorted(self._answers.items())]
        self._answers = {}
        self._kept = [entry for answer in answers for entry in zip(answer.keys, answer.parts, strict=True)]
        if tick is not None:
            self._keep(tick)
        else:
            self._tick = answers[-1].tick
        super().send(self._out.stamp(Relay, tick=self._tick, **self._take()))
