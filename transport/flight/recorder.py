"""The recorder: an observer on the network that writes every message to the run's log, in a separate thread.

It checks only messages that it acts on; readers of the log check the others.
"""

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Set
from contextlib import suppress

from transport.log.run_log import channel_of
from transport.log.writer import LogWriter
from transport.protocol.admission.gate import Gate, Sample
from transport.protocol.admission.plausibility import check_plausible
from transport.protocol.network.bus import Bus, BusEvent, Interrupted, Left, Place
from transport.protocol.network.session import BusError
from transport.protocol.scenario.setup import Setup
from transport.protocol.scenario.targets import check_target, with_targets
from transport.protocol.wire import messages as wire
from transport.protocol.wire.codec import Header, decode, encode
from transport.protocol.wire.errors import MessageError
from transport.protocol.wire.keys import RECORDER, Keys
from transport.protocol.wire.names import COORDINATOR
from transport.protocol.wire.node import Outbox, lost

# Kinds of messages that the recorder reads; of the others it reads the header.
_READ = (wire.Roster, wire.LinkChange, wire.Target, wire.Control, wire.Rejected)
_UNREAD = {kind for kind, cls in {**wire.KINDS, **wire.BUNDLES}.items() if cls not in _READ}
# Kinds among these that tell of the newest tick, and of the plant's state.
_OF_TICKS, _OF_PLANT = (wire.Tick.kind, wire.Relay.kind), (wire.PlantState.kind, wire.Record.kind)

# Messages of the plant kept to find its newest state in: not every record has one, and one may be
# garbled.
_KEPT = 4
# Wake-ups cost the run processor time, so messages are gathered in batches; in a paced run for less
# than a tick.
_GATHER_S, _GATHER_PACED_S = 0.03, 0.01
_PAUSE_S = (
    0.02  # the log file is flushed after a pause this long, less than the period of most runs
)
# After the end of the run the recorder waits for the last message of each process, until none comes
# for this long; where the tokens of all missing ones are gone; and, once the coordinator's token is
# gone, for the end of the run.
_TRAIL_S, _QUIET_S, _OVERTAKEN_S = 2.0, 0.05, 0.5


