"""End of a recorded run: its exit code and reason, and whether its folder is kept."""

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace
from rich.console import Console

from tests.support import runs
from tests.support.commands import free_base
from transport.flight import active_runs, run_execution
from transport.flight.local_processes import Harness
from transport.flight.run_execution import observe
from transport.flight.run_files import RunError
from transport.protocol.network.endpoints import Endpoints
from transport.protocol.network.security import Security
from transport.protocol.wire import errors_and_exit_codes as codes
from transport.protocol.wire.messages import Control

RUN = runs.setup(runs.SHORT)
LOST = "the log: cannot write it (no space)"


def end(exit_code: int, reason: str = "") -> Control:
    """Return the end of a run."""
    return replace(runs.end(3), exit_code=exit_code, reason=reason)


def observed(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    interrupt: bool = False,
    lost: str = "",
    **recorder: Any,
) -> tuple[int, str]:
    """Return exit code and reason of a run whose recorder ends in a state."""

    def recorder_of(_setup: Any, _place: Any, writer: Any, *_: Any) -> Any:
        writer.lost = lost
        state = {"control": None, "error": None, "started_s": 1.0, "received": 5} | recorder
        return SimpleNamespace(writer=writer, close=writer.close, start=lambda _: None, **state)

    def until_end() -> None:
        if interrupt:
            raise KeyboardInterrupt

    monkeypatch.setattr(run_execution, "Recorder", recorder_of)
    monkeypatch.setattr(run_execution, "RunWatch", lambda *_: SimpleNamespace(until_end=until_end))
    finished = observe(RUN, runs.place("r1"), folder, Console(quiet=True))
    return finished.exit_code, finished.reason


