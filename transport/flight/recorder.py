"""Recorder: an observer on the network that writes every message to the run's log, in a thread.

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
from transport.protocol.admission.acceptance_and_refusals import Gate, Sample
from transport.protocol.admission.participant import check_target
from transport.protocol.admission.plausibility import check_plausible
from transport.protocol.network.bus import Bus
from transport.protocol.network.bus_events_and_clock import (
    Arrival,
    BusOptions,
    Departed,
    Interrupted,
    Place,
    SteadyClock,
)
from transport.protocol.network.session import BusError
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire import messages as wire
from transport.protocol.wire.bundles import BUNDLES, Record, Relay
from transport.protocol.wire.codec import Header, decode, encode
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.key_expressions import RECORDER, Keys
from transport.protocol.wire.names import COORDINATOR, agent_name
from transport.protocol.wire.outbox import Outbox, end_without_coordinator

# Kinds of messages that the recorder reads; of the others it reads the header. One that is read is
# recorded if it passes the gate, the others as they came.
_READ = (wire.Roster, wire.LinkChange, wire.Target, wire.Control, wire.Rejected)
_UNREAD = {kind for kind, cls in {**wire.KINDS, **BUNDLES}.items() if cls not in _READ}
# Kinds among the unread ones that tell of the newest tick, and of the plant's state.
_TELL_TICK = (wire.Tick.kind, Relay.kind)
_TELL_STATE = (wire.PlantState.kind, Record.kind)

# Messages of the plant kept to find its newest state in: not every record has one, and one may be
# garbled.
_KEPT = 4
# Times for which messages are gathered into a batch, s: wake-ups cost the run processor time. In a
# paced run less than a tick.
_GATHER_S = 0.03
_GATHER_PACED_S = 0.01
# Pause after which the log file is flushed, s: less than the period of most runs.
_PAUSE_S = 0.02
# After the end of the run the recorder waits for the last message of each process: until none comes
# for the trail time, or for the quiet time where the tokens of all missing processes are gone.
_TRAIL_S = 2.0
_QUIET_S = 0.05
# Time to wait for the end of the run once the coordinator's token is gone, s.
_OVERTAKEN_S = 0.5


class Recorder:
    """Recorder of one run, with its open log; its attributes show the progress.

    Attributes:
        writer: The log.
        setup: The run, with its targets so far.
        started_s: Monotonic time of the first plant state, or without a plant of the first tick, None before.
        control: End of the run, None before.
        error: Why recording ended early, None if it did not.
        received: Number of messages in the log.
        tick: The newest open tick, -1 before the first.
        members: Names of the agents on the newest roster.
        requests: Requests to the parent of the run's processes.
        gate: Checks of the messages that the recorder reads; readers of the log check the others.
    """

    def __init__(
        self,
        setup: Setup,
        place: Place,
        writer: LogWriter,
        say: Callable[[str], None] = lambda _: None,
        is_starting: Callable[[str], bool] = lambda _: False,
        bus_of: Callable[..., Bus] = Bus,
    ) -> None:
        """Connect to a run, and show its processes that the recorder is there.

        Args:
            setup: The run.
            place: Place of the recorder in its network.
            writer: The open log.
            say: Told of roster changes after the start, faults, and processes not there yet, on any
                thread.
            is_starting: Whether a process that has not joined in time is on its way, by name.
            bus_of: Constructor of the connection.
        """
        self.writer = writer
        self.setup = setup
        self.started_s: float | None = None
        self.control: wire.Control | None = None
        self.error: str | None = None
        self.received = 0
        self.tick = -1
        self.members: Set[str] = frozenset()
        self.requests: queue.SimpleQueue[wire.Request] = queue.SimpleQueue()
        self._keys = Keys(place.run)
        self.gate = Gate(RECORDER, self._keys, setup.rules.shape, self._check_moment, _UNREAD)

        self._say = say
        self._writing = threading.Lock()  # notes come from another thread
        self._plant_messages = deque[bytes](maxlen=_KEPT)
        gather_s = _GATHER_PACED_S if setup.scenario.clock.speed > 0.0 else _GATHER_S
        options = BusOptions(serves=True, gather_s=gather_s)
        self._is_starting = is_starting
        self._bus = bus_of(RECORDER, place, setup.rules.digest, self.gate, options)
        # The recorder begins when the viewer of the run is ready: the coordinator sees it before.
        self._bus.announce()
        self._clock = SteadyClock()
        self._out = Outbox(RECORDER, place.incarnation)
        self._thread = threading.Thread(target=self._run, name=RECORDER, daemon=True)
        self._expected: Set[str] = frozenset()
        self._goes_on = setup.scenario.clock.on_coordinator_loss == "continue"

    @property
    def plant_state(self) -> wire.PlantState | None:
        """The newest state of the plant, or None.

        Decoded when it is asked for, also on another thread.
        """
        for data in reversed(self._plant_messages.copy()):
            with suppress(MessageError):  # garbled or forged
                message = decode(data)
                parts = [message]
                if isinstance(message, Record):
                    parts = [decode(part) for part in message.parts]
                for part in parts:
                    if isinstance(part, wire.PlantState):
                        check_plausible(part, self.setup.rules.shape)
                        return part
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
        """Join the run and record it; an error ends the recording and is kept."""
        try:
            interruption = self._bus.join(self._expected, self._say, self._is_starting)
            if interruption is None:
                self._record()
                for notice in self.gate.notices(self._out.incarnation):
                    self._take(notice)
        except BusError as error:
            self.error = str(error)
        # Such as no memory: the run ends, and the error is told.
        except BaseException as error:  # noqa: BLE001
            self.error = f"{RECORDER}: {type(error).__name__}: {error}".rstrip(": ")
        finally:
            self._bus.close()  # the coordinator waits for this

    def _record(self) -> None:
        """Record until the run has ended and its processes have sent their last messages."""
        departed = set[str]()  # processes that have sent their last message
        while self.control is None or not departed >= self._expected:
            arrival = self._next(self._timeout_s(departed))
            if arrival is None:
                break
            event = arrival.event
            match event:
                case Interrupted():
                    return
                case Departed(name=name):
                    departed.add(name)
                case wire.Presence(name=name, alive=True):
                    # Also again, after a standstill of that process or of this one.
                    departed.discard(name)
                case wire.Presence():
                    pass
                case wire.Request():
                    self.requests.put(event)
                case _:
                    self.receive(event, arrival.arrived_ns)

            for notice in self.gate.notices(self._out.incarnation, time.monotonic_ns()):
                self._take(notice)

        if self.control is None:  # the coordinator cannot tell the end of the run
            state = self.plant_state
            self._take(
                end_without_coordinator(
                    self._out, state.tick if state else 0, f"{COORDINATOR} is gone"
                )
            )

    def _timeout_s(self, departed: Set[str]) -> float | None:
        """Return how long to wait for the next event, given the processes that have departed.

        None: for ever.
        """
        if self.control is None:
            is_over = self.tick >= self.setup.ticks - 1
            is_led = COORDINATOR in self._bus.alive or (self._goes_on and not is_over)
            return None if is_led else _OVERTAKEN_S

        missing = self._expected - departed
        return _TRAIL_S if missing & self._bus.alive.keys() else _QUIET_S

    def _next(self, timeout_s: float | None) -> Arrival | None:
        """Return the next event, or None after the timeout; flush the log in a pause."""
        if timeout_s is not None or self.writer.is_up_to_date:
            return self._bus.next(timeout_s)

        arrival = self._bus.next(_PAUSE_S)
        if arrival is not None:
            return arrival
        with self._writing:
            self.writer.flush()
        return self._bus.next(timeout_s)

    def receive(self, message: wire.Message | Sample, at_ns: int | None = None) -> None:
        """Record a message that the gate has let pass.

        It arrived at a time, ns since 1970; without one it arrived now.
        """
        if isinstance(message, wire.Message):
            self._take(message, at_ns)
            return

        # The gate has read the header alone, so the message is recorded as it came.
        header = message.header
        key = self._keys.end(message.key)
        self._write(f"/{key}", message.data, header, at_ns)

        # Kinds that tell the progress have keys of their own. A message whose key belongs to another
        # kind is recorded too, but is no progress: it may be forged.
        if self._goes_on and header.kind in (*_TELL_STATE, wire.VehicleStatus.kind):
            # Without a coordinator these tell the newest tick.
            self.tick = max(self.tick, min(header.tick, self.setup.ticks - 1))
        is_progress = header.tick < self.setup.ticks and key == header.kind
        if is_progress:
            self._show_progress(message.data, header)

    def _show_progress(self, data: bytes, header: Header) -> None:
        """Take note of the newest tick and of the messages of the plant."""
        if header.kind in _TELL_TICK:
            self.tick = max(header.tick, self.tick)
            if self.started_s is None and not self.setup.rules.has_plant:
                self.started_s = time.monotonic()

        if header.kind in _TELL_STATE:
            self._plant_messages.append(data)
            # A record of tick 0 may come before the first state.
            has_state = header.tick > 0 or header.kind == wire.PlantState.kind
            if self.started_s is None and has_state:
                self.started_s = time.monotonic()

    def _check_moment(self, message: wire.Message) -> None:
        """Raise MessageError for an invalid target."""
        if isinstance(message, wire.Target):
            check_target(len(self.setup.maneuver.targets), message)

    def _take(self, message: wire.Message, at_ns: int | None = None) -> None:
        """Log a message and act on it."""
        self._write(channel_of(message), encode(message), message, at_ns)
        match message:
            case wire.Control():
                self.control = message
            case wire.Target():
                self.setup = self.setup.after([message])
            case wire.Roster():
                self.members = frozenset(map(agent_name, message.agents))
                if message.version > 1:
                    self._say(f"roster: {message.reason}")
            case wire.FaultNote():
                self._say(f"fault: {message.target} {message.what}")

    def _write(
        self, topic: str, data: bytes, header: Header | wire.Message, at_ns: int | None
    ) -> None:
        """Append the bytes of a message to the log, on any thread."""
        with self._writing:
            self.writer.add(topic, data, header, self._clock.now_ns() if at_ns is None else at_ns)
            self.received += 1
