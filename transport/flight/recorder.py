"""The recorder: an observer on the network that writes every message to the run's log, in a separate thread.

Messages of every tick are written as they came; only their headers are read. Readers of the log check them
(`transport.log.run_log`). Rare messages, which the recorder acts on, are checked here and written if accepted.
"""

import queue
import threading
import time
from collections import deque
from collections.abc import Collection, Iterator
from contextlib import suppress

from protocol.admission.gate import Gate, Sample
from protocol.admission.plausibility import check_plausible, check_tick
from protocol.network.bus import Bus, BusEvent, Interrupted, Left
from protocol.network.endpoints import Endpoints
from protocol.network.session import BusError
from protocol.scenario.links import link_change
from protocol.scenario.setup import Setup
from protocol.scenario.targets import check_target, with_targets
from protocol.wire.codec import Header, decode, encode
from protocol.wire.errors import MessageError
from protocol.wire.keys import RECORDER, Keys
from protocol.wire.messages import (
    BUNDLES,
    KINDS,
    Control,
    FaultNote,
    FaultOrigin,
    LinkChange,
    Message,
    PlantState,
    Presence,
    Record,
    Rejected,
    Relay,
    Request,
    Roster,
    Target,
    Tick,
)
from protocol.wire.names import COORDINATOR
from protocol.wire.node import Outbox, lost
from transport.log.run_log import channel_of
from transport.log.writer import LogWriter

# How many ticks the end of the run may be from the newest tick here: one connection may be slower than another.
_AHEAD = 16

# Kinds of messages that the recorder reads; of the others it reads the header.
_READ = frozenset(kind.kind for kind in (Roster, LinkChange, Target, Control, Rejected, FaultNote))
_UNREAD = {*KINDS, *BUNDLES} - _READ
# Kinds among these that tell of the newest tick, and of the plant's state.
_OF_TICKS, _OF_PLANT = (Tick.kind, Relay.kind), (PlantState.kind, Record.kind)

# Messages of the plant kept to find its newest state in: not every record has one, and one may be garbled.
_KEPT = 4
# Wake-ups cost the run processor time, so messages are gathered in batches; in a paced run for less than a tick.
_GATHER_S, _GATHER_PACED_S = 0.03, 0.01
# The log file is flushed after a pause this long, less than the period of most runs.
_PAUSE_S = 0.02
# After the end of the run the recorder waits for the last message of each process, until none comes for this long.
_TRAIL_S = 2.0
# The same where all that is missing is from processes whose tokens are gone, which may overtake messages.
_QUIET_S = 0.05
# The end of the run may arrive this long after the end of the coordinator's token.
_OVERTAKEN_S = 0.5