@pytest.mark.parametrize(
    ("recorder", "expected"),
    [
        ({"control": end(0)}, (0, "")),
        ({"control": end(codes.EXIT_DIVERGED, "far away")}, (codes.EXIT_DIVERGED, "far away")),
        (
            {"control": end(codes.EXIT_UNREACHABLE, "plant is gone")},
            (codes.EXIT_UNREACHABLE, "plant is gone"),
        ),
        ({}, (codes.EXIT_INTERRUPTED, "recording interrupted; the run may continue without it")),
    ],
)
def test_an_end_after_the_first_tick_is_told(
    recorder: dict[str, Any],
    expected: tuple[int, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Exit code and reason are the coordinator's, or those of an interrupted recording; the folder stays."""
    assert observed(tmp_path / "a", monkeypatch, **recorder) == expected
    assert (tmp_path / "a").exists()


@pytest.mark.parametrize(
    ("recorder", "exit_code", "text"),
    [
        ({"error": "no router"}, codes.EXIT_UNREACHABLE, "no router"),
        ({"started_s": None}, codes.EXIT_UNREACHABLE, "the run ended before its first tick"),
        (
            {"control": end(codes.EXIT_UNREACHABLE, "plant is gone"), "started_s": None},
            codes.EXIT_UNREACHABLE,
            "plant is gone; the run ended before its first tick",
        ),
        ({"control": end(0), "lost": LOST}, codes.EXIT_UNRECORDED, f"{LOST}; the run completed"),
        (
            {"control": end(codes.EXIT_DIVERGED, "far away"), "lost": LOST},
            codes.EXIT_DIVERGED,
            f"{LOST}; the run completed far away",
        ),
    ],
)
def test_a_run_that_did_not_begin_or_is_not_recorded_is_an_error(
    recorder: dict[str, Any],
    exit_code: int,
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The exit code of the run goes before that of its log."""
    with pytest.raises(RunError) as caught:
        observed(tmp_path / "a", monkeypatch, **recorder)
    assert (str(caught.value), caught.value.exit_code) == (text, exit_code)
    assert (tmp_path / "a").exists()


@pytest.mark.parametrize(
    ("started_s", "received", "stays"), [(1.0, 5, True), (None, 5, False), (1.0, 0, False)]
)
def test_an_interrupted_run_without_a_tick_leaves_no_folder(
    started_s: float | None,
    received: int,
    stays: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """There is nothing to report without a tick, or without any message."""
    recorder: dict[str, Any] = {"started_s": started_s, "received": received}
    with pytest.raises(KeyboardInterrupt):
        observed(tmp_path / "a", monkeypatch, interrupt=True, **recorder)
    assert (tmp_path / "a").exists() is stays


@pytest.mark.parametrize(
    ("error", "ended", "received", "is_kept"),
    [
        (None, [], 0, False),
        (None, [], 5, True),
        (None, ["plant"], 0, True),
        ("no router", [], 0, True),
        ("no router", None, 0, False),  # processes are started elsewhere: there are no logs
    ],
)
def test_a_folder_is_kept_for_its_messages_or_logs(
    error: str | None,
    ended: list[str] | None,
    received: int,
    is_kept: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Logs of a failure; the recorder asks whether a process of this machine is on its way."""
    starting: list[bool] = []

    def recorder_of(_setup: Any, _place: Any, writer: Any, _say: Any, is_starting: Any) -> Any:
        starting.append(is_starting("plant"))
        state = {"error": error, "started_s": 1.0, "received": received}
        return SimpleNamespace(close=writer.close, **state)

    monkeypatch.setattr(run_execution, "Recorder", recorder_of)
    harness: Any = None
    if ended is not None:
        harness = SimpleNamespace(
            ended=lambda: ended, is_starting=lambda *given: given == ("plant", 1.0)
        )
    made: Any = SimpleNamespace(path=tmp_path, is_kept=None)
    progress: Any = SimpleNamespace(setup=RUN, say=None)
    with run_execution._recorded(runs.place("r1"), made, {}, progress, harness):
        pass
    assert made.is_kept is is_kept
    assert starting == [harness is not None]


def test_a_run_is_marked_while_it_is_active(tmp_path: Path) -> None:
    """With this process, and the address of each process, at which it listens or else that of its router."""
    listens = Endpoints(listen=["tcp/127.0.0.1:1"], connect=["tcp/127.0.0.1:2"])
    connects = Endpoints(listen=[], connect=["tcp/127.0.0.1:3"])
    addresses = run_execution._Addresses(run="r1", processes={"plant": listens}, recorder=connects)
    with run_execution._marked_active(tmp_path, addresses):
        marked = active_runs.read(tmp_path)
        assert marked is not None
        assert (marked.run, marked.pid, marked.keys) == ("r1", os.getpid(), "")
        assert marked.endpoints == {"plant": "tcp/127.0.0.1:1", "recorder": "tcp/127.0.0.1:3"}
        assert active_runs.newest_folder(tmp_path.parent) == tmp_path
    assert active_runs.read(tmp_path) is None


@pytest.mark.parametrize(
    ("name", "code", "last_words", "expected"),
    [
        ("plant", 1, "no such engine", "no such engine; so plant is gone"),
        ("plant", -9, "", "plant was killed by SIGKILL; so plant is gone"),
        ("plant", 0, "no such engine", "plant is gone"),
        ("agent1", 1, "no such engine", "plant is gone"),
    ],
)
def test_the_error_of_the_process_that_is_gone_comes_first(
    name: str, code: int, last_words: str, expected: str
) -> None:
    """Its last words, or how it ended; of others, or of one that left in order, there is nothing to tell."""
    how = "was killed by SIGKILL"
    child = SimpleNamespace(name=name, code=code, last_words=last_words, how_it_ended=how)
    harness: Any = SimpleNamespace(ended=lambda: [child])
    assert run_execution._cause("plant is gone", harness) == expected
    assert run_execution._cause("plant is gone", None) == "plant is gone"


def test_a_run_of_this_machine_tells_where_its_logs_are() -> None:
    """With the error of a process, if one is gone."""
    control = end(codes.EXIT_UNREACHABLE, "plant is gone")
    writer = SimpleNamespace(lost="")
    recorder: Any = SimpleNamespace(control=control, error=None, started_s=1.0, writer=writer)
    child = SimpleNamespace(name="plant", code=1, last_words="no engine", how_it_ended="")
    harness: Any = SimpleNamespace(ended=lambda: [child], logs=Path("run/logs"))
    finished = run_execution._finished(Path("run"), recorder, harness)
    assert finished.reason == "no engine; so plant is gone; logs in run/logs"


@pytest.mark.parametrize(
    ("folder", "is_based", "name"), [("2026-run", False, "2026-run"), ("a run", True, "paper")]
)
def test_a_run_has_the_name_of_its_folder_if_that_can_be_one(
    folder: str, is_based: bool, name: str, tmp_path: Path
) -> None:
    """Its processes listen from the base port on, or on any ports; each answers where it listens."""
    base_port = free_base()
    given = [f"network.base_port={base_port}"] * is_based
    with run_execution._reserved(runs.setup(*given), tmp_path / folder) as addresses:
        assert addresses.run == name
        assert addresses.keys == ""
        asked_at = addresses.asked_at()
        for process, place in {**addresses.processes, "recorder": addresses.recorder}.items():
            assert asked_at[process] == place.listen[0]
        ports = [int(asked_at[process].rpartition(":")[2]) for process in addresses.processes]
        if is_based:
            assert ports == list(range(base_port, base_port + 6))
        assert len({*asked_at.values()}) == len(addresses.processes) + 1 == 7


def test_an_external_process_is_told_how_to_join(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the folder of keys, absolute, where the run has some."""
    place = Endpoints(listen=["tcp/127.0.0.1:1"], connect=["tcp/127.0.0.1:2"])
    open_run = run_execution._Addresses(run="r1", processes={"agent2": place}, recorder=place)
    told = run_execution._invitation("agent2", open_run, "abc")
    assert told == f"waiting for agent2 of run r1, digest abc; it {place.in_words()}"

    monkeypatch.chdir("/")
    keyed = Endpoints(listen=["tcp/127.0.0.1:1"], connect=[], security=Security(Path("k"), ()))
    secured = run_execution._Addresses(run="r1", processes={"agent2": place}, recorder=keyed)
    assert run_execution._invitation("agent2", secured, "abc") == (
        f"{told}; it needs --set 'network.keys=\"/k\"'"
    )
    client = Endpoints(listen=[], connect=["tcp/127.0.0.1:2"])
    routed = run_execution._Addresses(run="r1", processes={"agent2": client}, recorder=place)
    assert routed.asked_at()["agent2"] == "tcp/127.0.0.1:2"


@pytest.mark.parametrize(
    ("scenario", "settings", "expected"),
    [
        ("paper", (), (0, False, None)),
        ("flight", ("network.vehicle_port=15000",), (15000, True, "stand_in")),
        ("flight", (), (16000, True, "stand_in")),
        ("flight", ("plant.kind=vehicles",), (14550, False, "ardupilot")),
        (
            "flight",
            ("plant.kind=vehicles", "network.vehicle_port=15000"),
            (15000, False, "ardupilot"),
        ),
    ],
)
def test_vehicles_have_ports_of_their_autopilots(
    scenario: str,
    settings: tuple[str, ...],
    expected: tuple[int, bool, str | None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Those of the scenario, else free ones for autopilots that the plant plays, which stand until tick 0."""
    monkeypatch.setattr(run_execution, "free_udp_ports", lambda count: 4000 * count)
    setup = runs.ready(scenario, *settings)
    place = Endpoints(listen=[], connect=["tcp/127.0.0.1:2"])
    processes = dict.fromkeys(("agent1", "agent2"), place)
    addresses = run_execution._Addresses(run="r1", processes=processes, recorder=place)
    ended: list[Harness] = []
    monkeypatch.setattr(Harness, "end", lambda harness, _: ended.append(harness))
    progress: Any = SimpleNamespace(setup=setup, say=None)
    folder = Path("run")
    with run_execution._harness(addresses, folder, None, ["agent2"], progress) as harness:
        assert (harness.vehicle_port, harness.stands, harness.autopilot) == expected
        assert list(harness.mesh) == ["agent1"]
        assert ended == []
    assert ended == [harness]
