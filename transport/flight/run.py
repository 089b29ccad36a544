"""One run on this machine, from scenario to run folder."""

import os
import shutil
import signal
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from protocol.network.endpoints import Endpoints, mesh, process_names
from protocol.network.process import Place
from protocol.network.security import Security
from protocol.network.session import BusError, check_usable
from protocol.scenario.faults import OF_UAVS
from protocol.scenario.schema import Scenario
from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import (
    EXIT_DIVERGED,
    EXIT_INTERRUPTED,
    EXIT_OVERRUN,
    EXIT_SCENARIO,
    EXIT_UNREACHABLE,
    EXIT_UNRECORDED,
    EXIT_USAGE,
)
from protocol.wire.keys import RECORDER, Keys
from protocol.wire.messages import FaultOrigin, Request
from protocol.wire.names import COORDINATOR
from transport.flight import live
from transport.flight.harness import Child, Harness, check_ports, free_ports, keys_setting
from transport.flight.header import checked, run_header
from transport.flight.progress import RunProgress, compile_model
from transport.flight.recorder import Recorder
from transport.flight.run_files import RunError, create, existing, own_keys
from transport.flight.signals import collected_signals
from transport.log.writer import LogWriter

# Exit codes of a process after the end of its run.
_ORDERLY_ENDS = {0, EXIT_UNREACHABLE, EXIT_OVERRUN, EXIT_DIVERGED, EXIT_INTERRUPTED}
# Signals of faults, and their notes in the log.
_SIGNALS = {"kill": signal.SIGKILL, "stop": signal.SIGSTOP, "continue": signal.SIGCONT}
_NOTES = {"kill": "killed", "stop": "stopped", "continue": "continued", "restart": "restarted"}


