"""One run on this machine, from scenario to run folder."""

import os
import shutil
import signal
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from protocol.network.endpoints import Endpoints, mesh, process_names
from protocol.network.process import Place
from protocol.network.security import Security, SecurityError
from protocol.network.session import BusError, check_usable
from protocol.scenario.faults import OF_UAVS
from protocol.scenario.schema import Scenario
from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import (
    EXIT_INTERRUPTED,
    EXIT_SCENARIO,
    EXIT_UNREACHABLE,
    EXIT_UNRECORDED,
    EXIT_USAGE,
)
from protocol.wire.keys import RECORDER, Keys
from protocol.wire.messages import FaultOrigin, Request
from protocol.wire.names import COORDINATOR
from transport.flight import live
from transport.flight.harness import ORDERLY_ENDS, Child, Harness, check_ports, free_ports, keys_setting
from transport.flight.header import run_header
from transport.flight.progress import RunProgress, compile_model
from transport.flight.recorder import Recorder
from transport.flight.run_files import RunError, create, open_log, own_keys, refuse_existing
from transport.flight.signals import collected_signals
from transport.flight.trial import named, tried
from transport.log.run_folder import forget_latest
from transport.log.writer import LogWriter


class FaultScript:
    """Faults of the local processes of one run, scripted or requested by the operator, noted by its recorder.

    Processes kill or stop themselves at a scripted tick (`protocol.scenario.faults`); their parent brings them back.
    """

    def __init__(self, setup: Setup, harness: Harness, recorder: Recorder) -> None:
        self._setup, self._harness, self._recorder = setup, harness, recorder
        # The plant applies the failures of UAVs.
        self._faults = [fault for fault in setup.faults if fault.do not in OF_UAVS]
        self._dead: set[int] = set()  # children whose end has been noted
        for target in {fault.target for fault in self._faults if fault.do == "start"}:
            harness.prepare(target)
        self._actions: Mapping[str, Callable[[str], bool]] = {
            "kill": lambda name: harness.signal(name, signal.SIGKILL),
            "stop": lambda name: harness.signal(name, signal.SIGSTOP),
            "continue": lambda name: harness.signal(name, signal.SIGCONT),
            "restart": self._restart,
        }

    def work(self) -> None:
        """Apply due faults, answer requests, and note ended processes; to be called often."""
        while self._faults and self._is_due(self._faults[0].tick - (self._faults[0].do in ("continue", "start"))):
            fault = self._faults.pop(0)
            if fault.do in ("kill", "stop"):
                self._note(fault.target, fault.do, "script", fault.tick)
            else:
                self._do(fault.target, "restart" if fault.do == "start" else "continue", "script")
        while not self._recorder.requests.empty():
            self._answer(self._recorder.requests.get())
        for child in self._harness.ended():
            code = child.code or 0
            if child.process.pid in self._dead or code >= 0:
                continue
            expected = (fault for fault in self._faults if (fault.do, fault.target) == ("kill", child.name))
            kill = next(expected, None) if code == -signal.SIGKILL else None
            self._dead.add(child.process.pid)
            if kill is None:
                self._recorder.note(child.name, f"ended by {signal.Signals(-code).name}", "unknown")
            else:
                self._faults.remove(kill)
                self._note(child.name, "kill", "script", kill.tick)

    def _is_due(self, tick: int) -> bool:
        if self._recorder.tick >= tick:
            return True
        # Without ticks, estimate the tick from the wall clock.
        speed, started_s = self._setup.scenario.clock.speed, self._recorder.started_s
        if speed == 0.0 or started_s is None:
            return False
        return (time.monotonic() - started_s) * speed >= (tick + 1) * self._setup.settings.sampling_period_s

    def _answer(self, request: Request) -> None:
        action, target = (str(request.given.get(key, "")) for key in ("do", "target"))
        names = list(self._harness.mesh)
        if request.what != "fault" or action not in self._actions:
            request.reply({"error": f"do: expected one of {', '.join(self._actions)}, got {action!r}"})
        elif target not in names:
            request.reply({"error": f"target: expected one of {', '.join(names)}, got {target!r}"})
        elif action == "restart" and not target.startswith("agent"):
            request.reply({"error": f"target: expected an agent to restart, as a run ends with its {target}"})
        elif not self._do(target, action, "person"):
            request.reply({"error": f"{target} is not running"})
        else:
            request.reply({"tick": self._recorder.tick})

    def _do(self, target: str, action: str, origin: FaultOrigin) -> bool:
        done = self._actions[action](target)
        if done:
            self._note(target, action, origin)
        return done

    def _note(self, target: str, action: str, origin: FaultOrigin, tick: int | None = None) -> None:
        done = {"kill": "killed", "stop": "stopped", "continue": "continued", "restart": "restarted"}
        self._recorder.note(target, done[action], origin, tick)
        child = self._harness.child(target)
        if action == "kill" and child is not None:
            self._dead.add(child.process.pid)

    def _restart(self, name: str) -> bool:
        old = self._harness.child(name)
        if old is not None:
            self._dead.add(old.process.pid)
        self._harness.restart(name)
        if any((fault.do, fault.target) == ("start", name) for fault in self._faults):
            self._harness.prepare(name)
        return True