class Recorder:
    """Recorder of one run, with its open log; its attributes show the progress."""

    def __init__(
        self,
        setup: Setup,
        run: str,
        writer: LogWriter,
        endpoints: Endpoints,
        join_timeout_s: float,
        incarnation: int = 0,
    ) -> None:
        self.started_s: float | None = None  # steady-clock time of the first plant state
        self.control: Control | None = None  # how the run ended, once it has
        self.error: str | None = None  # why recording ended early
        self.received = 0  # messages in the log
        self.tick = -1  # the newest open one
        self.requests: queue.SimpleQueue[Request] = queue.SimpleQueue()  # to the parent of the run's processes
        self.setup = setup  # with its targets so far
        self._notices: deque[str] = deque()  # the thread that shows them takes from the left
        self._ticks, self._shape = setup.ticks, setup.shape
        self.writer, self._writing = writer, threading.Lock()  # notes come from another thread
        self._keys = Keys(run)
        # Checks the messages that the recorder reads; readers of the log reject others.
        self.gate = Gate(RECORDER, self._keys, self._shape, self._check_moment, _UNREAD)
        self._newest = deque[bytes](maxlen=_KEPT)
        self._join_timeout_s = join_timeout_s
        self._bus = Bus(
            name=RECORDER,
            incarnation=incarnation,
            run=run,
            digest=setup.scenario.digest(),
            endpoints=endpoints,
            gate=self.gate,
            serves=True,
            gather_s=_GATHER_PACED_S if setup.scenario.clock.speed > 0.0 else _GATHER_S,
        )
        self._out = Outbox(RECORDER, incarnation)
        self._thread = threading.Thread(target=self._run, name=RECORDER, daemon=True)
        self._expected: Collection[str] = ()

    @property
    def plant_state(self) -> PlantState | None:
        """The newest state of the plant, or None; decoded when it is asked for, also on another thread."""
        for data in reversed(self._newest.copy()):
            with suppress(MessageError):  # garbled or forged
                message = decode(data)
                for part in message.parts if isinstance(message, Record) else (data,):
                    state = decode(part)
                    if isinstance(state, PlantState):
                        check_plausible(state, self._shape)
                        return state
        return None

    def new_notices(self) -> Iterator[str]:
        """Yield the notices since the last call: roster changes after the start, faults, processes not there yet."""
        while self._notices:
            yield self._notices.popleft()

    def start(self, expected: Collection[str]) -> None:
        """Begin; the expected processes are waited for on the recorder's thread."""
        self._expected = expected
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether the recorder still records."""
        return self._thread.is_alive()

    def stop(self, reason: str) -> None:
        """End the recording before the end of the run."""
        self._bus.interrupt(reason)

    def join(self, timeout_s: float | None = None) -> None:
        """Wait for the end of the recording."""
        self._thread.join(timeout_s)

    def note(self, target: str, what: str, origin: FaultOrigin, tick: int | None = None) -> None:
        """Log a fault of a process at a tick, by default the newest."""
        tick = max(self.tick, 0) if tick is None else tick
        self._take(self._out.stamp(FaultNote, tick=tick, target=target, what=what, origin=origin))

    def close(self) -> None:
        """Leave the network and finish the log."""
        if self._thread.is_alive():
            self.stop("closing")
            self._thread.join()
        self.writer.close()

    def _run(self) -> None:
        try:
            if self._bus.join(self._expected, self._join_timeout_s, self._notices.append) is None:
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
        # Processes that may still send messages, those without a token, and the newest incarnation of each.
        present, gone, newest = set(self._expected), set[str](), dict[str, int]()
        while present or self.control is None:
            timeout_s = None
            if self.control is not None:
                timeout_s = _QUIET_S if present <= gone else _TRAIL_S
            elif COORDINATOR in gone:
                timeout_s = _OVERTAKEN_S
            event = self._next(timeout_s)
            match event:
                case None:
                    break
                case Interrupted():
                    return
                case Left(name=name):
                    present.discard(name)
                case Presence(name=name, incarnation=incarnation, alive=alive):
                    if incarnation >= newest.get(name, 0):
                        newest[name] = incarnation
                        if alive:  # also again, after a standstill of that process or of this one
                            gone.discard(name)
                            present |= {name} & set(self._expected)
                        else:
                            gone.add(name)
                case Request():
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
            event = self._bus.next(_PAUSE_S)
            if event is not None:
                return event
            with self._writing:
                self.writer.flush()
        return self._bus.next(timeout_s)

    def receive(self, message: Message | Sample, at_ns: int | None = None) -> None:
        """Record what arrived from the network at a time, ns since 1970, now by default, unless it is refused."""
        if isinstance(message, Message):
            self._take(message, at_ns)
            return
        # Recorded as it came; progress is that of messages which are in order.
        header = message.header
        self._write(f"/{self._keys.end(message.key)}", message.data, header, at_ns)
        if header.tick >= self._ticks:
            return
        if header.kind in _OF_TICKS:
            self.tick = max(header.tick, self.tick)
        elif header.kind in _OF_PLANT:
            self._newest.append(message.data)
            if self.started_s is None and (header.tick > 0 or header.kind == PlantState.kind):
                self.started_s = time.monotonic()

    def _check_moment(self, message: Message) -> None:
        """Raise MessageError for an end of the run at an impossible tick, and an invalid change of links or target."""
        if isinstance(message, Control) and self.tick >= 0:
            check_tick(message, self.tick - _AHEAD, self.tick + _AHEAD)
        if isinstance(message, LinkChange):
            link_change(message.source, message.target, message.settings)
        if isinstance(message, Target):
            check_target(self.setup, message)

    def _take(self, message: Message, at_ns: int | None = None) -> None:
        self._write(channel_of(message), encode(message), message, at_ns)
        match message:
            case Control():
                self.control = message
            case Target():
                self.setup = with_targets(self.setup, [message])
            case Roster(version=version, reason=reason) if version > 1:
                self._notices.append(f"roster: {reason}")
            case FaultNote():
                self._notices.append(f"fault: {message.target} {message.what}")

    def _write(self, topic: str, data: bytes, header: Header | Message, at_ns: int | None) -> None:
        with self._writing:
            self.writer.add(topic, data, header, time.time_ns() if at_ns is None else at_ns)
        self.received += 1
