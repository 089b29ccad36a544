"""The recorder: what it tells of the run, and when it ends, as its connection comes and goes."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support import messages as catalogue
from tests.support import runs
from tests.support.logs import HEADER, with_scenario
from tests.support.runs import setup
from transport.flight.recorder import Recorder
from transport.log.run_log import read_log
from transport.log.writer import LogWriter
from transport.protocol.admission.acceptance_and_refusals import Sample
from transport.protocol.network.bus_events_and_clock import (
    Arrival,
    BusOptions,
    Departed,
    Interrupted,
)
from transport.protocol.network.session import BusError
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.bundles import Record
from transport.protocol.wire.codec import encode, header_of
from transport.protocol.wire.key_expressions import Keys
from transport.protocol.wire.messages import (
    Control,
    FaultNote,
    Message,
    Presence,
    Request,
    Target,
    VehicleStatus,
)

RUN = setup("controller.horizon=5", runs.ticks(40))
PROCESSES = ["coordinator", "plant"]
GONE = [Presence(name, 0, alive=False) for name in PROCESSES]
BACK = [Presence(name, 0, alive=True) for name in PROCESSES]
# A pause longer than any timeout of the recorder.
SILENCE = None

FLIGHT = runs.ready("flight")  # goes on without its coordinator

Event = Message | Sample | Presence | Request | Departed | Interrupted | None


class ScriptedBus:
    """Connection that hands over prepared events in place of the network."""

    def __init__(self, events: Iterable[Event]) -> None:
        self._events = iter(events)
        self.alive = dict.fromkeys(PROCESSES, 0)
        self.timeouts_s: list[float | None] = []  # of all waits

    def announce(self) -> None:
        """Show nothing: no process waits."""

    def join(self, *_: object) -> None:
        """All processes have joined."""

    def next(self, timeout_s: float | None) -> Arrival | None:
        """Return the next event, or None when the time is up before."""
        self.timeouts_s.append(timeout_s)
        for event in self._events:
            if isinstance(event, Presence):
                self.alive = {name: 0 for name in self.alive if name != event.name}
                self.alive |= {event.name: 0} if event.alive else {}
            if event is not SILENCE or timeout_s is not None:
                return None if event is None else Arrival(event, 0)
        return None

    def close(self) -> None:
        """Nothing to close."""


def recorder_of(
    folder: Path, bus: Any, say: Callable[[str], None] = lambda _: None, run: Setup = RUN
) -> Recorder:
    """Return the recorder of a run over a connection, with a log in a folder."""
    header = with_scenario(HEADER, run)
    writer = LogWriter(folder / "run.mcap", header, period_ns=run.period_ns)
    place = runs.place(run.scenario.name)
    return Recorder(run, place, writer, say, bus_of=lambda *_args, **_options: bus)


def recorded(folder: Path, bus: ScriptedBus, run: Setup = RUN) -> list[Message]:
    """Return the messages in the log of a recorder that receives the events of a connection."""
    recorder = recorder_of(folder, bus, run=run)
    recorder.start(PROCESSES)
    recorder.join()
    recorder.close()
    assert recorder.error is None
    return [entry.message for entry in read_log(folder / "run.mcap").messages]


@pytest.fixture
def flight() -> list[Event]:
    """Return the messages of coordinator and plant in a completed run of six ticks."""
    messages: list[Event] = [runs.roster()]
    for k in range(6):
        messages += [replace(runs.tick(k), sequence=k + 1), runs.plant_state(RUN, k)]
    return [*messages, replace(runs.end(5), sequence=7)]


def test_processes_that_were_unreachable_return(tmp_path: Path, flight: list[Event]) -> None:
    """Recording goes on when all processes reconnect after a pause that closed their connections."""
    messages = recorded(
        tmp_path, ScriptedBus([*flight[:5], *GONE, *BACK, SILENCE, *flight[5:], *reversed(GONE)])
    )
    assert [encode(message) for message in messages] == [
        encode(message) for message in flight if isinstance(message, Message)
    ]


def test_a_coordinator_that_stays_away_ends_the_record(tmp_path: Path, flight: list[Event]) -> None:
    """Without it the recorder writes the end of the run, and nothing that comes later."""
    *messages, end = recorded(
        tmp_path, ScriptedBus([*flight[:5], *GONE, SILENCE, *flight[5:], *reversed(GONE)])
    )
    assert [encode(message) for message in messages] == [
        encode(message) for message in flight[:5] if isinstance(message, Message)
    ]
    assert isinstance(end, Control)
    assert (end.outcome, end.reason) == ("aborted", "coordinator is gone")


def test_in_a_pause_all_messages_are_in_the_file(tmp_path: Path, flight: list[Event]) -> None:
    """After 0.02 s without a message; then it waits for ever, and without a pause nothing is written earlier."""
    in_file: list[bool] = []

    class Watched(ScriptedBus):
        def next(self, timeout_s: float | None) -> Arrival | None:
            in_file.append(recorder.writer.is_up_to_date)
            return super().next(timeout_s)

    bus = Watched([runs.tick(0), SILENCE, runs.tick(1), runs.tick(2), runs.end(2), *GONE])
    recorder = recorder_of(tmp_path, bus)
    recorder.start(PROCESSES)
    recorder.join()
    recorder.close()
    waits = [*zip(bus.timeouts_s, in_file, strict=True)]
    assert waits[:5] == [(None, True), (0.02, False), (None, True), (0.02, False), (0.02, False)]


def test_an_end_without_the_last_messages(tmp_path: Path, flight: list[Event]) -> None:
    """Before any state the run ends at tick 0; one that is stopped has no end; last words end the wait at once."""
    last_words = [*map(Departed, PROCESSES)]
    scripts: dict[str, list[Any]] = {
        "early": [*GONE, SILENCE],
        "stopped": [*flight[:5], Interrupted("enough")],
        "whole": [*flight, *last_words, runs.plant_state(RUN, 5)],
    }
    found = {}
    for name, script in scripts.items():
        folder = tmp_path / name
        folder.mkdir()
        found[name] = recorded(folder, ScriptedBus(script))
    (end,) = found["early"]
    assert isinstance(end, Control)
    assert end.tick == 0
    assert len(found["stopped"]) == 5
    assert len(found["whole"]) == len(flight)


@pytest.mark.parametrize(("speed", "gather_s"), [(0.0, 0.03), (1.0, 0.01)])
def test_messages_are_gathered_for_less_than_a_tick_in_real_time(
    speed: float, gather_s: float, tmp_path: Path
) -> None:
    """Longer where ticks follow each other as fast as they can; a message keeps its own time of arrival."""
    options: list[BusOptions] = []

    def bus_of(*given: Any) -> Any:
        options.append(given[-1])
        return ScriptedBus([])

    run = setup(f"clock.speed={speed}")
    log = tmp_path / "run.mcap"
    writer = LogWriter(log, with_scenario(HEADER, run), period_ns=run.period_ns)
    recorder = Recorder(run, runs.place(run.scenario.name), writer, bus_of=bus_of)
    recorder.receive(runs.tick(0), 12345)
    recorder.receive(sample(runs.tick(1), run=run), 23456)
    recorder.close()
    assert [one.gather_s for one in options] == [gather_s]
    assert [entry.received_ns for entry in read_log(log).messages] == [12345, 23456]


def test_it_waits_for_the_last_messages_of_the_processes_that_are_there(
    tmp_path: Path, flight: list[Event]
) -> None:
    """2 s after the end of the run for a process with a token; once all tokens are gone 0.05 s."""
    bus = ScriptedBus([*flight, *reversed(GONE)])
    recorded(tmp_path, bus)
    assert bus.timeouts_s[-3:] == [2.0, 2.0, 0.05]


def test_a_process_that_returns_is_waited_for_and_a_request_is_passed_on(
    tmp_path: Path, flight: list[Event]
) -> None:
    """After the end of the run the plant reconnects: it may still send."""
    asked = Request("fault", {}, lambda _: None)
    plant_gone, plant_back = GONE[1], BACK[1]
    of_coordinator, of_plant = map(Departed, PROCESSES)
    late = runs.plant_state(RUN, 5)
    leaving: list[Event] = [of_plant, plant_gone, plant_back, of_coordinator, late]
    bus = ScriptedBus([asked, *flight, *leaving])
    recorder = recorder_of(tmp_path, bus)
    recorder.start(PROCESSES)
    recorder.join()
    recorder.close()
    assert recorder.requests.get_nowait() is asked
    assert recorder.received == len(flight) + 1


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (BusError("no router"), "no router"),
        (MemoryError(), "recorder: MemoryError"),
        (ValueError("no such"), "recorder: ValueError: no such"),
    ],
)
def test_an_error_ends_the_recording_and_is_kept(
    error: Exception, text: str, tmp_path: Path
) -> None:
    """That of the network in its own words, any other with its kind."""

    class Failing(ScriptedBus):
        def join(self, *_: object) -> None:
            raise error

    recorder = recorder_of(tmp_path, Failing([]))
    recorder.start(PROCESSES)
    recorder.join()
    recorder.close()
    assert recorder.error == text


NOT_A_MESSAGE = b"\x00"


def sample(message: Message, *, key: str = "", data: bytes = b"", run: Setup = RUN) -> Sample:
    """Return a message as it comes from the network, perhaps under another key or garbled."""
    whole = encode(message)
    keys = Keys(run.scenario.name)
    return Sample(
        f"{keys.prefix}/{key}" if key else keys.of(message), data or whole, header_of(whole)
    )


def of_flight(message: Message) -> Sample:
    """Return a message of the flight as it comes from the network."""
    return sample(message, run=FLIGHT)


def test_a_team_that_goes_on_is_recorded_until_its_last_tick(tmp_path: Path) -> None:
    """Without its coordinator the plant and the vehicles tell the tick; after the last one it is waited 0.5 s."""
    last = FLIGHT.ticks - 1
    state = runs.plant_state(FLIGHT, 3)
    status = catalogue.sample(VehicleStatus, tick=last + 5)
    bus = ScriptedBus([GONE[0], of_flight(state), of_flight(status)])
    *_, end = recorded(tmp_path, bus, FLIGHT)
    assert [timeout_s for timeout_s in bus.timeouts_s if timeout_s != 0.02] == [None, None, 0.5]
    assert isinstance(end, Control)
    assert (end.outcome, end.reason, end.tick) == ("aborted", "coordinator is gone", 3)


def test_the_tick_of_a_team_that_goes_on_is_the_newest_of_all(tmp_path: Path) -> None:
    """At most the last one of the run, whatever a vehicle says."""
    recorder = recorder_of(tmp_path, ScriptedBus([]), run=FLIGHT)
    rows = [
        (runs.plant_state(FLIGHT, 3), 3),
        (catalogue.sample(VehicleStatus, tick=7), 7),
        (runs.plant_state(FLIGHT, 5), 7),
        (catalogue.sample(VehicleStatus, tick=FLIGHT.ticks + 5), FLIGHT.ticks - 1),
    ]
    for message, tick in rows:
        recorder.receive(of_flight(message))
        assert recorder.tick == tick
    recorder.close()


def test_a_run_begins_with_its_first_state_or_without_a_plant_with_its_first_tick(
    tmp_path: Path,
) -> None:
    """A record of tick 0 may lack the state; that of a later tick has it, and the state is found in it."""
    first, later = (
        catalogue.sample(Record, tick=tick, keys=("plant_state",), parts=(encode(state),))
        for tick, state in ((0, runs.plant_state(RUN, 0)), (1, runs.plant_state(RUN, 1)))
    )
    recorder = recorder_of(tmp_path, ScriptedBus([]))
    for message, has_begun in ((runs.tick(0), False), (first, False), (later, True)):
        recorder.receive(sample(message))
        assert (recorder.started_s is not None) is has_begun
    state = recorder.plant_state
    assert state is not None
    assert state.tick == 1
    recorder.close()

    alone = runs.ready("flight", "plant.kind=vehicles")
    recorder = recorder_of(tmp_path, ScriptedBus([]), run=alone)
    recorder.receive(sample(runs.tick(0), run=alone))
    assert recorder.started_s is not None
    recorder.close()


def test_a_state_that_cannot_be_is_none(tmp_path: Path) -> None:
    """The newest of those that can be is shown, among the last four messages of the plant."""
    recorder = recorder_of(tmp_path, ScriptedBus([]))
    state = runs.plant_state(RUN, 3)
    forged = replace(runs.plant_state(RUN, 4), x=state.x[:-1])
    for message in (state, *[forged] * 3):
        recorder.receive(sample(message))
    shown = recorder.plant_state
    assert shown is not None
    assert shown.tick == 3
    recorder.receive(sample(forged))
    assert recorder.plant_state is None
    beyond = encode(replace(state, tick=RUN.ticks))
    recorder.receive(
        sample(catalogue.sample(Record, tick=5, keys=("plant_state",), parts=(beyond,)))
    )
    assert recorder.plant_state is None
    recorder.close()


def test_a_target_changes_the_run(tmp_path: Path) -> None:
    """The recorder's run has the targets so far, as the progress shows where the reference is."""
    recorder = recorder_of(tmp_path, ScriptedBus([]))
    target: Target = catalogue.sample(
        Target, tick=5, number=1, points=np.array([[0.5, 0.0, -10.0]]), times=np.zeros(1), way_s=0.0,
        way_ramp_s=0.0,
    )  # fmt: skip
    for message in (target, target, replace(target, number=3)):  # one again, one after a gap
        recorder.receive(message)
        assert len(recorder.setup.maneuver.targets) == 1
    recorder.close()

    # Several are taken in order; where there is a ground, one may be to land on it.
    landing = replace(target, lands=True)
    ground = setup("plant.engine=mujoco", "plant.ground_m=0.0")
    for run, has_ground in ((RUN, False), (ground, True)):
        targets = run.after([landing, replace(landing, tick=200, number=2)]).maneuver.targets
        assert [one.lands for one in targets] == [has_ground] * 2
        assert [one.since_s for one in targets] == pytest.approx([5 * 0.05, 200 * 0.05])