# Time for the processes to end after the run before they are killed.
_LEAVE_S = 3.0
_POLL_S = 0.05
# Time for the recorder to receive the messages of a run whose processes have ended.
_CATCH_UP_S = 2.0


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
    """Start the processes of a run, record it in a new folder, and wait for its end.

    `started` is called once the processes are started; before the first tick they wait for
    `ready` to return. Processes that are `external` are not: they join from elsewhere.

    Returns: The end of the run; every process has ended and the log is complete.
    Raises: RunError: the folder exists, or a process ended before the run began. HarnessError: no free port.
        ScenarioError: engine or controller cannot be used.
    """
    refuse_existing(folder)
    scenario = setup.scenario
    names = process_names(scenario)
    with ExitStack() as stack:
        stack.enter_context(_refusals())
        check_usable()
        classes = tried(setup, external)
        compile_model(setup.system.N, console)
        places = stack.enter_context(_reserved(scenario, names))
        run = folder.name if Keys.allows(folder.name) else scenario.name
        header = run_header(setup, run, len(names), create(folder, setup), classes)
        called = {name: [*place.listen, *place.connect][0] for name, place in places.items()}
        recording = places.pop(RECORDER)
        started_here = {name: place for name, place in places.items() if name not in external}
        progress = stack.enter_context(RunProgress(setup, console))
        own = stack.enter_context(own_keys(scenario, folder, progress.say))
        harness = stack.enter_context(Harness(run, folder / "scenario.toml", started_here, folder / "logs", own))
        if own is not None:
            recording = replace(recording, security=Security(own, ()))
        keys = "" if recording.security is None else str(recording.security.folder)
        harness.start(observers=[RECORDER])
        writer = open_log(folder, setup, header, progress.say)
        recorder = Recorder(
            setup,
            run,
            writer,
            recording,
            scenario.clock.join_timeout_s,
            has_ended=lambda: harness.has_ended(COORDINATOR),
        )
        try:
            live.write(folder, live.LiveRun(run, called, os.getpid(), keys, is_client=recording.mode == "client"))
            ready()  # the coordinator waits for the recorder
            recorder.start(names)
            for name in external:
                listen, connect = (", ".join(at) for at in (places[name].listen, places[name].connect))
                ends = f"listens on {listen or 'nothing'}, connects to {connect}"
                needs = f"; it needs --set '{keys_setting(keys)}'" if keys else ""
                progress.say(f"waiting for {name} of run {run}, digest {scenario.digest()}; it {ends}{needs}")
            started()
            _watch(recorder, progress, harness, FaultScript(setup, harness, recorder))
            if recorder.control is not None:
                harness.wait(_LEAVE_S)
        except RunError as error:
            if error.exit_code != EXIT_INTERRUPTED:
                recorder.end_early(str(error))
            raise
        finally:
            recorder.close()
            live.remove(folder)
            if recorder.error is None and not harness.ended():
                _discard_if_empty(folder, recorder)
            harness.end()
            for notice in harness.notices:
                progress.say(notice)
        return _finished(folder, writer, recorder)


@contextmanager
def _refusals() -> Iterator[None]:
    """Turn errors of the network into those of the run."""
    try:
        yield
    except SecurityError as error:
        raise RunError(str(error), EXIT_SCENARIO) from error
    except BusError as error:
        raise RunError(str(error), EXIT_UNREACHABLE) from error


