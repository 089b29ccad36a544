"""One run on this machine, from scenario to run folder."""

import math
import os
import signal
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from transport.flight import live
from transport.flight.fault_script import FaultScript
from transport.flight.harness import Child, Harness, keys_setting, reserved_ports
from transport.flight.progress import RunProgress, compile_model
from transport.flight.recorder import Recorder
from transport.flight.run_files import (
    RunError,
    RunFolder,
    checked,
    existing,
    own_keys,
    run_header,
)
from transport.flight.signals import collected_signals
from transport.log.writer import LogWriter
from transport.protocol.network.bus import Place
from transport.protocol.network.endpoints import mesh, process_names
from transport.protocol.network.security import Security
from transport.protocol.network.session import check_usable
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire import exit_codes as codes
from transport.protocol.wire.keys import RECORDER, Keys
from transport.protocol.wire.names import COORDINATOR

_ORDERLY_ENDS = {
    0,
    codes.EXIT_UNREACHABLE,
    codes.EXIT_OVERRUN,
    codes.EXIT_DIVERGED,
    codes.EXIT_INTERRUPTED,
}
_POLL_S = 0.05
# Times for the processes to end after the run, and for the recorder to receive the messages of
# ended processes.
_LEAVE_S, _CATCH_UP_S = 3.0, 2.0


@dataclass(frozen=True, slots=True)
class Finished:
    """End of a run: its folder, complete except for the report, exit code, and reason in a line, empty if completed."""

    folder: Path
    exit_code: int
    reason: str


def simulate(
    setup: Setup,
    folder: Path,
    console: Console,
    started: Callable[[], None] = lambda: None,
    ready: Callable[[], object] = lambda: None,
    external: Collection[str] = (),
) -> Finished:
    """Start the processes of a run, record it in a new folder, and wait for its end and theirs.

    `started` is called once the processes are started; before the first tick they wait for `ready`
    to return. Processes that are `external` join from elsewhere. Raises: TransportError.
    KeyboardInterrupt.
    """
    scenario, names = setup.scenario, process_names(setup.scenario)
    if folder.exists():  # told before a first compilation
        raise existing(folder)
    with ExitStack() as stack:
        check_usable()
        classes = checked(setup, external)
        compile_model(setup.system.N, console)
        base = scenario.network.base_port
        wanted = [0] * len(names) if base is None else range(base, base + len(names))
        # The recorder listens for requests to this process.
        own_port, *ports = stack.enter_context(reserved_ports(scenario.network.host, [0, *wanted]))
        places = mesh(scenario, [*names, RECORDER], [*ports, own_port])
        places = {name: place.checked(name, scenario) for name, place in places.items()}
        run = folder.name if Keys.allows(folder.name) else scenario.name
        run_folder = stack.enter_context(RunFolder(folder, setup))
        header = run_header(setup, run, len(names), run_folder.scenario_toml, classes)
        called = {name: [*place.listen, *place.connect][0] for name, place in places.items()}
        recording = places.pop(RECORDER)
        started_here = {name: place for name, place in places.items() if name not in external}
        progress = stack.enter_context(RunProgress(setup, console))
        own = stack.enter_context(own_keys(scenario, folder))
        harness = Harness(run, folder / "scenario.toml", started_here, folder / "logs", own)
        stack.callback(harness.end, progress.say)
        if own is not None:
            recording = replace(recording, security=Security(own, ()))
        keys = "" if recording.security is None else str(recording.security.folder)
        for name in started_here:
            harness.start(name)
        place = Place(run=run, endpoints=recording, join_timeout_s=scenario.clock.join_timeout_s)
        recorder = stack.enter_context(_recorded(place, run_folder, header, progress, harness))
        try:
            live.write(folder, live.LiveRun(run, called, os.getpid(), keys))
            ready()  # the coordinator waits for the recorder
            recorder.start(names)
            for name in external:
                ends = f"listens on {', '.join(places[name].listen)}, connects to {', '.join(places[name].connect)}"
                needs = f"; it needs --set '{keys_setting(keys)}'" if keys else ""
                progress.say(
                    f"waiting for {name} of run {run}, digest {scenario.digest()}; it {ends}{needs}"
                )
            started()
            _watch(recorder, progress, harness, FaultScript(setup, harness, recorder))
            if recorder.control is not None:
                harness.wait(_LEAVE_S)
        finally:
            live.remove(folder)
    return _finished(folder, recorder)