class FaultScript:
    """Faults of the local processes of one run, scripted or requested by the operator, noted by its recorder.

    Processes kill or stop themselves at a scripted tick (`protocol.scenario.faults`); their parent brings them back.
    """

    def __init__(self, setup: Setup, harness: Harness, recorder: Recorder) -> None:
        self._setup, self._harness, self._recorder = setup, harness, recorder
        # The plant applies the failures of UAVs. Kills are noted when the process has ended.
        self._kills = [fault for fault in setup.faults if fault.do == "kill"]
        self._faults = [fault for fault in setup.faults if fault.do not in (*OF_UAVS, "kill")]

    def work(self) -> None:
        """Apply due faults, answer requests, and note ended processes; to be called often."""
        for child in self._harness.ended():
            code = child.code or 0
            if code >= 0 or child.is_noted:
                continue
            child.is_noted = True
            kill = next((fault for fault in self._kills if fault.target == child.name), None)
            if kill is not None and code == -signal.SIGKILL:
                self._kills.remove(kill)
                self._recorder.note(child.name, _NOTES["kill"], "script", kill.tick)
            else:
                self._recorder.note(child.name, f"ended by {signal.Signals(-code).name}", "unknown")
        while self._faults and self._is_due(self._faults[0].tick - (self._faults[0].do != "stop")):
            fault = self._faults.pop(0)
            if fault.do == "stop":
                self._recorder.note(fault.target, _NOTES["stop"], "script", fault.tick)
            else:
                self._do(fault.target, "restart" if fault.do == "start" else "continue", "script")
        while not self._recorder.requests.empty():
            request = self._recorder.requests.get()
            request.reply(self._answer(request))

    def _is_due(self, tick: int) -> bool:
        # Without ticks, as while the coordinator is stopped, the wall clock of a paced run tells.
        clock, started_s = self._setup.scenario.clock, self._recorder.started_s
        since_s = 0.0 if started_s is None else (time.monotonic() - started_s) * clock.speed
        return self._recorder.tick >= tick or since_s >= (tick + 1) * self._setup.settings.sampling_period_s

    def _answer(self, request: Request) -> dict[str, Any]:
        action, target = (str(request.given.get(key, "")) for key in ("do", "target"))
        names = list(self._harness.mesh)
        if request.what != "fault" or action not in _NOTES:
            return {"error": f"do: expected one of {', '.join(_NOTES)}, got {action!r}"}
        if target not in names:
            return {"error": f"target: expected one of {', '.join(names)}, got {target!r}"}
        if action == "restart" and not target.startswith("agent"):
            return {"error": f"target: expected an agent to restart, as a run ends with its {target}"}
        if not self._do(target, action, "person"):
            return {"error": f"{target} is not running"}
        return {"tick": self._recorder.tick}

    def _do(self, target: str, action: str, origin: FaultOrigin) -> bool:
        """Apply a fault and note it; return whether the process was there."""
        child = self._harness.child(target)
        if action == "restart":
            self._harness.restart(target)
        elif not child.signal(_SIGNALS[action]):
            return False
        child.is_noted |= action in ("kill", "restart")
        self._recorder.note(target, _NOTES[action], origin)
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

    `started` is called once the processes are started; before the first tick they wait for `ready` to return. Processes
    that are `external` join from elsewhere. At the end every process has ended and the log is complete.

    Raises: RunError: the folder exists, or a process ended before the run began. HarnessError: no free port.
        ScenarioError: engine or controller cannot be used. TransportError: of network, keys or log. KeyboardInterrupt.
    """
    scenario = setup.scenario
    names = process_names(scenario)
    if folder.exists():  # told before a first compilation
        raise existing(folder)
    with ExitStack() as stack:
        check_usable()
        classes = checked(setup, external)
        compile_model(setup.system.N, console)
        places = stack.enter_context(_reserved(scenario, names))
        run = folder.name if Keys.allows(folder.name) else scenario.name
        header = run_header(setup, run, len(names), create(folder, setup), classes)
        called = {name: [*place.listen, *place.connect][0] for name, place in places.items()}
        recording = places.pop(RECORDER)
        started_here = {name: place for name, place in places.items() if name not in external}
        progress = stack.enter_context(RunProgress(setup, console))
        own = stack.enter_context(own_keys(scenario, folder))
        harness = Harness(run, folder / "scenario.toml", started_here, folder / "logs", own)
        stack.callback(harness.end)
        if own is not None:
            recording = replace(recording, security=Security(own, ()))
        keys = "" if recording.security is None else str(recording.security.folder)
        harness.start(observers=[RECORDER])
        place = Place(run=run, incarnation=0, endpoints=recording, join_timeout_s=scenario.clock.join_timeout_s)
        recorder = _recorder(setup, place, folder, header, progress)
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
        finally:
            recorder.close()
            live.remove(folder)
            if recorder.error is None and not harness.ended():
                _discard_if_empty(folder, recorder)
            for notice in harness.end():
                progress.say(notice)
        return _finished(folder, recorder)


def observe(setup: Setup, place: Place, folder: Path, console: Console) -> Finished:
    """Record a run whose processes are started elsewhere, in a new folder.

    Raises: RunError: the folder exists, or the processes did not join. TransportError: of network, keys or log.
    """
    names = process_names(setup.scenario)
    classes = {"engine": setup.scenario.plant.engine, "controller": setup.scenario.agents.controller}
    header = run_header(setup, place.run, len(names), create(folder, setup), classes)
    with RunProgress(setup, console) as progress:
        recorder = _recorder(setup, place, folder, header, progress)
        try:
            recorder.start(names)
            _watch(recorder, progress)
        finally:
            recorder.close()
            _discard_if_empty(folder, recorder)
    return _finished(folder, recorder)


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


def _recorder(setup: Setup, place: Place, folder: Path, header: Mapping[str, str], progress: RunProgress) -> Recorder:
    """Return the recorder of a run with an open log; without a network the folder is removed."""
    writer = LogWriter(folder / "run.mcap", header, period_ns=setup.period_ns, say=progress.say)
    try:
        return Recorder(setup, place.run, writer, place.endpoints, place.join_timeout_s, place.incarnation)
    except BusError:
        writer.close()
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _discard_if_empty(folder: Path, recorder: Recorder) -> None:
    """Remove the folder of a run without any message, so that the same command can be repeated."""
    if recorder.received == 0:
        shutil.rmtree(folder, ignore_errors=True)


def _finished(folder: Path, recorder: Recorder) -> Finished:
    """Return how a run ended; raise RunError if it did not begin or was not recorded."""
    control = recorder.control
    if control is None:
        if recorder.error is None and recorder.started_s is not None:
            return Finished(folder, EXIT_INTERRUPTED, "recording interrupted; the run may continue without it")
        raise RunError(recorder.error or "the run ended before its first tick", EXIT_UNREACHABLE)
    if recorder.error is not None:
        raise RunError(recorder.error, EXIT_UNREACHABLE)
    if recorder.writer.lost:
        text = f"{recorder.writer.lost}; the run {control.outcome} {control.reason}".rstrip()
        raise RunError(text, control.exit_code or EXIT_UNRECORDED)
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
                    raise KeyboardInterrupt(signals[-1])
                if harness is None:
                    recorder.stop(signals[-1])
                    continue
                progress.say(f"{signals[-1]}: ending the run; once more to end it at once")
                harness.child(COORDINATOR).signal(signal.Signals[signals[-1]])
            if harness is None or recorder.control is not None or recorder.started_s is not None:
                continue
            for child in harness.ended():
                # A run may end within its first ticks: its messages can reach the recorder after a process has ended.
                ended_s = ended_s or time.monotonic()
                if child.code not in _ORDERLY_ENDS or time.monotonic() - ended_s > _CATCH_UP_S:
                    raise _ended_early(child)
    for notice in recorder.new_notices():
        progress.say(notice)


def _ended_early(child: Child) -> RunError:
    code = child.code or 0
    how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    # A child refuses the same options and scenario as this command would; any other end is that of a peer.
    passed_on = code if code in (EXIT_USAGE, EXIT_SCENARIO) else EXIT_UNREACHABLE
    return RunError(f"{child.name} {how} before the run began: {child.last_line()}", passed_on)
