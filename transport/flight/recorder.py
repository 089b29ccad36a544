"""The recorder: an observer on the network that writes every message to the run's log.

It runs on a thread of its own and always drains its inbox; the loop never waits for the disk.
"""

import queue
import threading
import time
from collections.abc import Callable, Collection

from protocol.admission.admission import Admission
from protocol.admission.plausibility import check_moment
from protocol.admission.reception import Reception
from protocol.network.bus import Bus, BusEvent, Interrupted
from protocol.network.endpoints import Endpoints
from protocol.network.health import give_back_memory
from protocol.network.session import BusError
from protocol.scenario.links import told_change
from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_UNREACHABLE
from protocol.wire.keys import RECORDER, Keys
from protocol.wire.messages import (
    Control,
    FaultNote,
    FaultOrigin,
    LinkChange,
    Message,
    PlantState,
    Presence,
    Request,
    Roster,
    Tick,
)
from protocol.wire.outbox import Outbox
from transport.log.gaps import END_NOT_RECORDED
from transport.log.run_log import LogError, LogWriter

# Why a run is over that nobody is left to end: what the recorder says of it.
_GONE = "coordinator is gone"

# Nobody waits for the recorder, and every time it wakes up costs those that fly: the more the faster they go. At the
# pace of the clock it wakes up in time for who watches to see a tick before the next.
_GATHER_S, _GATHER_PACED_S = 0.03, 0.01
# What comes is in the file, for who watches, when nothing more has come for so long: less than the period of most runs.
_PAUSE_S = 0.02
# What came while this process stood still took room, which is given back in such a pause, not more often than this.
_TIDY_S = 5.0
# How long messages may trail the end of the run on their way here.
_TRAIL_S = 2.0
# How long nothing must come before the record counts as complete, once everybody but the coordinator has left.
_QUIET_S = 0.05
# How long the news of the end may come after that of the coordinator's leaving.
_OVERTAKEN_S = 0.5