def observe(setup: Setup, place: Place, folder: Path, console: Console) -> Finished:
    """Record a run whose processes are started elsewhere, in a new folder. Raises: TransportError."""
    names = process_names(setup.scenario)
    classes = {
        "engine": setup.scenario.plant.engine,
        "controller": setup.scenario.agents.controller,
    }
    with ExitStack() as stack:
        run_folder = stack.enter_context(RunFolder(folder, setup))
        header = run_header(setup, place.run, len(names), run_folder.scenario_toml, classes)
        progress = stack.enter_context(RunProgress(setup, console))
        recorder = stack.enter_context(_recorded(place, run_folder, header, progress))
        recorder.start(names)
        _watch(recorder, progress)
    return _finished(folder, recorder)


@contextmanager
def _recorded(
    place: Place,
    folder: RunFolder,
    header: Mapping[str, str],
    progress: RunProgress,
    harness: Harness | None = None,
) -> Iterator[Recorder]:
    """Open log and recorder of a run; decide in the end whether its folder is kept.

    It is kept if it has messages, or the logs of processes that tell why there are none; after an
    interrupt only if the run has begun.
    """
    log = folder.path / "run.mcap"
    writer = LogWriter(log, header, period_ns=progress.setup.period_ns, say=progress.say)
    is_interrupted = False
    with closing(writer):
        recorder = Recorder(progress.setup, place, writer, progress.say)
        try:
            with closing(recorder):
                yield recorder
        except KeyboardInterrupt:
            is_interrupted = True
            raise
        finally:
            is_told = harness is not None and bool(recorder.error or harness.ended())
            is_recorded = recorder.received > 0 or is_told
            is_begun = recorder.started_s is not None
            folder.is_kept = is_begun if is_interrupted else is_recorded


def _finished(folder: Path, recorder: Recorder) -> Finished:
    """Return how a run ended; raise RunError if it did not begin or was not recorded."""
    control = recorder.control
    if recorder.error is not None or (control is None and recorder.started_s is None):
        raise RunError(
            recorder.error or "the run ended before its first tick", codes.EXIT_UNREACHABLE
        )
    if control is None:
        return Finished(
            folder, codes.EXIT_INTERRUPTED, "recording interrupted; the run may continue without it"
        )
    lost = recorder.writer.lost
    log = folder / "run.mcap"
    if not lost and not log.exists():
        lost = f"{log}: the log was removed during the run"
    if lost:
        text = f"{lost}; the run {control.outcome} {control.reason}".rstrip()
        raise RunError(text, control.exit_code or codes.EXIT_UNRECORDED)
    return Finished(folder, control.exit_code, control.reason)


def _watch(
    recorder: Recorder,
    progress: RunProgress,
    harness: Harness | None = None,
    faults: FaultScript | None = None,
) -> None:
    """Show progress until the run has ended.

    Forward Ctrl-C; refuse processes started here that end too early.
    """
    is_interrupted = False
    ended_s = math.inf
    goes_on = True
    with collected_signals() as signals:
        while goes_on:  # once more after the end
            goes_on = recorder.join(_POLL_S)
            progress.setup = recorder.setup
            progress.show(recorder.plant_state, recorder.started_s)
            if faults is not None:
                faults.work()
            if (name := signals.next()) is not None:
                if is_interrupted or recorder.started_s is None:
                    raise KeyboardInterrupt(name)
                is_interrupted = True
                if harness is None:
                    recorder.stop(name)
                    continue
                progress.say(f"{name}: ending the run; once more to end it at once")
                harness.child(COORDINATOR).signal(signal.Signals[name])
            if harness is None or recorder.control is not None or recorder.started_s is not None:
                continue
            for child in harness.ended():
                # A run may end within its first ticks: its messages can reach the recorder after a
                # process has ended.
                ended_s = min(ended_s, time.monotonic())
                if child.code not in _ORDERLY_ENDS or time.monotonic() - ended_s > _CATCH_UP_S:
                    raise _ended_early(child)


def _ended_early(child: Child) -> RunError:
    code = child.code or 0
    how = (
        f"was killed by {signal.Signals(-code).name}"
        if code < 0
        else f"ended with exit code {code}"
    )
    last_line = child.log.read_text(encoding="utf-8", errors="replace").strip().rpartition("\n")[2]
    # A child refuses the same options and scenario as this command would; any other end is that of
    # a peer.
    passed_on = code if code in (codes.EXIT_USAGE, codes.EXIT_SCENARIO) else codes.EXIT_UNREACHABLE
    return RunError(f"{child.name} {how} before the run began: {last_line}", passed_on)