def test_progress_is_that_of_the_newest_genuine_message(tmp_path: Path) -> None:
    """Late messages, ticks beyond the run and kinds under a foreign key are recorded, and are no progress."""
    recorder = recorder_of(tmp_path, ScriptedBus([]))
    first, third = runs.plant_state(RUN, 0), runs.plant_state(RUN, 3)
    beyond = replace(runs.tick(1), tick=RUN.ticks)
    rows = [
        (sample(runs.tick(3)), 3, None),
        (sample(runs.tick(2)), 3, None),
        (sample(beyond), 3, None),
        (sample(runs.tick(9), key="plant_state"), 3, None),
        (sample(first, key="tick"), 3, None),
        (sample(first), 3, 0),
        (sample(third), 3, 3),
        (sample(runs.plant_state(RUN, 4), data=NOT_A_MESSAGE), 3, 3),
        (sample(runs.tick(39)), 39, 3),
    ]
    for event, tick, state_tick in rows:
        recorder.receive(event)
        state = recorder.plant_state
        assert (recorder.tick, state and state.tick) == (tick, state_tick)
        assert (recorder.started_s is None) == (state_tick is None)
    assert recorder.received == len(rows)
    recorder.close()


def test_refusals_are_recorded_in_the_run_and_at_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the gate tells them: after each event by the clock, and the last ones whatever the time."""
    notice = catalogue.sample(FaultNote, target="agent1")
    times: list[bool] = []

    def notices(_gate: object, _incarnation: int, now_ns: int | None = None) -> list[Message]:
        times.append(now_ns is not None)
        return [notice]

    monkeypatch.setattr(
        "transport.protocol.admission.acceptance_and_refusals.Gate.notices", notices
    )
    recorder = recorder_of(tmp_path, ScriptedBus([runs.tick(0), runs.end(1), SILENCE]))
    recorder.start(PROCESSES)
    recorder.join()
    assert times == [True, True, False]
    assert recorder.received == 2 + 3
    recorder.close()


def test_roster_and_faults_are_told(tmp_path: Path) -> None:
    """The first roster is no news; a fault without a tick is noted at the newest one, 0 before the first."""
    told: list[str] = []
    recorder = recorder_of(tmp_path, ScriptedBus([]), told.append)
    recorder.note("agent1", "stopped", "person")
    recorder.receive(runs.roster())
    assert recorder.members == {"agent1", "agent2", "agent3", "agent4"}
    recorder.receive(replace(runs.roster({1: 1, 2: 1}, k=4, version=2), reason="gone"))
    assert recorder.members == {"agent1", "agent2"}
    recorder.receive(sample(runs.tick(7)))
    recorder.note("agent2", "killed", "person")
    recorder.note("agent2", "killed", "script", 5)
    recorder.close()

    assert told == ["fault: agent1 stopped", "roster: gone", *["fault: agent2 killed"] * 2]
    notes = read_log(tmp_path / "run.mcap").of(FaultNote)
    assert [note.tick for note in notes] == [0, 7, 5]
