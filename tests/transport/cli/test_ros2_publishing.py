"""`transport ros2` without a network: which ticks are published, when it ends, and which targets go on."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.support import runs
from transport.cli.commands import ros2 as program
from transport.report.ros2_bag import GoalError

ALL, SECOND = "/target", "/agent2/target"


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Return the clock of the program, whose time is `now_s`, s."""
    clock = SimpleNamespace(now_s=0.0)
    clock.monotonic = lambda: clock.now_s
    clock.sleep = lambda _: None
    monkeypatch.setattr(program, "time", clock)
    return clock


@pytest.mark.usefixtures("clock")
def test_each_recorded_tick_is_published_once_from_the_newest_on() -> None:
    """Ticks that are not recorded are left out; the last of a look into the log is the newest."""
    looks = iter([range(6), (), (6, 7, 9), (), (10,)])
    history = SimpleNamespace(first=0, last=-1, plant_states={})
    published: list[tuple[int, int, bool]] = []
    handed_on: list[int] = []

    def read() -> bool:
        for tick in (look := next(looks)):
            history.plant_states[tick] = None
            history.last = tick
        return 10 in look

    def publish(tick: int, stamp_ns: int, *, is_newest: bool) -> None:
        published.append((tick, stamp_ns, is_newest))

    start = SimpleNamespace(stamp_ns=lambda tick: 100 * tick)
    reader: Any = SimpleNamespace(history=history, read=read, start=start)
    publisher: Any = SimpleNamespace(publish=publish)
    targets: Any = SimpleNamespace(hand_on=lambda: handed_on.append(history.last))
    program._publish(reader, publisher, targets)
    assert published == [
        (5, 500, True), (6, 600, False), (7, 700, False), (9, 900, True), (10, 1000, True),
    ]  # fmt: skip
    assert handed_on == [5, 9, 9, 10]


def test_markers_that_do_not_change_come_again_each_second(clock: SimpleNamespace) -> None:
    """With the newest tick; of others only the states are published."""
    sent: list[tuple[str, Any]] = []
    messages: Any = SimpleNamespace(
        states=lambda tick, _: [("states", tick)], scenes=lambda *_, fixed: [("scene", fixed)]
    )
    node: Any = SimpleNamespace(put=lambda *given: sent.append(given))
    publisher = program._Publisher(messages=messages, node=node)
    rows: Sequence[tuple[float, bool, list[bool]]] = (
        (0.0, True, [True]),
        (0.5, False, []),
        (0.9, True, [False]),
        (1.0, True, [True]),
    )
    for tick, (clock.now_s, is_newest, scenes) in enumerate(rows):
        publisher.publish(tick, 0, is_newest=is_newest)
        assert sent == [("states", tick), *(("scene", fixed) for fixed in scenes)]
        sent.clear()


def test_targets_are_half_a_second_apart_and_told_as_their_topics_say(
    clock: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The newest of a topic waits for its turn; one that is refused is told, and takes its turn, too."""
    heard: dict[str, str] = {}
    sent: list[tuple[str, tuple[int, ...]]] = []

    def goal_in(data: str) -> str:
        if data == "bad":
            raise GoalError("expected a finite position")
        return data

    monkeypatch.setattr("transport.report.ros2_bag.goal_in", goal_in)
    node: Any = SimpleNamespace(take=lambda topic: heard.pop(topic, None))
    commands: Any = SimpleNamespace(target=lambda *given: sent.append(given))
    targets = program._Targets(node=node, commands=commands, told={ALL: (), SECOND: (2,)})

    rows: list[tuple[float, dict[str, str], list[tuple[str, tuple[int, ...]]]]] = [
        (0.0, {}, []),
        (0.0, {ALL: "a"}, [("a", ())]),
        (0.4, {SECOND: "b"}, []),
        (0.5, {}, [("b", (2,))]),
        (1.0, {ALL: "bad"}, []),
        (1.4, {ALL: "c"}, []),
        (1.5, {}, [("c", ())]),
    ]
    for clock.now_s, new, expected in rows:
        heard |= new
        targets.hand_on()
        assert sent == expected
        sent.clear()
    assert capsys.readouterr().err == f"{ALL}: expected a finite position\n"


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize("end", ["", "control", "log", "parent"])
def test_the_last_messages_are_those_before_an_end(
    end: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the run, of its log, or of its parent, which writes the log; states tell when ticks were recorded."""
    run = runs.setup()
    monkeypatch.setattr(program, "read_live_run", lambda _: None if end == "parent" else run)
    entries = [
        SimpleNamespace(message=message, received_ns=5)
        for message in (runs.tick(0), runs.plant_state(run, 3))
    ]
    tail: Any = SimpleNamespace(ended=end == "log", read_recorded=lambda: entries)
    added: list[Any] = []
    control = "aborted" if end == "control" else None
    history: Any = SimpleNamespace(control=control, add=added.extend)
    noted: list[tuple[int, int]] = []
    start: Any = SimpleNamespace(note=lambda *given: noted.append(given))
    folder: Any = None
    reader = program._Reader(folder=folder, tail=tail, history=history, start=start)
    assert reader.read() is bool(end)
    assert noted == [(3, 5)]
    assert added == [entry.message for entry in entries]


@pytest.mark.parametrize(("on_overrun", "waited_ns"), [("hold", 25_000_000), ("continue", 0)])
def test_stamps_and_topics_are_those_of_the_run(
    on_overrun: str, waited_ns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stamps are later after a wait of a period if the clock waits; targets for all, and for each agent, are heard."""
    run = runs.setup("clock.mode=realtime", "clock.speed=2", f"clock.on_overrun={on_overrun}")
    seen: list[Any] = []
    node = SimpleNamespace(close=lambda: seen.append("closed"))

    def note(*given: Any) -> Any:
        seen.append(given)
        return node

    def messages_of(builder: Any, stamps_apart_ns: int) -> Any:
        return SimpleNamespace(builder=builder, stamps_apart_ns=stamps_apart_ns, topics=())

    monkeypatch.setattr("transport.report.ros2_bag.Ros2Messages", messages_of)
    monkeypatch.setattr(program, "os", SimpleNamespace(nice=seen.append))
    monkeypatch.setattr(program, "find_active", lambda name, _: (Path(name), "live run"))
    monkeypatch.setattr(program, "setup_of", lambda _: run)
    monkeypatch.setattr(program, "LogTail", lambda *given: given)
    monkeypatch.setattr(program, "Commands", lambda live_run, _: live_run)
    monkeypatch.setattr(program, "_node", note)
    monkeypatch.setattr(program, "_publish", note)
    program.ros2("folder", "tcp/[::1]:7447", 3)

    nice, (connect, domain, messages, told), (reader, publisher, targets), end = seen
    assert (nice > 0, connect, domain, end) == (True, "tcp/[::1]:7447", 3, "closed")
    by_agent = {f"/agent{agent}/target": (agent,) for agent in (1, 2, 3, 4)}
    assert told == targets.told == {ALL: (), **by_agent}
    assert (targets.node, targets.commands) == (node, "live run")
    assert (publisher.node, publisher.messages) == (node, messages)
    assert reader.tail == (reader.folder / "run.mcap", run) == (Path("folder/run.mcap"), run)
    assert messages.builder.setup is reader.history.setup is run
    assert messages.builder.history is reader.history

    reader.start.note(0, 10**9)
    reader.start.note(1, 10**9 + messages.stamps_apart_ns + 25_000_000)
    assert messages.stamps_apart_ns == 25_000_000
    assert reader.start.stamp_ns(1) == 10**9 + 25_000_000 + waited_ns