class Recorder:
    """Recorder of one run, with its open log; its attributes show the progress."""

    def __init__(
        self,
        setup: Setup,
        place: Place,
        writer: LogWriter,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.started_s: float | None = None  # steady-clock time of the first plant state
        self.control: wire.Control | None = None  # how the run ended, once it has
        self.error: str | None = None  # why recording ended early
        self.received = 0  # messages in the log
        self.tick = -1  # the newest open one
        self.requests: queue.SimpleQueue[wire.Request] = (
            queue.SimpleQueue()
        )  # to the parent of the run's processes
        self.setup = setup  # with its targets so far
        self._say = say  # about roster changes after the start, faults, processes not there yet; on any thread
        self.writer, self._writing = writer, threading.Lock()  # notes come from another thread
        self._keys = Keys(place.run)
        # Checks the messages that the recorder reads; readers of the log reject others.
        self.gate = Gate(RECORDER, self._keys, setup.shape, self._check_moment, _UNREAD)
        self._newest = deque[bytes](maxlen=_KEPT)
        gather_s = _GATHER_PACED_S if setup.scenario.clock.speed > 0.0 else _GATHER_S
        self._bus = Bus(
            RECORDER, place, setup.scenario.digest(), self.gate, serves=True, gather_s=gather_s
        )
        self._out = Outbox(RECORDER, place.incarnation)
        self._thread = threading.Thread(target=self._run, name=RECORDER, daemon=True)
        self._expected: Set[str] = frozenset()

    @property
    def plant_state(self) -> wire.PlantState | None:
        """The newest state of the plant, or None.

        Decoded when it is asked for, also on another thread.
        """
        for data in reversed(self._newest.copy()):
            with suppress(MessageError):  # garbled or forged
                message = decode(data)
                for state in (
                    map(decode, message.parts) if isinstance(message, wire.Record) else [message]
                ):
                    if isinstance(state, wire.PlantState):
                        check_plausible(state, self.setup.shape)
                        return state
        return None

    def start(self, expected: Collection[str]) -> None:
        """Begin: wait for the expected processes, and record, on a thread."""
        self._expected = {*expected}
        self._thread.start()

    def stop(self, reason: str) -> None:
        """End the recording before the end of the run."""
        self._bus.interrupt(reason)

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait for the end of the recording; return whether it still goes on."""
        self._thread.join(timeout_s)
        return self._thread.is_alive()

    def note(
        self, target: str, what: str, origin: wire.FaultOrigin, tick: int | None = None
    ) -> None:
        """Log a fault of a process at a tick, by default the newest."""
        tick = max(self.tick, 0) if tick is None else tick
        self._take(
            self._out.stamp(wire.FaultNote, tick=tick, target=target, what=what, origin=origin)
        )

    def close(self) -> None:
        """Leave the network and finish the log."""
        if self._thread.is_alive():
            self.stop("closing")
            self._thread.join()
        self.writer.close()

    def _run(self) -> None:
        try:
            if self._bus.join(self._expected, self._say) is None:
                self._record()
                for notice in self.gate.notices(self._out.incarnation):
                    self._take(notice)
        except BusError as error:
            self.error = str(error)
        except BaseException as error:  # noqa: BLE001  # such as no memory: the run ends, and the error is told
            self.error = f"{RECORDER}: {type(error).__name__}: {error}".rstrip(": ")
        finally:
            self._bus.close()  # the coordinator waits for this

    def _record(self) -> None:
        left = set[str]()  # processes that have sent their last message
        while self.control is None or not left >= self._expected:
            timeout_s = None
            if self.control is not None:
                timeout_s = (
                    _TRAIL_S if (self._expected - left) & self._bus.alive.keys() else _QUIET_S
                )
            elif COORDINATOR not in self._bus.alive:
                timeout_s = _OVERTAKEN_S
            match event := self._next(timeout_s):
                case None:
                    break
                case Interrupted():
                    return
                case Left(name=name):
                    left.add(name)
                case wire.Presence(
                    name=name, alive=alive
                ):  # also again, after a standstill of that process or of this
                    left -= {name} if alive else set()
                case wire.Request():
                    self.requests.put(event)
                case _:
                    self.receive(event, self._bus.arrived_ns)
            for notice in self.gate.notices(self._out.incarnation, time.monotonic_ns()):
                self._take(notice)
        if self.control is None:  # the coordinator cannot tell the end of the run
            state = self.plant_state
            self._take(lost(self._out, state.tick if state else 0, f"{COORDINATOR} is gone"))

    def _next(self, timeout_s: float | None) -> BusEvent | None:
        """Return the next event, or None after the timeout; flush the log in a pause."""
        if timeout_s is None and not self.writer.is_up_to_date:
            if (event := self._bus.next(_PAUSE_S)) is not None:
                return event
            with self._writing:
                self.writer.flush()
        return self._bus.next(timeout_s)

    def receive(self, message: wire.Message | Sample, at_ns: int | None = None) -> None:
        """Record what arrived from the network at a time, ns since 1970, now by default, unless it is refused."""
        if isinstance(message, wire.Message):
            self._take(message, at_ns)
            return
        # Recorded as it came; progress is that of messages which are in order.
        header = message.header
        key = self._keys.end(message.key)
        self._write(f"/{key}", message.data, header, at_ns)
        if (
            header.tick >= self.setup.ticks or key != header.kind
        ):  # kinds of progress have keys of their own
            return
        if header.kind in _OF_TICKS:
            self.tick = max(header.tick, self.tick)
        elif header.kind in _OF_PLANT:
            self._newest.append(message.data)
            if self.started_s is None and (header.tick > 0 or header.kind == wire.PlantState.kind):
                self.started_s = time.monotonic()

    def _check_moment(self, message: wire.Message) -> None:
        """Raise MessageError for an invalid target."""
        if isinstance(message, wire.Target):
            check_target(self.setup, message)

    def _take(self, message: wire.Message, at_ns: int | None = None) -> None:
        self._write(channel_of(message), encode(message), message, at_ns)
        match message:
            case wire.Control():
                self.control = message
            case wire.Target():
                self.setup = with_targets(self.setup, [message])
            case wire.Roster(version=version, reason=reason) if version > 1:
                self._say(f"roster: {reason}")
            case wire.FaultNote():
                self._say(f"fault: {message.target} {message.what}")

    def _write(
        self, topic: str, data: bytes, header: Header | wire.Message, at_ns: int | None
    ) -> None:
        with self._writing:
            self.writer.add(topic, data, header, time.time_ns() if at_ns is None else at_ns)
        self.received += 1