@contextmanager
def _reserved(scenario: Scenario, names: Sequence[str]) -> Iterator[dict[str, Endpoints]]:
    """Keep the ports of a run's processes, and of its recorder for requests to their parent; yield all endpoints."""
    host, base_port = scenario.network.host, scenario.network.base_port
    with free_ports(host, 1 if base_port is not None else 1 + len(names)) as (own, *ports):
        if base_port is not None:
            ports = list(range(base_port, base_port + len(names)))
            check_ports(host, ports)
        places = mesh(scenario, [*names, RECORDER], [*ports, own])
        yield {name: place.checked(name, scenario) for name, place in places.items()}


def observe(setup: Setup, place: Place, folder: Path, console: Console) -> Finished:
    """Record a run whose processes are started elsewhere, in a new folder.

    Raises: RunError: the folder exists, or the processes did not join.
    """
    names = process_names(setup.scenario)
    text = create(folder, setup)
    with RunProgress(setup, console) as progress, _refusals():
        header = run_header(setup, place.run, len(names), text, named(setup))
        writer = open_log(folder, setup, header, progress.say)
        try:
            recorder = Recorder(setup, place.run, writer, place.endpoints, place.join_timeout_s, place.incarnation)
        except BusError:
            writer.close()
            shutil.rmtree(folder, ignore_errors=True)
            raise
        try:
            recorder.start(names)
            _watch(recorder, progress)
        finally:
            recorder.close()
            _discard_if_empty(folder, recorder)
    return _finished(folder, writer, recorder)


def _discard_if_empty(folder: Path, recorder: Recorder) -> None:
    """Remove the folder of a run without any message, so that the same command can be repeated."""
    if recorder.received == 0:
        forget_latest(folder)
        shutil.rmtree(folder, ignore_errors=True)


def _finished(folder: Path, writer: LogWriter, recorder: Recorder) -> Finished:
    """Return how a run ended; raise RunError if it did not begin or was not recorded."""
    if recorder.error is not None:
        raise RunError(recorder.error, EXIT_UNREACHABLE)
    if recorder.control is None and recorder.started_s is not None:
        return Finished(folder, EXIT_INTERRUPTED, "recording interrupted; the run may continue without it")
    if recorder.control is None:
        raise RunError("the run ended before its first tick", EXIT_UNREACHABLE)
    control = recorder.control
    if writer.lost:
        ended = f"{control.outcome}{f': {control.reason}' if control.reason else ''}"
        raise RunError(f"{writer.lost}; the run {ended}", control.exit_code or EXIT_UNRECORDED)
    return Finished(folder, control.exit_code, control.reason)


def _watch(
    recorder: Recorder, progress: RunProgress, harness: Harness | None = None, faults: FaultScript | None = None
) -> None:
    """Show progress until the run has ended; forward Ctrl-C; refuse processes started here that end too early."""
    interrupted = 0
    ended_s: float | None = None
    with collected_signals() as signals:
        while recorder.running:
            recorder.join(_POLL_S)
            progress.setup = recorder.setup
            progress.show(recorder.plant_state, recorder.started_s)
            if faults is not None:
                faults.work()
            for notice in recorder.new_notices():
                progress.say(notice)
            if len(signals) > interrupted:
                interrupted = len(signals)
                if interrupted > 1 or recorder.started_s is None:
                    raise RunError(f"interrupted ({signals[-1]})", EXIT_INTERRUPTED)
                if harness is None:
                    recorder.stop(signals[-1])
                    continue
                progress.say(f"{signals[-1]}: ending the run; once more to end it at once")
                harness.signal(COORDINATOR, signal.Signals[signals[-1]])
            if harness is None or recorder.control is not None or recorder.started_s is not None:
                continue
            ended = harness.ended()
            if ended:
                # A run may end within its first ticks: its messages can reach the recorder after a process has ended.
                ended_s = time.monotonic() if ended_s is None else ended_s
                orderly = all(child.code in ORDERLY_ENDS for child in ended)
                if not orderly or time.monotonic() - ended_s > _CATCH_UP_S:
                    raise _ended_early(ended[0])
    for notice in recorder.new_notices():
        progress.say(notice)


def _ended_early(child: Child) -> RunError:
    code = child.code or 0
    how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    # A child refuses the same options and scenario as this command would; any other end is that of a peer.
    passed_on = code in (EXIT_USAGE, EXIT_SCENARIO)
    return RunError(
        f"{child.name} {how} before the run began: {child.last_line()}", code if passed_on else EXIT_UNREACHABLE
    )