class Recorder:
    """Records one run; what people watch meanwhile is in its attributes.

    Attributes:
        plant_state: The newest state of the plant, or None.
        started_s: Steady-clock time of the first truth, or None.
        control: How the run ended, once it has.
        notices: Roster changes after the start, for people.
        error: Why recording ended early, or None.
        received: How many messages are in the log.
        tick: The newest open tick, -1 before the first.
        requests: What people have asked of whoever runs this run's processes.
        rejected: What was refused here.
        admission: What is let in.

    Args:
        setup: The run.
        run: Name of the run.
        writer: Open log.
        endpoints: Whom to connect to.
        join_timeout_s: How long to wait for the processes.
        incarnation: Which start of the recorder.
        has_ended: Whether the coordinator, once nothing more is heard of it, is known to have ended in order.
    """

    def __init__(
        self,
        setup: Setup,
        run: str,
        writer: LogWriter,
        endpoints: Endpoints,
        join_timeout_s: float,
        incarnation: int = 0,
        has_ended: Callable[[], bool] = lambda: False,
    ) -> None:
        self.plant_state: PlantState | None = None
        self.started_s: float | None = None
        self.control: Control | None = None
        self.notices: list[str] = []
        self.error: str | None = None
        self.received = 0
        self.tick = -1
        self.requests: queue.SimpleQueue[Request] = queue.SimpleQueue()
        self._reception = Reception(setup, self._handle)
        self.rejected = self._reception.rejected
        self._samples_s = setup.samples_s
        self.admission = Admission(RECORDER, Keys(run), setup, self.rejected)
        self._writer = writer
        self._join_timeout_s = join_timeout_s
        self._has_ended = has_ended
        self._bus = Bus(
            name=RECORDER,
            incarnation=incarnation,
            run=run,
            digest=setup.scenario.digest(),
            endpoints=endpoints,
            admission=self.admission,
            serves=True,
            gather_s=_GATHER_PACED_S if setup.scenario.clock.speed > 0.0 else _GATHER_S,
        )
        self._out = Outbox(RECORDER, incarnation)
        self._writing = threading.Lock()  # notes come from another thread
        self._thread = threading.Thread(target=self._run, name=RECORDER, daemon=True)
        self._expected: Collection[str] = ()
        self._tidy_s = 0.0

    def start(self, expected: Collection[str]) -> None:
        """Begin; the expected processes are waited for on the recorder's thread."""
        self._expected = expected
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether it still records."""
        return self._thread.is_alive()

    def stop(self, reason: str) -> None:
        """Ask it to end although the run has not."""
        self._bus.interrupt(reason)

    def join(self, timeout_s: float | None = None) -> None:
        """Wait for it to end."""
        self._thread.join(timeout_s)

    def note(self, target: str, what: str, origin: FaultOrigin, tick: int | None = None) -> None:
        """Put into the log what was done, or happened, to a process: at a tick, or at the newest there is."""
        tick = max(self.tick, 0) if tick is None else tick
        try:
            self._take(self._out.stamp(FaultNote, tick=tick, target=target, what=what, origin=origin))
        except LogError as error:  # the run is about to end of it
            self.error = self.error or str(error)

    def close(self) -> None:
        """Leave the network and finish the log."""
        if self._thread.is_alive():
            self.stop("closing")
            self._thread.join()
        try:
            self._writer.close()
        except LogError as error:
            self.error = self.error or str(error)

    def _run(self) -> None:
        try:
            if self._bus.join(self._expected, self._join_timeout_s) is None:
                self._record()
                self.admission.close()
                for notice in self.admission.remaining_notices(self._out.incarnation):
                    self._take(notice)
        except (BusError, LogError) as error:
            self.error = str(error)
        finally:
            self._bus.close()  # the coordinator waits for it

    def _record(self) -> None:
        left = set(self._expected)
        deadline: float | None = None
        # A token's end may overtake the last message of its process, so an end is not believed at once.
        while left or self.control is None:
            timeout_s = None if deadline is None else max(0.0, deadline - time.monotonic())
            if self.control is not None and left <= {"coordinator"}:
                timeout_s = _QUIET_S  # the coordinator leaves last, after this recorder
            event = self._next(timeout_s)
            if event is None:
                break
            match event:
                case Interrupted():
                    return
                case Presence(name=name, alive=False):
                    left.discard(name)
                    if name == "coordinator" and self.control is None:
                        deadline = time.monotonic() + _OVERTAKEN_S
                case Presence(name=name):
                    # Back after a standstill, of its own or of this process, that the connection did not outlive.
                    left.update({name} & set(self._expected))
                    if name == "coordinator" and self.control is None:
                        deadline = None
                case Request():
                    self.requests.put(event)
                case _:
                    self.receive(event, self._bus.arrived_ns)
            for notice in self.admission.due_notices(time.monotonic_ns(), self._out.incarnation):
                self._take(notice)
            if self.control is not None and deadline is None:
                deadline = time.monotonic() + _TRAIL_S
        if self.control is None:
            # An end that was declared while this process stood still was never heard here.
            self._end(END_NOT_RECORDED if self._has_ended() else _GONE)

    def _next(self, timeout_s: float | None) -> BusEvent | None:
        """The next event, or None after the timeout; in flight a pause is used to write what waits for more."""
        if timeout_s is None and not self._writer.is_up_to_date:
            event = self._bus.next(_PAUSE_S)
            if event is not None:
                return event
            with self._writing:
                self._writer.flush()
            if time.monotonic() > self._tidy_s:
                give_back_memory()
                self._tidy_s = time.monotonic() + _TIDY_S
        return self._bus.next(timeout_s)

    def receive(self, message: Message, at_ns: int | None = None) -> None:
        """Record a message from the network, unless it is refused.

        Args:
            message: Of any kind.
            at_ns: Time of arrival, ns since 1970; now when left out.
        """
        self._reception.receive(message, time.time_ns() if at_ns is None else at_ns)

    def _handle(self, message: Message, at_ns: int) -> None:
        """Record a message that passed the checks of the reception."""
        if isinstance(message, Control):
            tick, window = self.admission.tick, self.admission.window
            check_moment(message, tick - window, tick + window)
        if isinstance(message, LinkChange):
            told_change(message, self._samples_s)
        self._take(message, at_ns)

    def _take(self, message: Message, at_ns: int | None = None) -> None:
        with self._writing:
            self._writer.write(message, time.time_ns() if at_ns is None else at_ns)
        self.received += 1
        match message:
            case PlantState():
                if self.started_s is None:
                    self.started_s = time.monotonic()
                self.plant_state = message
            case Tick():
                self.tick = message.tick
            case Control():
                self.control = message
            case Roster(version=version, reason=reason) if version > 1:
                self.notices.append(f"roster: {reason}")
            case FaultNote():
                self.notices.append(f"fault: {message.target} {message.what}")

    def _end(self, reason: str) -> None:
        """Write the end of a run that nobody is left to declare."""
        control = Control(
            sender=RECORDER,
            incarnation=0,
            sequence=0,
            tick=self.plant_state.tick if self.plant_state else 0,
            outcome="aborted",
            reason=reason,
            exit_code=EXIT_UNREACHABLE,
        )
        self._take(control)
